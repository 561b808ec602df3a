"""The recipe's own configuration and agent, so that what is timed is what users run.

Needs `recipes/` on Python's path: pytest has it there, scripts get it by `PYTHONPATH=recipes`.
"""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
from torchrl.envs import EnvBase

from agents import configured, make_agent
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import RunConfig

CONFIGS = Path(__file__).resolve().parents[1] / "recipes/configs"


def configure(*overrides: str) -> RunConfig:
    """The configuration of `python recipes/online_mujoco.py OVERRIDES`, of ACA without others."""
    with hydra.initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return configured(hydra.compose("online_mujoco", list(overrides)))


def make_recipe_agent(cfg: RunConfig, env: EnvBase) -> Agent:
    """The agent of that configuration, on the CPU."""
    return make_agent(cfg, env, torch.device("cpu"))
