"""The sampler of NC-LQL: annealed Langevin dynamics along a critic that knows the noise level."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.data import Bounded

from torchrl_aca import chain
from torchrl_aca.actor import CriticGuidedDenoisingActor
from torchrl_aca.checks import check_above, check_at_least
from torchrl_aca.critic import NoiseLevelCritic
from torchrl_aca.schedule import VarianceExplodingSchedule

__all__ = ["AnnealedLangevinActor", "make_nclql_actor"]


OTHER_CHAINS = {"sampler", "langevin_step_size"}  # keywords of the parent that do nothing here


class AnnealedLangevinActor(CriticGuidedDenoisingActor):
    """Samples actions as NC-LQL does (arXiv 2602.07873); all else is ACA's actor.

    A chain begins uniformly in [-1, 1]. From level ``T`` down to 0 it takes ``M`` Langevin steps
    ``a + eps_k / 2 w g(a, k) + sqrt(eps_k) z`` at each level, of size ``eps_k = eps (sigma_k /
    sigma_0)^2``, along the gradient ``g`` of the critics at that level, and is clipped to the box
    after each. With one candidate and no exploration noise, as in NC-LQL, what comes out is the
    action: the Langevin noise explores.

    Args:
        critic: as of :class:`CriticGuidedDenoisingActor`.
        schedule: the noise of each level.

    Keyword Args:
        steps_per_level: ``M``. Default: 2.
        step_size: ``eps``, of the steps at level 0. Default: 1e-4.
        guidance_weight: ``w``. Default: 500.
        num_candidates: ``N``. Default: 1.
        exploration_noise: as of :class:`CriticGuidedDenoisingActor`. Default: 0.
        kwargs: as of :class:`CriticGuidedDenoisingActor`, but for what is about a denoising chain;
            ``clip_denoised`` clips the action after each step.

    Raises:
        ValueError: as :class:`CriticGuidedDenoisingActor`, and for keywords of its other chains.

    Examples:
        >>> from torchrl_aca.langevin_actor import AnnealedLangevinActor
        >>> from torchrl_aca.schedule import VarianceExplodingSchedule
        >>> critic = NoiseLevelCritic(17, 6, num_steps=9)
        >>> actor = AnnealedLangevinActor(critic, VarianceExplodingSchedule(9))
        >>> actor(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """

    schedule_kind = VarianceExplodingSchedule
    step_sizes: Tensor
    step_levels: Tensor

    def __init__(
        self,
        critic: nn.Module,
        schedule: VarianceExplodingSchedule,
        *,
        steps_per_level: int = 2,
        step_size: float = 1e-4,
        guidance_weight: float = 500.0,
        num_candidates: int = 1,
        exploration_noise: float = 0.0,
        **kwargs: Any,
    ) -> None:
        check_at_least(1, steps_per_level=steps_per_level)
        check_above(0, step_size=step_size)
        if other := sorted(OTHER_CHAINS & kwargs.keys()):
            raise ValueError(
                f"Annealed Langevin dynamics have no {other}: expected steps_per_level and "
                "step_size in their place."
            )
        super().__init__(
            critic,
            schedule,
            guidance_weight=guidance_weight,
            num_candidates=num_candidates,
            exploration_noise=exploration_noise,
            **kwargs,
        )
        levels = torch.arange(schedule.num_steps, -1, -1).repeat_interleave(steps_per_level)
        sizes = step_size * (schedule.sigmas / schedule.sigmas[0]).square()
        device = self.guidance_weight.device
        self.register_buffer("step_levels", levels.to(device), persistent=False)
        self.register_buffer("step_sizes", sizes[levels].to(device), persistent=False)
        self._fix_noise(self.fixed_noise, len(levels))

    def exact_buffers(self) -> Iterable[str]:
        """The sizes of the steps as well, numbers like 1e-4."""
        return (*super().exact_buffers(), "step_sizes")

    def _chains(
        self,
        features: Any,
        noise: Tensor,
        keep_path: bool = False,
        weight: Tensor | None = None,
    ) -> Tensor:
        # The distribution function takes a standard normal draw to a uniform one.
        start = torch.erf(noise[:1] / math.sqrt(2))
        return chain.langevin(
            partial(self._gradient, features),
            torch.cat([start, noise[1:]]),
            self.step_sizes,
            levels=self.step_levels,
            guidance_weight=self.guidance_weight if weight is None else weight,
            clip=self.clip_denoised,
            keep_path=keep_path,
            tile_rows=self.tile_rows,
            run=self._run,
        )


def make_nclql_actor(
    observation_dim: int,
    spec: Bounded,
    *,
    num_steps: int,
    sigma_min: float,
    sigma_max: float,
    num_critics: int = 2,
    num_cells: Sequence[int] = (256, 256, 256),
    device: torch.device | str | None = None,
    **actor: Any,
) -> AnnealedLangevinActor:
    """Builds an :class:`AnnealedLangevinActor` on a :class:`NoiseLevelCritic`.

    Args:
        observation_dim: size ``O`` of the observation vector.
        spec: bounded spec of one env's action, of shape ``(A,)``.

    Keyword Args:
        num_steps: number ``T`` of noise levels.
        sigma_min: noise of level 0; see :class:`VarianceExplodingSchedule`.
        sigma_max: noise of level ``T``.
        num_critics: number ``E`` of critics. Default: 2.
        num_cells: widths of the critic's hidden layers. Default: three of 256.
        device: device of the parameters.
        actor: more keywords of the actor.

    Raises:
        ValueError: if a value is refused by one of the parts.
    """
    critic = NoiseLevelCritic(
        observation_dim,
        spec.shape[-1],
        num_steps=num_steps,
        num_critics=num_critics,
        num_cells=num_cells,
        device=device,
    )
    schedule = VarianceExplodingSchedule(num_steps, sigma_min, sigma_max)
    return AnnealedLangevinActor(critic, schedule, spec=spec, **actor).to(device)
