"""The seam between a training loop and an algorithm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

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
        rewrites: Entries of a row that `update` changes in its batch, and the loop then in the
            buffer; each with the entry of the transition that it begins as.
    """

    policy: TensorDictModuleBase
    update: Update
    state: dict[str, Stateful]
    offline_update: Update | None = None
    extra_keys: tuple[NestedKey, ...] = ()
    rewrites: Mapping[NestedKey, NestedKey] = field(default_factory=dict)
