"""Data sets by name, for `torchrl.data.datasets.load_dataset`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl.data import ReplayBuffer
from torchrl.data.datasets import register_dataset

from torchrl_aca.offline.dataset import OfflineDataset

ROOT = "datasets"  # where data sets are found by name


def register_datasets() -> None:
    """Makes `load_dataset("aca:<name>", batch_size=..., root=...)` return a replay buffer.

    The data set is `<root>/<name>`, and `root` is "datasets" if it is not given. `verify` and
    `clip_actions` go to `OfflineDataset.load`, all other keywords to the buffer. Calling this more
    than once does no harm.
    """
    register_dataset("aca", load_replay_buffer, replace=True)


def load_replay_buffer(
    name: str,
    *,
    batch_size: int,
    root: str | Path = ROOT,
    verify: bool = False,
    clip_actions: float | None = None,
    **kwargs: Any,
) -> ReplayBuffer:
    """Returns the replay buffer of the data set in `<root>/<name>`; see `register_datasets`."""
    dataset = OfflineDataset.load(Path(root) / name, verify=verify, clip_actions=clip_actions)
    return dataset.replay_buffer(batch_size, **kwargs)
