"""When something is due: an update, what happens at intervals, the end of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from torchrl_aca.training.config import RunConfig


def updates_due(cfg: RunConfig, frames: int) -> int:
    """Returns how many updates belong to so many frames: exact, with no remainder to carry."""
    trained = max(0, frames - cfg.collector.warmup_frames)
    return int(trained * Fraction(str(cfg.optim.utd_ratio)))


def passed(interval: int, since: int, now: int) -> bool:
    """Tells whether a multiple of `interval` lies in the updates after `since`, up to `now`."""
    return since // interval < now // interval


def is_better(value: float, best: float | None) -> bool:
    """Tells whether an evaluation is above the best one so far; the first one always is."""
    return best is None or value > best or math.isnan(best)


def has_reached(evaluations: Sequence[Mapping[str, Any]], stop_return: float | None) -> bool:
    """Tells whether the latest two evaluations have averaged `stop_return`."""
    latest = [float(row["return_mean"]) for row in evaluations[-2:]]
    return stop_return is not None and len(latest) == 2 and sum(latest) / 2 >= stop_return
