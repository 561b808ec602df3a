"""The small critic and the small actor that their tests share."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_aca import CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule

OBS, ACTION, BATCH, CANDIDATES, T = 4, 3, 6, 5, 6
DETERMINISTIC = set_exploration_type(ExplorationType.DETERMINISTIC)


def make_critic(observation_dim=OBS, action_dim=ACTION, **kwargs):
    """A critic with biases that are not zero."""
    kwargs = {"num_cells": (7, 5), "embedding_dim": 8, "num_steps": T, **kwargs}
    critic = NoiseLevelCritic(observation_dim, action_dim, **kwargs)
    for name, parameter in critic.named_parameters():
        if name.endswith("bias"):
            nn.init.normal_(parameter, std=0.1)
    return critic


def make_actor(critic=None, schedule=None, **kwargs):
    kwargs = {"num_candidates": CANDIDATES, **kwargs}
    return CriticGuidedDenoisingActor(
        critic or make_critic(), schedule or NoiseSchedule.cosine(T), **kwargs
    )


def observe(*batch, **kwargs):
    return TensorDict(observation=torch.randn(*batch, OBS, **kwargs), batch_size=batch)


def act(actor, td, seed=None):
    if seed is not None:
        torch.manual_seed(seed)
    return actor(td.clone())["action"]
