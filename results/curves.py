"""Learning curves as plot.py and report.py draw them: a panel for each task, means, intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from intervals import interval, mean

Returns = dict[float, float]  # of a run, by updates or frames
MOST_INSIDE = 5  # entries of a legend within a panel


def shared(runs: Sequence[Returns]) -> list[float]:
    """The updates or frames at which all of these runs were evaluated."""
    return sorted(set.intersection(*(set(run) for run in runs))) if runs else []


def make_panels(
    tasks: Sequence[str], xlabel: str, ylabel: str = "evaluation return"
) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a panel for each task."""
    width = 6.4 if len(tasks) == 1 else 4 * len(tasks)
    figure = Figure(figsize=(width, 4 if len(tasks) == 1 else 3.2), layout="constrained")
    panels = dict(zip(tasks, figure.subplots(1, len(tasks), squeeze=False)[0], strict=True))
    for task, axes in panels.items():
        axes.set(title=task, xlabel=xlabel, ylabel=ylabel)
        axes.grid(alpha=0.3)
    return figure, panels


def draw_marks(axes: Axes, lines: Mapping[str, float]) -> None:
    """The end of an offline phase, which is at zero, and returns to compare with, dashed."""
    if axes.dataLim.x0 < 0:
        axes.axvline(0, color="0.4", linestyle=":", linewidth=1, label="end of the offline phase")
    for label, value in lines.items():
        axes.axhline(value, color="0.4", linestyle="--", linewidth=1, label=label)


def draw_mean(axes: Axes, label: str, runs: Sequence[Returns], color: str) -> Line2D:
    """The mean of runs where all were evaluated, with its 95 % interval where there are several.

    What longer runs have beyond that is dotted, each for itself.
    """
    places = shared(runs)
    values = [np.array([run[place] for run in runs]) for place in places]
    means = [v.mean() for v in values]
    (line,) = axes.plot(places, means, marker="o", markersize=3, label=label, color=color)
    if places and len(runs) > 1:
        low, high = zip(*(interval(mean, [v]) for v in values), strict=True)
        axes.fill_between(places, low, high, alpha=0.2, color=color, linewidth=0)
    for run in runs:
        beyond = sorted(place for place in run if not places or place >= places[-1])
        returns = [run[place] for place in beyond]
        if len(beyond) > 1:
            axes.plot(beyond, returns, linestyle=":", linewidth=1, color=color)
    return line


def draw_legends(figure: Figure) -> None:
    """A legend in each panel; where that would hide curves, one for all of them below."""
    labelled = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if len(labelled) <= MOST_INSIDE:
        for axes in figure.axes:
            axes.legend(frameon=False, fontsize="small")
        return
    columns = max(4, 2 * len(figure.axes))
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.2 * -(-len(labelled) // columns))
    figure.legend(
        labelled.values(),
        labelled.keys(),
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize="small",
    )
