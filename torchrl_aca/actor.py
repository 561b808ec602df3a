"""The actor that is no network: critic-guided denoising from Gaussian noise to an action."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_aca import functional as F
from torchrl_aca.checks import action_spec, check_above, check_at_least, first_parameter
from torchrl_aca.critic import NoiseLevelCriticBase
from torchrl_aca.custom_critic import as_noise_level_critic
from torchrl_aca.schedule import NoiseSchedule

__all__ = ["CriticGuidedDenoisingActor"]


class CriticGuidedDenoisingActor(TensorDictModuleBase):
    """Samples actions by denoising Gaussian noise along the critic's gradient (Definition 1).

    For each state, ``num_candidates`` chains run from ``a_T ~ N(0, I)`` to ``a_0``; the candidate
    with the largest minimum over the critics at level 0 is kept, and Gaussian exploration noise of
    standard deviation ``exploration_noise * alpha`` is added.

    Under the exploration types RANDOM and None the draws are fresh and the exploration noise is
    added. Under DETERMINISTIC, MODE, MEAN and MEDIAN the exploration noise is dropped and the chain
    uses one fixed set of draws, the same for every state: the action is then a function of the
    observation and the weights alone. Best of N stays.

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
        guidance_weight: ``w``. Default: 50.
        num_candidates: ``N``. Default: 32.
        num_inference_steps: number ``S`` of steps of the chain, from 2 to ``T``. Fewer than ``T``
            visit every few levels only (:meth:`NoiseSchedule.strided`): cheaper, and not quite the
            same distribution. Default: ``T``, the paper's chain.
        normalize_gradient: guide by the unit gradient. Default: True.
        clip_denoised: clip the clean estimate to [-1, 1] in every step, or to [-c, c] for a number
            ``c``; False or 0 leaves it. Langevin steps make no clean estimate. Default: True.
        sampler: ``"denoising"`` or ``"langevin"``. Default: ``"denoising"``.
        langevin_step_size: ``eps`` of the Langevin step. Default: 1e-3.
        exploration_noise: standard deviation of the exploration noise at ``alpha = 1``, in critic
            units. Default: 0.1.
        alpha_init: initial ``alpha``. Default: 5.
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
        ValueError: if a number is out of range, the spec is not a bounded vector, or the critic and
            the schedule differ in ``num_steps``.

    Examples:
        >>> critic = NoiseLevelCritic(17, 6)
        >>> actor = CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(20), num_candidates=4)
        >>> actor(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """

    center: Tensor
    half_range: Tensor
    fixed_noise: Tensor

    def __init__(
        self,
        critic: nn.Module,
        schedule: NoiseSchedule,
        *,
        spec: TensorSpec | None = None,
        action_dim: int | None = None,
        guidance_weight: float = 50.0,
        num_candidates: int = 32,
        num_inference_steps: int | None = None,
        normalize_gradient: bool = True,
        clip_denoised: bool | float = True,
        sampler: Literal["denoising", "langevin"] = "denoising",
        langevin_step_size: float = 1e-3,
        exploration_noise: float = 0.1,
        alpha_init: float = 5.0,
        clip_action: bool = False,
        compile_step: bool = False,
        tile_rows: int = 1024,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("action",),
    ) -> None:
        super().__init__()
        check_at_least(1, num_candidates=num_candidates, tile_rows=tile_rows)
        check_at_least(0, guidance_weight=guidance_weight, exploration_noise=exploration_noise)
        check_at_least(0, clip_denoised=clip_denoised)
        check_above(0, alpha_init=alpha_init, langevin_step_size=langevin_step_size)
        if sampler not in ("denoising", "langevin"):
            raise ValueError(f'Expected sampler="denoising" or "langevin", got {sampler!r}.')
        self.critic: NoiseLevelCriticBase = as_noise_level_critic(critic)
        if getattr(critic, "num_steps", schedule.num_steps) != schedule.num_steps:
            raise ValueError(
                f"The critic has num_steps={critic.num_steps} noise levels, the schedule "
                f"{schedule.num_steps}. Build both with the same number."
            )
        anchor = first_parameter(self.critic)
        # A copy: `to` works in place, and the schedule may serve actors on other devices too.
        self.schedule = copy.deepcopy(schedule).to(anchor.device)
        if num_inference_steps is None:
            num_inference_steps = schedule.num_steps
        self.num_inference_steps = num_inference_steps
        self.chain_schedule = self.schedule.strided(self.num_inference_steps)
        self.guidance_weight = guidance_weight
        self.num_candidates = num_candidates
        self.normalize_gradient = normalize_gradient
        self.clip_denoised = clip_denoised
        self.sampler = sampler
        self.langevin_step_size = langevin_step_size
        self.exploration_noise = exploration_noise
        self.clip_action = clip_action
        self.compile_step = compile_step
        self.tile_rows = tile_rows
        self.in_keys = list(in_keys) if in_keys is not None else list(self.critic.observation_keys)
        self.out_keys = list(out_keys)

        self.log_alpha = nn.Parameter(anchor.new_tensor(math.log(alpha_init)))
        action_dim = action_dim or getattr(critic, "action_dim", None)
        leaf = action_spec(spec, self.out_keys[0], action_dim)
        self.spec = Composite({self.out_keys[0]: leaf}).to(anchor.device)
        self.action_dim = leaf.shape[-1]
        low, high = torch.full(leaf.shape, -1.0), torch.full(leaf.shape, 1.0)
        if spec is not None:
            low, high = leaf.space.low, leaf.space.high
        shape = (self.num_inference_steps + 1, num_candidates, self.action_dim)
        constants = {
            "center": (high + low) / 2,
            "half_range": (high - low) / 2,
            "fixed_noise": torch.randn(shape, generator=torch.Generator().manual_seed(0)),
        }
        for name, value in constants.items():
            self.register_buffer(name, value.to(anchor), persistent=False)

    # --- units ------------------------------------------------------------------------------------

    def to_env(self, action: Tensor) -> Tensor:
        """Critic units, [-1, 1], to the env's units."""
        return self.center + self.half_range * action

    def from_env(self, action: Tensor) -> Tensor:
        """The env's units to critic units, [-1, 1]."""
        return (action.to(self.center.dtype) - self.center) / self.half_range

    # --- the chain --------------------------------------------------------------------------------

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
        batch = noise.shape[2:-1]
        rows = noise.reshape(*noise.shape[:2], batch.numel(), noise.shape[-1])
        return self._denoise(self._encode(observation, batch), rows).reshape(noise.shape[1:])

    def trajectory(self, observation: Tensor | Sequence[Tensor], noise: Tensor) -> Tensor:
        """As :meth:`denoise`, with every step kept: ``a_T .. a_0``, shape ``(S+1, N, *batch, A)``.

        Args:
            observation: as in :meth:`denoise`.
            noise: as in :meth:`denoise`.
        """
        batch = noise.shape[2:-1]
        rows = noise.reshape(*noise.shape[:2], batch.numel(), noise.shape[-1])
        path = self._path(self._encode(observation, batch), rows)
        return torch.stack(path).reshape(noise.shape)

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
        return self._select(self._encode(observation, batch), rows).reshape(candidates.shape[1:])

    def _encode(self, observation: Tensor | Sequence[Tensor], batch: torch.Size) -> Any:
        observations = (observation,) if isinstance(observation, Tensor) else observation
        rows = [o.reshape(batch.numel(), *o.shape[len(batch) :]) for o in observations]
        return self.critic.encode(*rows)

    def _denoise(self, features: Any, noise: Tensor) -> Tensor:
        """Chains of ``noise``, ``(S + 1, N, rows, A)``, a tile of candidates at a time."""
        tiles = noise.split(self._candidates_per_tile(noise[0]), dim=1)
        return torch.cat([self._path(features, tile)[-1] for tile in tiles])

    def _candidates_per_tile(self, candidates: Tensor) -> int:
        """As many candidates of shape ``(N, rows, A)`` as ``tile_rows`` holds.

        On a CPU a tile keeps its activations in the cache, and bounds the memory. Elsewhere, and in
        a graph that would unroll the tiles, all go at once.
        """
        num_candidates, num_rows, _ = candidates.shape
        if candidates.device.type != "cpu" or torch.compiler.is_compiling():
            return max(num_candidates, 1)
        return max(self.tile_rows // max(num_rows, 1), 1)

    def _path(self, features: Any, noise: Tensor) -> list[Tensor]:
        """Every step of the chains of ``noise``, from ``a_T`` to ``a_0``."""
        steps = torch.arange(self.num_inference_steps, 0, -1, device=noise.device)
        path = [noise[0]]
        for step, step_noise in zip(steps, noise[1:], strict=True):
            last = len(path) == self.num_inference_steps
            take = self._last_step if last and self.sampler == "denoising" else self._step
            path.append(take(features, path[-1], step_noise, step))
        return path

    def _chain_step(self, features: Any, action: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        """One step of the chosen sampler."""
        if self.sampler == "denoising":
            return self._denoise_step(features, action, noise, step)
        gradient = self._gradient(features, action, torch.zeros_like(step))
        return F.langevin_step(
            action, gradient, self.guidance_weight, self.langevin_step_size, noise
        )

    def _denoise_step(self, features: Any, action: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        """One guided step; its number is a tensor, so that one compiled step serves them all."""
        level = self.chain_schedule.noise_levels.index_select(0, step.reshape(-1) - 1)
        level = level.reshape(step.shape)
        index = level - 1 + self.critic.first_level
        gradient = self._gradient(features, action, index)
        # Guided as at this level of the whole chain, however long the stride from here.
        variance = self.schedule.posterior_variance
        sigma = self.schedule.at(variance, level, action.dtype).sqrt()
        predicted_noise = F.guided_noise(gradient, self.guidance_weight, sigma)
        return self.chain_schedule.denoise_step(
            action, predicted_noise, noise, step, clip=self.clip_denoised
        )

    def _last_step(self, features: Any, action: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        """The step from level 1: sigma is 0 there, so the critic need not be asked."""
        return self.chain_schedule.denoise_step(
            action, torch.zeros_like(action), noise, step, clip=self.clip_denoised
        )

    def _gradient(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        gradient = self.critic.action_gradient(features, action, index)
        return F.normalize_gradient(gradient) if self.normalize_gradient else gradient

    def _step(self, features: Any, action: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        return self._run("_chain_step", features, action, noise, step)

    def _clean_values(self, features: Any, candidates: Tensor) -> Tensor:
        """Values at level 0, by which the best of N is chosen."""
        clean = torch.zeros((), dtype=torch.long, device=candidates.device)
        return self.critic.evaluate(features, candidates, clean)

    def _run(self, method: str, features: Any, *inputs: Tensor) -> Tensor:
        """Calls a method, compiled on first use where the actor was built so."""
        if not self.compile_step or torch.compiler.is_compiling():
            return getattr(self, method)(features, *inputs)
        compiled = self.__dict__.setdefault("_compiled", {})
        if method not in compiled:
            compiled[method] = torch.compile(getattr(self, method), dynamic=True)
        # Dynamic, and on copies: acting, targets and evaluation differ in rows, and code compiled
        # for a view depends on the tensor behind it. Each would be compiled anew.
        return compiled[method](features, *(tensor.clone() for tensor in inputs))

    def __getstate__(self) -> dict[str, Any]:
        """Copies and workers compile for themselves: compiled code does not travel."""
        return {key: value for key, value in self.__dict__.items() if key != "_compiled"}

    def _select(self, features: Any, candidates: Tensor) -> Tensor:
        with torch.no_grad():
            tiles = candidates.split(self._candidates_per_tile(candidates))
            values = torch.cat([self._run("_clean_values", features, tile) for tile in tiles])
        return F.select_best(candidates, values)

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
            deterministic: fixed draws and no exploration noise.

        Raises:
            ValueError: if ``num_candidates`` is below 1, or exceeds the actor's in a deterministic
                call.
        """
        batch = torch.Size(batch)
        num_rows = batch.numel()
        num_chains = self.num_candidates if num_candidates is None else num_candidates
        check_at_least(1, num_candidates=num_chains)
        features = self._encode(observation, batch)
        draws = self._draws(num_chains, num_rows, deterministic)
        action = self._select(features, self._denoise(features, draws[:-1]))
        if not deterministic:
            action = action + self.exploration_noise * self.log_alpha.exp() * draws[-1, 0]
        if self.clip_action:
            action = action.clamp(-1, 1)
        return self.to_env(action).reshape(*batch, self.action_dim)

    def _draws(self, num_chains: int, num_rows: int, deterministic: bool) -> Tensor:
        """All draws of a call, ``(S + 2, N, rows, A)``: chain noise, then exploration noise."""
        if not deterministic:
            shape = (self.num_inference_steps + 2, num_chains, num_rows, self.action_dim)
            return torch.randn(shape, dtype=self.center.dtype, device=self.center.device)
        if num_chains > self.fixed_noise.shape[1]:
            raise ValueError(
                f"A deterministic call has draws for {self.fixed_noise.shape[1]} candidates, got "
                f"num_candidates={num_chains}. Build the actor with that many."
            )
        draws = self.fixed_noise[:, :num_chains, None].expand(-1, -1, num_rows, -1)
        return torch.cat([draws, torch.zeros_like(draws[:1])])

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for observations of any batch shape, ``()`` included."""
        observation = [tensordict[key] for key in self.in_keys]
        batch = self.critic.batch_shape(observation, tensordict.batch_size)
        deterministic = exploration_type() not in (None, ExplorationType.RANDOM)
        action = self.sample(observation, batch, deterministic=deterministic)
        return tensordict.set(self.out_keys[0], action)
