"""The parts of a run whose states are a checkpoint: made, checked before any work, restored."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import torch
from torchrl.data import ReplayBuffer

from torchrl_aca.errors import RunError
from torchrl_aca.replay import TRANSITION_KEYS, BufferState, require_index
from torchrl_aca.training.agent import Agent, Stateful
from torchrl_aca.training.checkpoint import Counters, restore
from torchrl_aca.training.collection import Collection
from torchrl_aca.training.config import RunConfig
from torchrl_aca.training.randomness import RandomState


def make_parts(
    agent: Agent, buffer: Any, collection: Collection, means: Stateful, counters: Counters
) -> dict[str, Stateful]:
    """All that a run depends on, by name."""
    return {
        **{f"agent.{name}": part for name, part in agent.state.items()},
        "buffer": as_stateful(buffer, agent),
        "collection": collection,
        "means": means,
        "counters": counters,
        "random": RandomState(),  # the last one, because restoring the others may draw
    }


def check_needs(cfg: RunConfig, agent: Agent, buffer: Any) -> None:
    """Raises `RunError` if the agent has no offline phase, or cannot rewrite the buffer's rows."""
    if cfg.optim.offline_updates and agent.offline_update is None:
        raise RunError(
            f"optim.offline_updates={cfg.optim.offline_updates}: expected 0, because "
            f"algo={cfg.algo.name} has no offline phase. Leave it out."
        )
    if agent.rewrites:
        try:
            require_index(buffer)
        except ValueError as error:
            raise RunError(f"algo={cfg.algo.name} rewrites rows of its buffer: {error}") from error


def check_savable(parts: Mapping[str, Stateful]) -> None:
    """Takes the state of every part once, so that no part fails at the first checkpoint.

    Raises:
        RunError: Naming the part that cannot be saved.
    """
    for name, part in parts.items():
        try:
            torch.save(part.state_dict(), io.BytesIO())
        except Exception as error:  # parts are foreign code
            raise RunError(
                f"the state of {name!r} cannot be saved ({type(error).__name__}: {error}), so "
                "this run would die at its first checkpoint. Mend its state_dict()."
            ) from error


def restore_parts(
    parts: Mapping[str, Stateful],
    checkpoint: dict[str, Any],
    cfg: RunConfig,
    collection: Collection,
) -> None:
    """Brings a checkpoint into the parts.

    Raises:
        RunError: If it does not fit, or has all the updates that are asked for.
    """
    states, total = checkpoint["parts"], cfg.optim.total_updates
    restore(parts, states)
    check_rows(states["buffer"], collection)
    if (done := states["counters"]["updates"]) >= total:
        raise RunError(
            f"resume={cfg.resume}: the run already has {done} updates; expected "
            f"optim.total_updates above that, got {total}. Raise it."
        )


def as_stateful(buffer: Any, agent: Agent) -> Stateful:
    """Returns what saves a buffer: TorchRL's own state would hold the empty part as well.

    Raises:
        RunError: If the buffer has more of a state than its rows.
    """
    if not isinstance(buffer, ReplayBuffer):
        return buffer
    try:
        return BufferState(buffer, (*TRANSITION_KEYS, *agent.extra_keys, *agent.rewrites))
    except ValueError as error:
        raise RunError(str(error)) from error


def check_rows(state: Mapping[str, Any], collection: Collection) -> None:
    """Raises `RunError` if a checkpoint's replay rows are not those of the environment."""
    rows = state.get("online", state)["rows"]
    spec = {**collection.env.observation_spec, **collection.env.full_action_spec}
    for key in rows.keys() & spec.keys():
        expected, got = spec[key].shape[-1], rows[key].shape[-1]
        if expected != got:
            raise RunError(
                f"the checkpoint's replay rows have {got} numbers under {key!r}; the environment "
                f"gives {expected}. Resume with the unchanged config.yaml of the run."
            )
