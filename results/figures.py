"""Figures of a study: values with intervals, performance profiles, and values by a setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from evaluations import Scores
from intervals import interval, share_above


def draw_points(path: Path, xlabel: str, points: dict[str, tuple[float, Any]]) -> None:
    """Values with their intervals, one below the other."""
    figure = Figure(figsize=(5.5, 1 + 0.35 * len(points)), layout="constrained")
    axes = figure.subplots()
    for place, (value, found) in enumerate(points.values()):
        if found:
            axes.plot(found, [place, place], linewidth=6, alpha=0.4, color="C0")
        axes.plot([value], [place], "|", color="black", markersize=12)
    axes.set_yticks(range(len(points)), list(points))
    axes.invert_yaxis()
    axes.set_xlabel(xlabel)
    axes.grid(alpha=0.3, axis="x")
    figure.savefig(path, dpi=120)


def draw_profiles(found: Scores, path: Path) -> None:
    """The share of runs above each score."""
    figure = Figure(figsize=(5.5, 3.5), layout="constrained")
    axes = figure.subplots()
    thresholds = np.linspace(0, max(1.2, *(v.max() for t in found.values() for v in t)), 41)
    for method, tasks in found.items():
        shares = [share_above(threshold)(*tasks) for threshold in thresholds]
        (line,) = axes.step(thresholds, shares, where="post", label=method)
        bands = [interval(share_above(threshold), tasks) for threshold in thresholds]
        if None not in bands:
            low, high = zip(*bands, strict=True)
            axes.fill_between(
                thresholds, low, high, alpha=0.2, color=line.get_color(), linewidth=0, step="post"
            )
    axes.set(xlabel="score", ylabel="share of runs above")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def draw_settings(axes: Axes, lines: Mapping[str, Mapping[int, Sequence[float]]]) -> None:
    """A line through the means at each setting, and a point for each value."""
    for label, values in lines.items():
        settings = sorted(values)
        (drawn,) = axes.plot(settings, [np.mean(values[x]) for x in settings], label=label)
        for x in settings:
            axes.plot([x] * len(values[x]), values[x], "o", ms=4, color=drawn.get_color())
    axes.set_xticks(sorted({x for values in lines.values() for x in values}))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize="small")
