"""A diffusion policy with its network and its critics, from plain keywords."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torchrl.data import Bounded

from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.baselines.networks import NoiseNetwork, TwinCritic
from torchrl_aca.checks import check_choice
from torchrl_aca.schedule import NoiseSchedule

__all__ = ["make_diffusion_policy"]


def make_diffusion_policy(
    observation_dim: int,
    spec: Bounded,
    *,
    num_steps: int = 20,
    schedule: str | Sequence[float] = "cosine",
    linear_scale: float = 1.0,
    num_cells: Sequence[int] = (256, 256, 256),
    activation: str = "Mish",
    network: Mapping[str, Any] | None = None,
    critic: Mapping[str, Any] | None = None,
    device: torch.device | str | None = None,
    **policy: Any,
) -> DiffusionPolicy:
    """Builds a :class:`DiffusionPolicy` on a :class:`NoiseNetwork` and a :class:`TwinCritic`.

    Args:
        observation_dim: size ``O`` of the observation vector.
        spec: bounded spec of one env's action, of shape ``(A,)``.

    Keyword Args:
        num_steps: number ``T`` of noise levels. Default: 20.
        schedule: ``"cosine"``, ``"linear"`` or ``"vp"``, or the step sizes of Langevin sampling.
            Default: ``"cosine"``.
        linear_scale: the linear schedule is so many times ``linspace(1e-4, 0.999)``. Default: 1.
        num_cells: widths of the hidden layers of both. Default: three of 256.
        activation: name of an activation in ``torch.nn``, of both. Default: Mish.
        network: more keywords of the network.
        critic: more keywords of the critics.
        device: device of the parameters.
        policy: more keywords of the policy.

    Raises:
        ValueError: if a value is refused by one of the parts, or the schedule is unknown.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_aca.baselines import make_diffusion_policy
        >>> policy = make_diffusion_policy(17, Bounded(-2.0, 2.0, shape=(6,)), num_candidates=4)
        >>> policy(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """
    action_dim = spec.shape[-1]
    kind = getattr(nn, activation)
    mlp: dict[str, Any] = {"num_cells": num_cells, "activation": kind, "device": device}
    return DiffusionPolicy(
        NoiseNetwork(observation_dim, action_dim, num_steps=num_steps, **mlp, **(network or {})),
        _chain(schedule, num_steps, linear_scale),
        critic=TwinCritic(observation_dim, action_dim, **mlp, **(critic or {})),
        spec=spec,
        **policy,
    ).to(device)


def _chain(
    schedule: str | Sequence[float], num_steps: int, linear_scale: float
) -> NoiseSchedule | Sequence[float]:
    """The schedule of that name, or the step sizes as they are."""
    if not isinstance(schedule, str):
        return schedule
    check_choice(("cosine", "linear", "vp"), schedule=schedule)
    if schedule == "linear":
        return NoiseSchedule.linear(num_steps, 1e-4, 0.999, linear_scale)
    return getattr(NoiseSchedule, schedule)(num_steps)
