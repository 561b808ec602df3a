"""Returns that count as 0 and 100 in normalised scores."""

from __future__ import annotations

# Of a random and of an expert policy, as D4RL gives them, the same for all its versions.
REFERENCE_SCORES = {"HalfCheetah": (-280.178953, 12135.0)}


def reference_scores(env_id: str | None) -> tuple[float, float] | None:
    """Returns D4RL's (random, expert) returns for a Gymnasium id; None where none are known."""
    return REFERENCE_SCORES.get((env_id or "").rpartition("-v")[0])
