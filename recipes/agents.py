"""The algorithms that the recipes can train, by name: `make_<name>(cfg, env, device) -> Agent`."""

from aca import make_aca
from rlpd import make_rlpd
from sac import make_sac

AGENTS = {"aca": make_aca, "rlpd": make_rlpd, "sac": make_sac}
