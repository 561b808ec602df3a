"""The recipe's own configuration and agent, so that what is timed is what users run."""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
sys.path.insert(0, str(RECIPES))

from aca import make_aca  # noqa: E402
from online_mujoco import make_collector  # noqa: E402

__all__ = ["configure", "make_aca", "make_collector"]


def configure(*overrides: str) -> DictConfig:
    """The configuration of `python recipes/online_mujoco.py algo=aca OVERRIDES`."""
    with hydra.initialize_config_dir(str(RECIPES / "configs"), version_base="1.3"):
        return hydra.compose("online_mujoco", ["algo=aca", *overrides])
