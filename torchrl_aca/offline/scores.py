"""Returns that count as 0 and 100 in normalised scores."""

from __future__ import annotations

from typing import TypeVar

import torch

Number = TypeVar("Number", float, torch.Tensor)
Scores = tuple[float, float]

# Of a random and of an expert policy, as D4RL gives them, the same for all its versions.
REFERENCE_SCORES = {"HalfCheetah": (-280.178953, 12135.0)}


def reference_scores(env_id: str | None) -> Scores | None:
    """Returns D4RL's (random, expert) returns for a Gymnasium id; None where none are known."""
    return REFERENCE_SCORES.get((env_id or "").rpartition("-v")[0])


def normalized_score(episode_return: Number, scores: Scores) -> Number:
    """Returns ``100 (R - low) / (high - low)``."""
    low, high = scores
    return 100 * (episode_return - low) / (high - low)
