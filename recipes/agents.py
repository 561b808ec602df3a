"""The algorithms that the recipes can train, by name: `make_<name>(cfg, env, device) -> Agent`."""

from aca import make_aca
from sac import make_sac

AGENTS = {"aca": make_aca, "sac": make_sac}
