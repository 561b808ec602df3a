"""Rows that are worth something only when their episode has ended."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_aca.replay.buffer import TRANSITION_KEYS

__all__ = ["FinishedEpisodes"]


class FinishedEpisodes:
    """Holds collected rows back until their episode has ended, and then labels them.

    Call it with what a collector gives; it returns what may go to the replay buffer. An episode
    that was broken off, because its environment was reset without having ended, is dropped: the
    next row of that environment does not begin where the last one led to.

    Args:
        label: takes the rows of one whole episode, shape (n,) in order, and returns them with
            more entries.

    Examples:
        >>> from torchrl_aca.replay import FinishedEpisodes
        >>> def label(rows):
        ...     return rows.set("length", torch.full((len(rows), 1), len(rows)))
        >>> finished = FinishedEpisodes(label)
        >>> len(finished(data.unsqueeze(0)))  # one environment, four steps, none of them the last
        0
    """

    def __init__(self, label: Callable[[TensorDictBase], TensorDictBase]) -> None:
        self._label = label
        self._pending: dict[int, list[TensorDictBase]] = {}

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        """Returns the labelled rows of the episodes that have ended, (n,); n is often 0.

        Args:
            data: what a collector gives, of shape (num_envs, steps).
        """
        data = data.select(*TRANSITION_KEYS)
        finished = [self._label(rows) for rows in self._add(data)]
        return torch.cat(finished) if finished else data.reshape(-1)[:0]

    def _add(self, data: TensorDictBase) -> list[TensorDictBase]:
        episodes = []
        for env, rows in enumerate(data.unbind(0)):
            chunks = self._pending.setdefault(env, [])
            if chunks and not _follows(chunks[-1], rows):
                chunks.clear()
            ends = rows["next", "done"].squeeze(-1).nonzero().squeeze(-1) + 1
            *whole, rest = rows.tensor_split(ends.tolist())
            for part in whole:
                episodes.append(torch.cat([*chunks, part]))
                chunks.clear()
            if len(rest):
                chunks.append(rest.clone())
        return episodes

    def state_dict(self) -> dict[str, Any]:
        """Return the rows that are held back, by environment."""
        held: dict[int, dict[str, Any]] = {}
        for env, chunks in self._pending.items():
            if chunks:
                rows: Any = torch.cat(chunks)
                held[env] = rows.flatten_keys(".").to_dict()
        return {"pending": held}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self._pending = {
            env: [TensorDict(rows).auto_batch_size_(1).unflatten_keys(".")]
            for env, rows in state_dict["pending"].items()
        }


def _follows(before: TensorDictBase, after: TensorDictBase) -> bool:
    """Whether the first row of ``after`` begins where the last one of ``before`` led to."""
    return torch.equal(before["next", "observation"][-1], after["observation"][0])
