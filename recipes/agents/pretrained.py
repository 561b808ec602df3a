"""Whether a run may have an offline phase, and whether it can take over that of another run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from agents import AGENTS
from torchrl_aca.errors import RunError
from torchrl_aca.offline.layout import METADATA_FILE
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.pretrained import read_pretrained, take_over

DATA = f"SHA-256 of its {METADATA_FILE}"  # the row of the card that tells one data set from another
OF_ONE_PHASE = ("total_updates", "offline_updates", "utd_ratio")  # may differ between the two runs


def refuse_offline_phase(cfg: Any) -> None:
    """Raises `RunError` if updates on data alone are asked of a recipe that has no data."""
    if cfg.optim.offline_updates:
        raise RunError(
            f"optim.offline_updates={cfg.optim.offline_updates}: expected 0, because this recipe "
            "has no data to learn from. Leave it out, or use recipes/o2o_halfcheetah.py."
        )


def require_offline_phase(cfg: Any, agent: Agent) -> None:
    """Raises `RunError` if an agent would begin its online phase without its offline one."""
    name = cfg.algo.name
    if agent.offline_update is None and cfg.pretrained is not None:
        raise RunError(
            f"pretrained={cfg.pretrained}: expected null, because algo={name} has no offline "
            "phase. Leave it out."
        )
    if agent.offline_update is not None and not cfg.optim.offline_updates and not cfg.pretrained:
        raise RunError(
            f"offline_updates=0: algo={name} goes online with what it has learnt from the data "
            "alone; expected a number above 0, or pretrained=RUN_DIR. Without data, use "
            "recipes/online_mujoco.py."
        )


def start_from(cfg: Any, agent: Agent, facts: Mapping[str, object]) -> int:
    """Gives the agent what the run in `cfg.pretrained` has learnt; the offline updates of that.

    Raises:
        RunError: If that run is no other half of this one: another method, environment, data set or
            setting, or an offline phase that is not finished.
    """
    pretrained = read_pretrained(Path(cfg.pretrained))
    for key, got, expected in _compared(cfg, pretrained, facts):
        if got != expected:
            raise RunError(
                f"pretrained={cfg.pretrained} has {key}={got}; expected {expected}, as in this "
                "run. Give the same to both, or leave pretrained out."
            )
    return take_over(agent, pretrained)


def _compared(
    cfg: Any, pretrained: Mapping[str, Any], facts: Mapping[str, object]
) -> Iterator[tuple[str, Any, Any]]:
    """What has to be equal: key, value there, value here."""
    stored, name = pretrained["config"], cfg.algo.name
    other = stored["algo"]["name"]
    if other not in AGENTS[name].starts_from:
        yield "algo", other, name
    for key, expected in cfg.env.model_dump().items():
        yield f"env.{key}", stored["env"].get(key), expected
    for section in AGENTS[name].sections.keys() & AGENTS[other].sections.keys():
        for key, expected in getattr(cfg, section).model_dump().items():
            if not (section == "optim" and key in OF_ONE_PHASE):
                yield f"{section}.{key}", stored[section].get(key), expected
    if DATA in facts and DATA in pretrained["facts"]:  # an online phase may have no data
        yield "dataset", pretrained["facts"][DATA], facts[DATA]
