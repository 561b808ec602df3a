"""What policies that draw their actions by a reverse chain share, whatever drives the chain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from torchrl_aca import chain
from torchrl_aca.checks import action_spec, check_above, check_at_least, check_choice, check_keys

__all__ = ["ChainPolicy"]


class ChainPolicy(TensorDictModuleBase):
    """Base class: the action's units, the draws of a call, and exploration noise.

    Data holds actions in the env's units, chains work in [-1, 1]; :meth:`to_env` and
    :meth:`from_env` map between the two by the bounds of the spec. Exploration adds Gaussian noise
    of standard deviation ``exploration_noise * alpha``; ``log_alpha`` is a parameter.
    """

    low: Tensor
    high: Tensor
    center: Tensor
    half_range: Tensor
    fixed_noise: Tensor

    def _init_policy(
        self,
        like: Tensor,
        num_steps: int,
        *,
        spec: TensorSpec | None,
        action_dim: int | None,
        num_candidates: int,
        exploration_noise: float,
        alpha_init: float,
        deterministic_draws: Literal["fixed", "fresh"],
        clip_action: bool,
        compile_step: bool,
        tile_rows: int,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
    ) -> None:
        """Check and keep what all chain policies are told, as their constructors describe it.

        ``like`` gives device and dtype, ``num_steps`` is the length of the chain. A ValueError says
        which number is out of range, or that the spec is not a bounded vector.
        """
        check_at_least(1, num_candidates=num_candidates, tile_rows=tile_rows)
        check_at_least(0, exploration_noise=exploration_noise)
        check_above(0, alpha_init=alpha_init)
        check_choice(("fixed", "fresh"), deterministic_draws=deterministic_draws)
        check_keys(in_keys=in_keys, out_keys=out_keys)
        self.num_candidates = num_candidates
        self.exploration_noise = exploration_noise
        self.deterministic_draws = deterministic_draws
        self.clip_action = clip_action
        self.tile_rows = tile_rows
        self._run = chain.StepRunner(compile_step)
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        self.log_alpha = nn.Parameter(like.new_tensor(math.log(alpha_init)))
        self._set_spec(like, spec, action_dim)
        self._fix_noise(like, num_steps)

    def _fix_noise(self, like: Tensor, num_steps: int) -> None:
        """The draws of deterministic calls, for a chain of so many steps."""
        shape = (num_steps + 1, self.num_candidates, self.action_dim)
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(0), device="cpu")
        self.register_buffer("fixed_noise", noise.to(like), persistent=False)

    def _set_spec(self, like: Tensor, spec: TensorSpec | None, action_dim: int | None) -> None:
        leaf = action_spec(spec, self.out_keys[0], action_dim)
        self.spec = Composite({self.out_keys[0]: leaf}).to(like.device)
        self.action_dim = leaf.shape[-1]
        low, high = torch.full(leaf.shape, -1.0), torch.full(leaf.shape, 1.0)
        if spec is not None:
            low, high = leaf.space.low, leaf.space.high
        center, half_range = (high + low) / 2, (high - low) / 2
        buffers = {"low": low, "high": high, "center": center, "half_range": half_range}
        for name, value in buffers.items():
            self.register_buffer(name, value.to(like), persistent=False)

    def to_env(self, action: Tensor) -> Tensor:
        """[-1, 1] to the env's units; what ``clip_action`` has clipped stays within the bounds."""
        action = self.center + self.half_range * action
        return action.clamp(self.low, self.high) if self.clip_action else action  # of the rounding

    def from_env(self, action: Tensor) -> Tensor:
        """The env's units to [-1, 1]."""
        return (action.to(self.center.dtype) - self.center) / self.half_range

    def explore(self, action: Tensor, draw: Tensor) -> Tensor:
        """The action with exploration noise, and clipped if ``clip_action``, in [-1, 1] units.

        Args:
            action: actions of shape ``(*batch, A)``.
            draw: standard normal draws of the same shape.
        """
        # Detached: where a loss differentiates the action, it is not by alpha.
        action = action + self.exploration_noise * self.log_alpha.detach().exp() * draw
        return action.clamp(-1, 1) if self.clip_action else action

    def draws(
        self, num_rows: int, num_candidates: int | None = None, deterministic: bool = False
    ) -> Tensor:
        """All draws of a call, ``(S + 2, N, rows, A)``: those of the chain, then of exploration.

        Args:
            num_rows: number of states.
            num_candidates: ``N``. Default: the policy's.
            deterministic: draws as ``deterministic_draws`` says, and none for exploration.

        Raises:
            ValueError: if ``num_candidates`` is below 1, or exceeds that of the fixed draws.
        """
        num_chains = self.num_candidates if num_candidates is None else num_candidates
        check_at_least(1, num_candidates=num_chains)
        if not deterministic or self.deterministic_draws == "fresh":
            shape = (len(self.fixed_noise) + 1, num_chains, num_rows, self.action_dim)
            draws = torch.randn(shape, dtype=self.center.dtype, device=self.center.device)
            if deterministic:
                draws[-1] = 0.0
            return draws
        if num_chains > self.fixed_noise.shape[1]:
            raise ValueError(
                f"A deterministic call has draws for {self.fixed_noise.shape[1]} candidates, got "
                f"num_candidates={num_chains}. Build the policy with that many."
            )
        draws = self.fixed_noise[:, :num_chains, None].expand(-1, -1, num_rows, -1)
        return torch.cat([draws, torch.zeros_like(draws[:1])])
