"""Recorded episodes for the tests of offline data, as NumPy arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchrl_aca.offline import DatasetWriter, OfflineDataset

OBSERVATION_DIM, ACTION_DIM = 3, 2


def episode(length: int, end: str = "truncated", seed: int = 0) -> dict[str, np.ndarray]:
    """One random episode in float64, as keywords of `add_episode`."""
    random = np.random.default_rng([length, seed])
    states = random.normal(size=(length + 1, OBSERVATION_DIM))
    flags = {name: np.zeros(length, bool) for name in ("terminated", "truncated")}
    if end != "none":
        flags[end][-1] = True
    return {
        "observation": states[:-1],
        "action": random.uniform(-1, 1, (length, ACTION_DIM)),
        "next_observation": states[1:].copy(),
        "reward": random.normal(size=length),
        **flags,
    }


def joined(episodes: list[dict[str, np.ndarray]], name: str) -> np.ndarray:
    return np.concatenate([each[name] for each in episodes])


def write(path: Path, episodes: list[dict[str, Any]], **options: Any) -> OfflineDataset:
    with DatasetWriter(path, OBSERVATION_DIM, ACTION_DIM, **options) as writer:
        for each in episodes:
            writer.add_episode(**each)
        return writer.finish(name="test", reference_scores=(-2, 6))
