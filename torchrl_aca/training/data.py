"""Transitions: the replay buffer and its state, the episodes under way, the check for NaN."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from torchrl_aca.training.errors import RunError

TRANSITION_KEYS = (
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


def transitions(data: TensorDictBase) -> TensorDictBase:
    """Flattens collected data of shape (num_envs, steps) and keeps what learning needs."""
    return data.select(*TRANSITION_KEYS).reshape(-1)


class BufferState:
    """The filled part of a replay buffer, for checkpoints."""

    def __init__(self, buffer: ReplayBuffer, keys: Sequence[NestedKey] = TRANSITION_KEYS) -> None:
        """Takes the buffer, which is only read when a state is asked for, and the keys to keep."""
        self.buffer, self.keys = buffer, keys

    def state_dict(self) -> dict[str, Any]:
        """Returns the rows in storage order and the writer's position."""
        return {"rows": self._rows(), "writer": self.buffer.writer.state_dict()}

    def _rows(self) -> dict[str, torch.Tensor]:
        size = len(self.buffer)
        if size == 0:  # a storage that is allocated lazily cannot be read yet
            return {}
        rows = self.buffer[:size].select(*self.keys, strict=False).flatten_keys(".")
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


class EpisodeTracker:
    """Sums rewards per environment and keeps the returns of the latest finished episodes."""

    def __init__(self, num_envs: int, window: int = 20) -> None:
        """Tracks `num_envs` environments and averages over the last `window` episodes."""
        self.returns = torch.zeros(num_envs, dtype=torch.float64)
        self.lengths = torch.zeros(num_envs, dtype=torch.int64)
        self.finished = 0
        self.latest: deque[tuple[float, int]] = deque(maxlen=window)

    def add(self, data: TensorDictBase) -> None:
        """Adds collected data of shape (num_envs, steps)."""
        rewards, dones = data["next", "reward"].squeeze(-1), data["next", "done"].squeeze(-1)
        for reward, done in zip(rewards.unbind(-1), dones.unbind(-1), strict=True):
            self.returns += reward
            self.lengths += 1
            if done.any():
                ended = zip(self.returns[done].tolist(), self.lengths[done].tolist(), strict=True)
                self.latest.extend(ended)
                self.finished += int(done.sum())
                self.returns[done], self.lengths[done] = 0, 0

    def metrics(self) -> dict[str, float]:
        """Returns the mean return and length of the latest training episodes, and their count."""
        metrics = {"train_episodes": float(self.finished)}
        if self.latest:
            returns, lengths = zip(*self.latest, strict=True)
            metrics["train_return"] = sum(returns) / len(returns)
            metrics["train_episode_length"] = sum(lengths) / len(lengths)
        return metrics

    def reset(self) -> None:
        """Forgets the unfinished episodes, for environments that start afresh."""
        self.returns.zero_()
        self.lengths.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Returns the running sums and the latest episodes."""
        return {
            "returns": self.returns.clone(),
            "lengths": self.lengths.clone(),
            "finished": self.finished,
            "latest": list(self.latest),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.returns.copy_(state_dict["returns"])
        self.lengths.copy_(state_dict["lengths"])
        self.finished = state_dict["finished"]
        self.latest.clear()
        self.latest.extend(state_dict["latest"])


def check_finite(data: TensorDictBase, env_name: str, frames: int) -> None:
    """Raises if collected data holds NaN or infinity.

    Raises:
        RunError: Naming the environment, the frame count and the key.
    """
    for key in (("next", "observation"), ("next", "reward"), "action"):
        if not data[key].isfinite().all():
            name = key if isinstance(key, str) else ".".join(key)
            raise RunError(
                f"{env_name} gave a NaN or infinite {name!r} after {frames} frames; expected "
                "finite numbers. These transitions were not stored. Look at the environment's "
                "reward and physics, or at the learning rate if the actions blew up first."
            )
