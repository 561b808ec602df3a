"""The recipe's own configuration and agent, so that what is timed is what users run.

Needs `recipes/` on Python's path: pytest has it there, scripts get it by `PYTHONPATH=recipes`.
"""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase

from agents import configured, make_agent
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import RunConfig

CONFIGS = Path(__file__).resolve().parents[1] / "recipes/configs"


def configure(*overrides: str, name: str = "online_mujoco") -> RunConfig:
    """The configuration of `python recipes/online_mujoco.py --config-name NAME OVERRIDES`."""
    with hydra.initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return configured(hydra.compose(name, list(overrides)))


def make_recipe_agent(cfg: RunConfig, env: EnvBase, device: str | torch.device = "cpu") -> Agent:
    """The agent of that configuration."""
    return make_agent(cfg, env, torch.device(device))


def random_batch(observation_dim: int, action_dim: int, size: int) -> TensorDict:
    """Transitions of such sizes."""
    ended = torch.zeros(size, 1, dtype=torch.bool)
    following = TensorDict(
        observation=torch.randn(size, observation_dim),
        reward=torch.randn(size, 1),
        done=ended,
        terminated=ended.clone(),
        batch_size=[size],
    )
    return TensorDict(
        observation=torch.randn(size, observation_dim),
        action=torch.rand(size, action_dim) * 2 - 1,
        next=following,
        batch_size=[size],
    )
