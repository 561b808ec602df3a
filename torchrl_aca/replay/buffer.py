"""Transitions, the replay buffer that keeps them, and its state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer, TensorStorage

from torchrl_aca.replay.rows import require_plain

__all__ = [
    "TRANSITION_KEYS",
    "BufferState",
    "make_replay_buffer",
    "require_index",
    "transitions",
    "write_back",
]

TRANSITION_KEYS: tuple[NestedKey, ...] = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


def make_replay_buffer(capacity: int, batch_size: int) -> TensorDictReplayBuffer:
    """Builds a uniform replay buffer in main memory, allocated at the first `extend`."""
    return TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=batch_size)


def transitions(
    data: TensorDictBase,
    extra_keys: Sequence[NestedKey] = (),
    rewritten: Mapping[NestedKey, NestedKey] | None = None,
) -> TensorDictBase:
    """Flattens collected data of shape (num_envs, steps) and keeps what learning needs.

    Args:
        data: What a collector gives.
        extra_keys: What a method needs in a row besides the transition.
        rewritten: Entries that a method will rewrite, each with the one that it begins as.
    """
    rows = data.select(*TRANSITION_KEYS, *extra_keys).reshape(-1)
    for key, first in (rewritten or {}).items():
        rows[key] = rows[first].clone()
    return rows


def require_index(buffer: Any) -> None:
    """Refuses a buffer whose batches do not tell where their rows lie.

    Raises:
        ValueError: If its batches have no "index", or its rows cannot be written one by one.
    """
    storage = getattr(buffer, "storage", None)
    one_by_one = isinstance(storage, TensorStorage) and storage.ndim == 1
    if not isinstance(buffer, TensorDictReplayBuffer) or not one_by_one:
        raise ValueError(
            "rows can be rewritten in a TensorDictReplayBuffer with a TensorStorage of ndim=1 "
            f"alone, whose batches hold the index of each row; got a {type(buffer).__name__} with "
            f"{storage!r}."
        )


def write_back(
    buffer: TensorDictReplayBuffer, batch: TensorDictBase, keys: Iterable[NestedKey]
) -> None:
    """Writes entries of a sampled batch to the rows that it was sampled from, by their index."""
    rows = buffer.storage[:]
    for key in keys:
        column = rows.get(key)
        index = batch["index"].to(column.device)
        column.index_copy_(0, index, batch[key].to(column))


class BufferState:
    """The filled part of a plain replay buffer, for checkpoints.

    Raises:
        ValueError: If there is more that the next batches depend on: a sampler with a state of its
            own, a transform, or a storage that is not of one dimension.
    """

    def __init__(self, buffer: ReplayBuffer, keys: Sequence[NestedKey] = TRANSITION_KEYS) -> None:
        """Takes the buffer, which is only read when a state is asked for, and the keys to keep."""
        require_plain(buffer, "saved")
        self.buffer, self.keys = buffer, keys

    def state_dict(self) -> dict[str, Any]:
        """Returns the rows in storage order and the writer's position."""
        return {"rows": self._rows(), "writer": self.buffer.writer.state_dict()}

    def _rows(self) -> dict[str, torch.Tensor]:
        size = len(self.buffer)
        if size == 0:  # a storage that is allocated lazily cannot be read yet
            return {}
        rows = self.buffer.storage[:size].select(*self.keys, strict=False).flatten_keys(".")
        if size < self.buffer.storage.max_size:
            # A view would be written with the whole, mostly empty storage behind it.
            rows = rows.clone()
        return rows.to_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Replaces the buffer's content."""
        self.buffer.empty()
        if state_dict["rows"]:
            rows = TensorDict(state_dict["rows"]).auto_batch_size_(1).unflatten_keys(".")
            self.buffer.extend(rows)
        self.buffer.writer.load_state_dict(state_dict["writer"])
