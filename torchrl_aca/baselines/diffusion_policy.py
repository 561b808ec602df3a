"""A policy that is a reverse chain driven by a network, with best-of-N by critics."""

from __future__ import annotations

import copy
from collections.abc import Sequence
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
from torchrl_aca.schedule import NoiseSchedule

__all__ = ["DiffusionPolicy"]


class DiffusionPolicy(ChainPolicy):
    """Samples actions by a reverse chain whose noise, or score, a network predicts.

    For each state, ``num_candidates`` chains run from ``a_T ~ N(0, initial_scale^2 I)``; the
    candidate with the largest minimum over the critics is kept, and Gaussian exploration noise of
    standard deviation ``exploration_noise * alpha`` is added.

    With a :class:`~torchrl_aca.NoiseSchedule` the chain is DDPM's and the network predicts the
    noise. With a sequence of step sizes it is annealed Langevin sampling, and the network predicts
    the score.

    Under the exploration types RANDOM and None the draws are fresh and the exploration noise is
    added. Under DETERMINISTIC, MODE, MEAN and MEDIAN only the exploration noise is dropped: the
    chains start from one fixed set of draws, the same for every state, or from fresh ones with
    ``deterministic_draws="fresh"``. Best of N stays.

    Data holds actions in the env's units; network and critics see [-1, 1]. :meth:`to_env` and
    :meth:`from_env` map between the two by the bounds of ``spec``.

    Args:
        network: a :class:`NoiseNetwork`, or whatever else has its ``encode`` and ``forward``.
        schedule: the diffusion's constants, or the step sizes of Langevin sampling, first to last.

    Keyword Args:
        critic: a :class:`TwinCritic`, or whatever else has its ``encode`` and ``evaluate``; needed
            for more than one candidate.
        spec: bounded action spec of one env (``env.action_spec_unbatched``), or a ``Composite``
            that holds it under the action's key. Default: actions are in [-1, 1].
        action_dim: size ``A`` of the action; needed without ``spec`` for a network that tells none.
        num_candidates: ``N``. Default: 1.
        initial_scale: standard deviation of the chain's start. Default: 1.
        clip_denoised: clip the clean estimate of each step; see
            :func:`~torchrl_aca.chain.posterior_step`. Default: True.
        clip_step: clip the action after each step; Langevin sampling always does. Default: False.
        variance: of DDPM's steps, ``"posterior"`` or ``"beta"``. Default: ``"posterior"``.
        exploration_noise: standard deviation of the exploration noise at ``alpha = 1``, in
            [-1, 1] units. Default: 0.
        alpha_init: initial ``alpha``. Default: 1.
        clip_action: clip the action, with its exploration noise, to the bounds. Default: False.
        deterministic_draws: the chain's draws without exploration: one ``"fixed"`` set, or
            ``"fresh"`` ones. Default: ``"fixed"``.
        compile_step: run the chain's step and the choice among the candidates through
            ``torch.compile``. Default: False.
        tile_rows: rows (states times candidates) that a CPU takes through the chain at once, at
            least one candidate of every state. It changes cost, not the result. Default: 1024.
        in_keys: the observation's key.
        out_keys: the action's key.

    Raises:
        ValueError: if a number is out of range, the spec is not a bounded vector, there are
            candidates but no critics, or network and schedule differ in their steps.

    Examples:
        >>> from torchrl_aca.baselines import DiffusionPolicy, NoiseNetwork, TwinCritic
        >>> network, critic = NoiseNetwork(17, 6), TwinCritic(17, 6)
        >>> policy = DiffusionPolicy(
        ...     network, NoiseSchedule.vp(20), critic=critic, num_candidates=4
        ... )
        >>> policy(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """

    step_sizes: Tensor | None
    network: Any
    critic: Any
    schedule: Any

    def __init__(
        self,
        network: nn.Module,
        schedule: NoiseSchedule | Sequence[float],
        *,
        critic: nn.Module | None = None,
        spec: TensorSpec | None = None,
        action_dim: int | None = None,
        num_candidates: int = 1,
        initial_scale: float = 1.0,
        clip_denoised: bool | float = True,
        clip_step: bool | float = False,
        variance: Literal["posterior", "beta"] = "posterior",
        exploration_noise: float = 0.0,
        alpha_init: float = 1.0,
        clip_action: bool = False,
        deterministic_draws: Literal["fixed", "fresh"] = "fixed",
        compile_step: bool = False,
        tile_rows: int = 1024,
        in_keys: Sequence[NestedKey] = ("observation",),
        out_keys: Sequence[NestedKey] = ("action",),
    ) -> None:
        super().__init__()
        check_at_least(0, clip_denoised=clip_denoised, clip_step=clip_step)
        check_above(0, initial_scale=initial_scale)
        check_choice(("posterior", "beta"), variance=variance)
        anchor = first_parameter(network)
        self.network, self.critic = network, critic
        step_sizes = None
        if isinstance(schedule, NoiseSchedule):
            # A copy: `to` works in place, and the schedule may serve policies elsewhere too.
            self.schedule = copy.deepcopy(schedule).to(anchor.device)
            self.num_steps = schedule.num_steps
        else:
            self.schedule, self.num_steps = None, len(schedule)
            step_sizes = torch.tensor(schedule, dtype=torch.float64, device=anchor.device)
            check_above(0, least_step_size=min(schedule, default=0.0))
        self.register_buffer("step_sizes", step_sizes, persistent=False)
        _check_fit(network, critic, self.num_steps, num_candidates)
        self.initial_scale = initial_scale
        self.clip_denoised, self.clip_step = clip_denoised, clip_step
        self.variance = variance
        self._init_policy(
            anchor,
            self.num_steps,
            spec=spec,
            action_dim=action_dim or getattr(network, "action_dim", None),
            num_candidates=num_candidates,
            exploration_noise=exploration_noise,
            alpha_init=alpha_init,
            deterministic_draws=deterministic_draws,
            clip_action=clip_action,
            compile_step=compile_step,
            tile_rows=tile_rows,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def on(self, network: nn.Module) -> DiffusionPolicy:
        """The same policy with another network: critics and ``alpha`` stay shared."""
        other = copy.copy(self)
        other._modules = {**self._modules, "network": network}
        return other

    # --- the candidates ---------------------------------------------------------------------------

    def denoise(self, observation: Tensor, noise: Tensor) -> Tensor:
        """Run all chains on given draws; differentiable, unless under ``no_grad``.

        Args:
            observation: observations of shape ``(B, O)``.
            noise: standard normal draws of shape ``(T + 1, N, B, A)``: row 0 is the chain's start,
                row ``k`` belongs to the ``k``-th step.

        Returns:
            All candidates in [-1, 1] units, shape ``(N, B, A)``.
        """
        return self._chains(observation, noise, keep_path=False)

    def trajectory(self, observation: Tensor, noise: Tensor) -> Tensor:
        """As :meth:`denoise`, with every step kept: ``a_T .. a_0``, shape ``(T + 1, N, B, A)``.

        Args:
            observation: as in :meth:`denoise`.
            noise: as in :meth:`denoise`.
        """
        return self._chains(observation, noise, keep_path=True)

    def _chains(self, observation: Tensor, noise: Tensor, keep_path: bool) -> Tensor:
        features = self.network.encode(observation)
        how: dict[str, Any] = {
            "initial_scale": self.initial_scale,
            "keep_path": keep_path,
            "tile_rows": self.tile_rows,
            "run": self._run,
        }
        predict = partial(self._predict, features)
        if self.step_sizes is not None:
            return chain.langevin(predict, noise, self.step_sizes, clip=True, **how)
        how.update(clip=self.clip_denoised, clip_step=self.clip_step, variance=self.variance)
        return chain.denoise(predict, self.schedule, noise, **how)

    def _predict(self, features: Any, action: Tensor, level: Tensor) -> Tensor:
        """Noise, or for Langevin steps a score."""
        return self.network(features, action, level)

    @torch.no_grad()
    def values(self, observation: Tensor, candidates: Tensor) -> Tensor:
        """Critic values of candidates ``(N, B, A)`` in [-1, 1] units, shape ``(N, B, E)``.

        Of critics with several outputs it is the first: the mean of the return.
        """
        features = self.critic.encode(observation)
        tiles = chain.tiles(candidates, self.tile_rows, dim=0)
        return torch.cat([self._run(self._values, features, tile) for tile in tiles])

    def _values(self, features: Any, candidates: Tensor) -> Tensor:
        values = self.critic.evaluate(features, candidates)
        return values if values.ndim == candidates.ndim else values[..., 0]

    # --- acting -----------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(
        self,
        observation: Tensor,
        *,
        num_candidates: int | None = None,
        deterministic: bool = False,
    ) -> Tensor:
        """Actions in env units, shape ``(*batch, A)``.

        Args:
            observation: observations of shape ``(*batch, O)``.
            num_candidates: ``N`` of this call. Default: the policy's.
            deterministic: no exploration noise, and draws as ``deterministic_draws`` says.
        """
        batch = observation.shape[:-1]
        rows = observation.reshape(-1, observation.shape[-1])
        draws = self.draws(len(rows), num_candidates, deterministic)
        candidates = self.denoise(rows, draws[:-1])
        action = candidates[0]
        if len(candidates) > 1:
            action = F.select_best(candidates, self.values(rows, candidates))
        action = self.explore(action, draws[-1, 0])
        return self.to_env(action).reshape(*batch, self.action_dim)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for observations of any batch shape, ``()`` included."""
        deterministic = exploration_type() not in (None, ExplorationType.RANDOM)
        action = self.sample(tensordict[self.in_keys[0]], deterministic=deterministic)
        return tensordict.set(self.out_keys[0], action)


def _check_fit(network: Any, critic: nn.Module | None, num_steps: int, num: int) -> None:
    """A ValueError unless the parts belong together."""
    if getattr(network, "num_steps", num_steps) != num_steps:
        raise ValueError(
            f"The network has num_steps={network.num_steps} noise levels, the chain {num_steps} "
            "steps. Build both with the same number."
        )
    if num > 1 and critic is None:
        raise ValueError(f"num_candidates={num} needs critics to choose by: pass critic=... .")
