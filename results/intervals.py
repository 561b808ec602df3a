"""Statistics of a few runs, as the field asks for them: means, their intervals, comparisons.

Scores of a method are one array for each task, with a number for each seed. Intervals are bootstrap
percentiles, each task's runs drawn anew among themselves (stratified), by SciPy. What they say is
from Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 2000

Statistic = Callable[..., Any]  # of one array for each task, along the last axis
Interval = tuple[float, float] | None


def mean(*tasks: np.ndarray, axis: int = -1) -> Any:
    """The mean over the runs of all tasks."""
    return np.concatenate(tasks, axis).mean(axis)


def interquartile_mean(*tasks: np.ndarray, axis: int = -1) -> Any:
    """The mean of the middle half of the runs of all tasks."""
    return stats.trim_mean(np.concatenate(tasks, axis), 0.25, axis)


def share_above(threshold: float) -> Statistic:
    """The share of runs with a score above `threshold`: a point of a performance profile."""

    def share(*tasks: np.ndarray, axis: int = -1) -> Any:
        return (np.concatenate(tasks, axis) > threshold).mean(axis)

    return share


def probability_of_improvement(*tasks: np.ndarray, axis: int = -1) -> Any:
    """How likely a run of one method is above one of another; the mean over tasks.

    The first half of the arrays is the one method's, the second half the other's. Equal scores
    count one half.
    """
    half = len(tasks) // 2
    each = []
    for x, y in zip(tasks[:half], tasks[half:], strict=True):
        x, y = x[..., :, None], y[..., None, :]
        each.append(((x > y) + 0.5 * (x == y)).mean((-2, -1)))
    return np.mean(each, axis=0)


def interval(statistic: Statistic, tasks: Sequence[np.ndarray]) -> Interval:
    """The interval of a statistic, or None where a task has a single run."""
    if min(map(len, tasks)) < 2:
        return None
    found = stats.bootstrap(
        tasks,
        statistic,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)
