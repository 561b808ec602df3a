"""ACA from plain keywords."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torchrl.data import Bounded

from torchrl_aca.actor import CriticGuidedDenoisingActor
from torchrl_aca.checks import check_choice
from torchrl_aca.critic import NoiseLevelCritic
from torchrl_aca.schedule import NoiseSchedule

__all__ = ["make_aca_actor"]


def make_aca_actor(
    observation_dim: int,
    spec: Bounded,
    *,
    num_steps: int = 20,
    schedule: str = "cosine",
    num_critics: int = 2,
    num_cells: Sequence[int] = (256, 256, 256),
    first_level: int = 1,
    device: torch.device | str | None = None,
    **actor: Any,
) -> CriticGuidedDenoisingActor:
    """Builds a :class:`CriticGuidedDenoisingActor` on a :class:`NoiseLevelCritic`.

    Args:
        observation_dim: size ``O`` of the observation vector.
        spec: bounded spec of one env's action, of shape ``(A,)``.

    Keyword Args:
        num_steps: number ``T`` of noise levels. Default: 20.
        schedule: ``"cosine"``, ``"linear"`` or ``"vp"``. Default: ``"cosine"``.
        num_critics: number ``E`` of critics. Default: 2.
        num_cells: widths of the critic's hidden layers. Default: three of 256.
        first_level: see :class:`NoiseLevelCriticBase`. Default: 1.
        device: device of the parameters.
        actor: more keywords of the actor.

    Raises:
        ValueError: if a value is refused by one of the parts, or the schedule is unknown.

    Examples:
        >>> from torchrl.data import Bounded
        >>> actor = make_aca_actor(17, Bounded(-2.0, 2.0, shape=(6,)), num_candidates=4)
        >>> actor(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """
    check_choice(("cosine", "linear", "vp"), schedule=schedule)
    critic = NoiseLevelCritic(
        observation_dim,
        spec.shape[-1],
        num_steps=num_steps,
        num_critics=num_critics,
        num_cells=num_cells,
        first_level=first_level,
        device=device,
    )
    levels = getattr(NoiseSchedule, schedule)(num_steps)
    return CriticGuidedDenoisingActor(critic, levels, spec=spec, **actor).to(device)
