"""The seam between a training loop and an algorithm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_aca.replay import transitions
from torchrl_aca.training.policy import PolicyBuilder

Rows = Callable[[TensorDictBase], TensorDictBase]
Update = Callable[[TensorDictBase], TensorDictBase]


class Stateful(Protocol):
    """Anything that a checkpoint can hold."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state as tensors, numbers, strings and containers of them."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Restore what `state_dict` returned."""


@dataclass
class Agent:
    """All that a training loop needs to know of an algorithm.

    Attributes:
        policy: Maps observations to actions. The collector calls it under
            `ExplorationType.RANDOM`, the evaluation under `ExplorationType.DETERMINISTIC`.
        update: Takes a batch of transitions of shape (B,), makes one update and returns detached
            scalar metrics. A metric that is not there in every update is averaged over the
            updates that report it. It leaves the batch as it is, but for what it `rewrites`.
        state: Everything that the next update depends on, by name: the loss with its targets,
            optimisers, schedulers, counters. It is what a checkpoint saves and restores.
        offline_update: As `update`, for the phase on the data set alone; None for a method that
            has no such phase.
        extra_keys: What a row of the replay buffer holds besides the transition.
        rows: Takes collected data of shape (num_envs, steps) and returns the rows for the replay
            buffer, (n,), where n may be 0; None: all transitions with their `extra_keys`.
        offline_rows: Takes a data set of shape (n,), episode after episode, and returns it with
            its `extra_keys`; None: it has them already.
        rewrites: Entries of a row that `update` changes in its batch, and the loop then in the
            buffer; each with the entry of the transition that it begins as.
        policy_builder: Builds `policy` anew, without weights, for `load_policy`; None: the run
            writes no policies beside its checkpoints.
    """

    policy: TensorDictModuleBase
    update: Update
    state: dict[str, Stateful]
    offline_update: Update | None = None
    extra_keys: tuple[NestedKey, ...] = ()
    rows: Rows | None = None
    offline_rows: Rows | None = None
    rewrites: Mapping[NestedKey, NestedKey] = field(default_factory=dict)
    policy_builder: PolicyBuilder | None = None

    @property
    def num_parameters(self) -> int:
        """How many parameters are trained, temperatures left out, as the papers count."""
        modules = (part for part in self.state.values() if isinstance(part, nn.Module))
        parameters = (p for module in modules for p in module.parameters())
        return sum(p.numel() for p in parameters if p.requires_grad and p.ndim)

    def rows_of(self, data: TensorDictBase) -> TensorDictBase:
        """Returns what of collected data goes to the replay buffer."""
        if self.rows is not None:
            return self.rows(data)
        return transitions(data, self.extra_keys, self.rewrites)

    def offline_rows_of(self, data: TensorDictBase) -> TensorDictBase:
        """Returns a data set with what the method needs in its rows."""
        return self.offline_rows(data) if self.offline_rows else data
