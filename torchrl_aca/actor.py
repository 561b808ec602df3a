"""The actor that is no network: critic-guided denoising from Gaussian noise to an action."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_aca import chain
from torchrl_aca import functional as F
from torchrl_aca.chain_policy import ChainPolicy
from torchrl_aca.checks import check_above, check_at_least, check_choice, first_parameter
from torchrl_aca.critic import NoiseLevelCriticBase
from torchrl_aca.custom_critic import as_noise_level_critic
from torchrl_aca.exact import ExactBuffers
from torchrl_aca.schedule import NoiseSchedule, VarianceExplodingSchedule

__all__ = ["CriticGuidedDenoisingActor"]


class CriticGuidedDenoisingActor(ExactBuffers, ChainPolicy):
    """Samples actions by denoising Gaussian noise along the critic's gradient (Definition 1).

    For each state, ``num_candidates`` chains run from ``a_T ~ N(0, I)`` to ``a_0``; the candidate
    with the largest minimum over the critics at level 0 is kept, and Gaussian exploration noise of
    standard deviation ``exploration_noise * alpha`` is added.

    Under the exploration types RANDOM and None the draws are fresh and the exploration noise is
    added. Under DETERMINISTIC, MODE, MEAN and MEDIAN the exploration noise is dropped and the chain
    uses one fixed set of draws, the same for every state: the action is then a function of the
    observation and the weights alone. ``deterministic_draws="fresh"`` draws there too. Best of N
    stays.

    With ``sampler="langevin"`` the same chains take ``S`` Langevin steps along the gradient of the
    critic at level 0 instead (Langevin-Q of the paper's appendix). Any critic with a level 0 will
    do, one that ignores the noise level as well.

    Data holds actions in the env's units, the critic sees [-1, 1]; :meth:`to_env` and
    :meth:`from_env` map between the two by the bounds of ``spec``.

    Args:
        critic: a :class:`NoiseLevelCritic`, or a network of one's own (see :class:`CustomCritic`).
            ``actor.critic`` holds the very parameters that the loss trains.
        schedule: the diffusion's constants; its ``T`` is the number of noise levels.

    Keyword Args:
        spec: bounded action spec of one env (``env.action_spec_unbatched``), or a ``Composite``
            that holds it under the action's key. Default: actions are in [-1, 1].
        action_dim: size ``A`` of the action, needed only without ``spec`` for a critic without an
            ``action_dim`` of its own.
        guidance_weight: ``w``. It is part of the actor's state, so that collectors and checkpoints
            carry it; ``actor.guidance_weight = 3`` sets it, and a loss with
            ``guidance_weight="auto"`` moves it from here. Default: 50.
        num_candidates: ``N``. Default: 32.
        num_inference_steps: number ``S`` of steps of the chain, from 2 to ``T``. Fewer than ``T``
            visit the low levels and skip high ones (:func:`~torchrl_aca.chain.inference_levels`).
            Default: ``T``, the paper's chain.
        inference_levels: the levels that the chain visits, rising from 1 to ``T``, instead of
            those that ``num_inference_steps`` chooses.
        normalize_gradient: guide by the unit gradient. Default: True.
        clip_denoised: clip the clean estimate to [-1, 1] in every step, or to [-c, c] for a number
            ``c``; False or 0 leaves it. Langevin steps make no clean estimate. Default: True.
        sampler: ``"denoising"`` or ``"langevin"``. Default: ``"denoising"``.
        langevin_step_size: ``eps`` of the Langevin step. Default: 1e-3.
        exploration_noise: standard deviation of the exploration noise at ``alpha = 1``, in critic
            units. Default: 0.1.
        alpha_init: initial ``alpha``. Default: 5.
        deterministic_draws: the chain's draws without exploration: one ``"fixed"`` set, or
            ``"fresh"`` ones from torch's generator. Default: ``"fixed"``.
        clip_action: clip the action to the spec's bounds. Default: False; as in the official
            code, exploration noise may leave the box, and the loss learns from such actions.
        compile_step: run the denoising step, and the choice among the candidates, through
            ``torch.compile``: seconds of compilation at the first call, faster steps afterwards,
            for any number of rows. Default: False.
        tile_rows: rows (states times candidates) that a CPU takes through the chain at once, at
            least one candidate of every state. It changes cost, not the result. Default: 1024.
        in_keys: keys of the observations. Default: those of the critic.
        out_keys: the action's key.

    Raises:
        ValueError: if a number is out of range, the spec is not a bounded vector, the schedule is
            not of the chain's kind, or the critic and the schedule differ in ``num_steps``; also
            for both ``num_inference_steps`` and ``inference_levels``, or levels that do not rise
            from 1 to ``T``.

    Examples:
        >>> critic = NoiseLevelCritic(17, 6)
        >>> actor = CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(20), num_candidates=4)
        >>> actor(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """

    schedule_kind: type = NoiseSchedule
    guidance_weight: Tensor
    schedule: Any
    chain_schedule: Any

    def __init__(
        self,
        critic: nn.Module,
        schedule: NoiseSchedule | VarianceExplodingSchedule,
        *,
        spec: TensorSpec | None = None,
        action_dim: int | None = None,
        guidance_weight: float = 50.0,
        num_candidates: int = 32,
        num_inference_steps: int | None = None,
        inference_levels: Sequence[int] | None = None,
        normalize_gradient: bool = True,
        clip_denoised: bool | float = True,
        sampler: Literal["denoising", "langevin"] = "denoising",
        langevin_step_size: float = 1e-3,
        exploration_noise: float = 0.1,
        alpha_init: float = 5.0,
        deterministic_draws: Literal["fixed", "fresh"] = "fixed",
        clip_action: bool = False,
        compile_step: bool = False,
        tile_rows: int = 1024,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("action",),
    ) -> None:
        super().__init__()
        check_at_least(0, guidance_weight=guidance_weight, clip_denoised=clip_denoised)
        check_above(0, langevin_step_size=langevin_step_size)
        check_choice(("denoising", "langevin"), sampler=sampler)
        if not isinstance(schedule, self.schedule_kind):
            raise ValueError(
                f"{type(self).__name__} expected a {self.schedule_kind.__name__}, got a "
                f"{type(schedule).__name__}. Its chain is made for that noise."
            )
        self.critic: NoiseLevelCriticBase = as_noise_level_critic(critic)
        if getattr(critic, "num_steps", schedule.num_steps) != schedule.num_steps:
            raise ValueError(
                f"The critic has num_steps={critic.num_steps} noise levels, the schedule "
                f"{schedule.num_steps}. Build both with the same number."
            )
        anchor = first_parameter(self.critic)
        # A copy: `to` works in place, and the schedule may serve actors on other devices too.
        self.schedule = copy.deepcopy(schedule).to(anchor.device)
        self.inference_levels = _levels(schedule.num_steps, num_inference_steps, inference_levels)
        self.num_inference_steps = len(self.inference_levels)
        self.chain_schedule = self.schedule.restrict(self.inference_levels)
        self.normalize_gradient = normalize_gradient
        self.clip_denoised = clip_denoised
        self.sampler = sampler
        self.langevin_step_size = langevin_step_size
        self._init_policy(
            anchor,
            self.num_inference_steps,
            spec=spec,
            action_dim=action_dim or getattr(critic, "action_dim", None),
            num_candidates=num_candidates,
            exploration_noise=exploration_noise,
            alpha_init=alpha_init,
            deterministic_draws=deterministic_draws,
            clip_action=clip_action,
            compile_step=compile_step,
            tile_rows=tile_rows,
            in_keys=self.critic.observation_keys if in_keys is None else in_keys,
            out_keys=out_keys,
        )
        weight = torch.tensor(guidance_weight, dtype=torch.float64, device=anchor.device)
        self.register_buffer("guidance_weight", weight)

    def __setattr__(self, name: str, value: Any) -> None:
        """A weight given to ``guidance_weight`` fills the buffer, whoever else may hold it."""
        if name == "guidance_weight":
            check_at_least(0, guidance_weight=float(value))
            self.guidance_weight.fill_(float(value))
        else:
            super().__setattr__(name, value)

    def exact_buffers(self) -> Iterable[str]:
        """The guidance weight: as a float, it is float64."""
        return ("guidance_weight",)

    # --- the candidates ---------------------------------------------------------------------------

    def encode(self, observation: Tensor | Sequence[Tensor], batch: Sequence[int]) -> Any:
        """The critic's features of states of batch shape ``batch``, one row per state.

        Args:
            observation: as in :meth:`denoise`.
            batch: the batch shape.
        """
        batch = torch.Size(batch)
        observations = (observation,) if isinstance(observation, Tensor) else observation
        rows = [o.reshape(batch.numel(), *o.shape[len(batch) :]) for o in observations]
        return self.critic.encode(*rows)

    def denoise(self, observation: Tensor | Sequence[Tensor], noise: Tensor) -> Tensor:
        """Run all chains on given draws: the deterministic core of the actor.

        Args:
            observation: the observation of shape ``(*batch, O)``, or one tensor for each of
                ``in_keys``.
            noise: standard normal draws of shape ``(S + 1, N, *batch, A)``: row 0 is ``a_T``, row
                ``k`` belongs to the ``k``-th step; denoising multiplies the last row by zero, the
                Langevin sampler adds noise in every step.

        Returns:
            All candidates in critic units, shape ``(N, *batch, A)``.
        """
        return self._from_noise(observation, noise, keep_path=False).reshape(noise.shape[1:])

    def trajectory(self, observation: Tensor | Sequence[Tensor], noise: Tensor) -> Tensor:
        """As :meth:`denoise`, with every step kept: ``a_T .. a_0``, shape ``(S+1, N, *batch, A)``.

        Args:
            observation: as in :meth:`denoise`.
            noise: as in :meth:`denoise`.
        """
        return self._from_noise(observation, noise, keep_path=True).reshape(noise.shape)

    @torch.no_grad()
    def select(self, observation: Tensor | Sequence[Tensor], candidates: Tensor) -> Tensor:
        """The best candidate by the minimum over the critics at level 0.

        Args:
            observation: as in :meth:`denoise`.
            candidates: actions in critic units, shape ``(N, *batch, A)``.

        Returns:
            Actions in critic units, shape ``(*batch, A)``.
        """
        batch = candidates.shape[1:-1]
        rows = candidates.reshape(candidates.shape[0], -1, candidates.shape[-1])
        return self._best(self.encode(observation, batch), rows).reshape(candidates.shape[1:])

    def _best(self, features: Any, candidates: Tensor) -> Tensor:
        if len(candidates) == 1:  # no choice, so no values
            return candidates[0]
        return F.select_best(candidates, self.values(features, candidates))

    def _from_noise(
        self, observation: Tensor | Sequence[Tensor], noise: Tensor, keep_path: bool
    ) -> Tensor:
        batch = noise.shape[2:-1]
        rows = noise.reshape(*noise.shape[:2], batch.numel(), noise.shape[-1])
        return self._chains(self.encode(observation, batch), rows, keep_path)

    @torch.no_grad()
    def propose(
        self, features: Any, noise: Tensor, guidance_weight: Tensor | None = None
    ) -> Tensor:
        """As :meth:`denoise`, for states that are encoded already.

        Args:
            features: what :meth:`encode` gave for ``B`` states.
            noise: standard normal draws of shape ``(S + 1, N, B, A)``.
            guidance_weight: ``w`` of this call. Default: the actor's.

        Returns:
            All candidates in critic units, shape ``(N, B, A)``.
        """
        return self._chains(features, noise, weight=guidance_weight)

    @torch.no_grad()
    def values(self, features: Any, candidates: Tensor) -> Tensor:
        """The critics at level 0, shape ``(N, B, E)``.

        Args:
            features: as in :meth:`propose`.
            candidates: actions in critic units, shape ``(N, B, A)``.
        """
        tiles = chain.tiles(candidates, self.tile_rows, dim=0)
        return torch.cat([self._run(self._clean_values, features, tile) for tile in tiles])

    def _chains(
        self,
        features: Any,
        noise: Tensor,
        keep_path: bool = False,
        weight: Tensor | None = None,
    ) -> Tensor:
        """Chains of ``noise``, ``(S + 1, N, rows, A)``, by the chosen sampler."""
        weight = self.guidance_weight if weight is None else weight
        how: dict[str, Any] = {
            "keep_path": keep_path,
            "tile_rows": self.tile_rows,
            "run": self._run,
        }
        if self.sampler == "langevin":
            clean = noise.new_zeros(len(noise) - 1, dtype=torch.long)
            return chain.langevin(
                partial(self._gradient, features),
                noise,
                self.langevin_step_size,
                levels=clean,
                guidance_weight=weight,
                **how,
            )
        predict_noise = partial(self._predict_noise, features, weight)
        return chain.denoise(
            predict_noise,
            self.chain_schedule,
            noise,
            clip=self.clip_denoised,
            predict_last=False,
            **how,
        )

    def _predict_noise(
        self, features: Any, weight: Tensor, action: Tensor, level: Tensor
    ) -> Tensor:
        """Guided as at this level of the whole chain, however long the stride from here."""
        variance = self.schedule.posterior_variance
        sigma = self.schedule.at(variance, level, action.dtype).sqrt()
        gradient = self._gradient(features, action, level)
        return F.guided_noise(gradient, weight, sigma)

    def _gradient(self, features: Any, action: Tensor, level: Tensor) -> Tensor:
        gradient = self.critic.action_gradient(features, action, level)
        return F.normalize_gradient(gradient) if self.normalize_gradient else gradient

    def _clean_values(self, features: Any, candidates: Tensor) -> Tensor:
        return self.critic.evaluate(features, candidates, _clean_level(candidates))

    # --- acting -----------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(
        self,
        observation: Tensor | Sequence[Tensor],
        batch: Sequence[int],
        *,
        num_candidates: int | None = None,
        deterministic: bool = False,
    ) -> Tensor:
        """Actions in env units for observations of batch shape ``batch``, shape ``(*batch, A)``.

        Args:
            observation: as in :meth:`denoise`.
            batch: the batch shape.
            num_candidates: ``N`` of this call. Default: the actor's.
            deterministic: no exploration noise, and draws as ``deterministic_draws`` says.

        Raises:
            ValueError: if ``num_candidates`` is below 1, or exceeds that of the fixed draws.
        """
        batch = torch.Size(batch)
        features = self.encode(observation, batch)
        draws = self.draws(batch.numel(), num_candidates, deterministic)
        best = self._best(features, self.propose(features, draws[:-1]))
        action = self.explore(best, draws[-1, 0])
        return self.to_env(action).reshape(*batch, self.action_dim)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for observations of any batch shape, ``()`` included."""
        observation = [tensordict[key] for key in self.in_keys]
        batch = self.critic.batch_shape(observation, tensordict.batch_size)
        deterministic = exploration_type() not in (None, ExplorationType.RANDOM)
        action = self.sample(observation, batch, deterministic=deterministic)
        return tensordict.set(self.out_keys[0], action)


def _levels(num_levels: int, num_steps: int | None, levels: Sequence[int] | None) -> list[int]:
    """The levels of the chain: all of them, or as many as asked for, or those given."""
    if levels is None:
        return chain.inference_levels(num_levels, num_levels if num_steps is None else num_steps)
    if num_steps is not None:
        raise ValueError("Expected num_inference_steps or inference_levels, got both. Drop one.")
    return chain.check_levels(levels, num_levels)


def _clean_level(action: Tensor) -> Tensor:
    return torch.zeros((), dtype=torch.long, device=action.device)
