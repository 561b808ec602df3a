"""Numbers and figures of a study, from the directories of its runs or from its CSV.

    python results/report.py runs/studies/table2 results/table2
    python results/report.py results/table2/evaluations.csv results/table2 --updates 100000

Writes one tidy CSV with every evaluation, a card with the tables, and a figure for each question:
how fast (curves.png), how good over all tasks (aggregate.png), how many runs are how good
(profiles.png), is one method better than another (improvement.png). Needs SciPy and the `recipes`
extra.

Scores are returns on a scale of each task: 0 is the mean return before training, 1 the best mean of
a method in this study. Methods are compared at the same updates: on each task the last at which all
its runs were evaluated, or `--updates`.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from curves import draw_mean, make_panels
from evaluations import (
    COLUMNS,
    Row,
    Scores,
    by_seed,
    compared_at,
    names,
    read_csv,
    read_runs,
    returns,
    scores,
)
from intervals import (
    interquartile_mean,
    interval,
    mean,
    probability_of_improvement,
    share_above,
)

PAPER = Path(__file__).parent / "paper.csv"


# --- tables ---------------------------------------------------------------------------------------


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, numbers to the right."""
    ruler = "|---|" + "--:|" * (len(header) - 1)
    return "\n".join(["| " + " | ".join(header) + " |", ruler, *map(_line, lines)])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def number(value: float) -> str:
    """A return as the paper writes it."""
    return f"{value:.1f}" if abs(value) < 100 else f"{value:.0f}"


def ranged(value: float, found: tuple[float, float] | None) -> str:
    """A score with its interval."""
    return f"{value:.2f}" + (f" [{found[0]:.2f}, {found[1]:.2f}]" if found else "")


def cell(values: np.ndarray) -> str:
    """Mean, interval and number of seeds."""
    if not len(values):
        return ""
    found = interval(mean, [values])
    band = f" [{number(found[0])}, {number(found[1])}]" if found else ""
    return f"{number(values.mean())}{band} (n={len(values)})"


def task_table(rows: Sequence[Row], updates: float | None) -> str:
    """The paper's table: tasks by methods, and the paper's own numbers at the same updates."""
    methods, paper, lines = names(rows, "method"), read_csv(PAPER), []
    for task in names(rows, "task"):
        at = compared_at(rows, task, updates)
        values = [cell(returns(rows, task, method, at)) for method in methods]
        lines.append([f"{task}, {at:,.0f} updates", *values])
        told = {
            row["method"]: f"{number(row['return_mean'])} ± {number(row['half_width'])}"
            for row in paper
            if (row["task"], row["updates"]) == (task, at)
        }
        if told:
            lines.append(["*paper*", *(told.get(method, "") for method in methods)])
    return markdown(["", *methods], lines)


def aggregate_table(rows: Sequence[Row], found: Scores) -> str:
    """Interquartile mean and mean over all tasks, and the speed."""
    lines = []
    for method, tasks in found.items():
        cells = [
            ranged(float(statistic(*tasks)), interval(statistic, tasks))
            for statistic in (interquartile_mean, mean)
        ]
        speeds = [row["updates_per_second"] for row in rows if row["method"] == method]
        known = [speed for speed in speeds if speed != ""]
        lines.append([method, *cells, f"{np.median(known):.2f}" if known else ""])
    return markdown(["method", "interquartile mean", "mean", "updates/s"], lines)


# --- figures --------------------------------------------------------------------------------------


def draw_curves(rows: Sequence[Row], path: Path) -> None:
    """A panel for each task: the mean over seeds and its interval."""
    figure, panels = make_panels(names(rows, "task"), "updates")
    for task, axes in panels.items():
        for method in names(rows, "method"):
            if runs := list(by_seed(rows, task, method).values()):
                draw_mean(axes, f"{method}, n={len(runs)}", runs)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


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


# --- the report -----------------------------------------------------------------------------------


def write_report(rows: Sequence[Row], out: Path, updates: float | None) -> str:
    """Writes the CSV, the figures and the card, and returns the card."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "evaluations.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    draw_curves(rows, out / "curves.png")
    parts = [
        f"# {out.name}\n",
        "Mean return and 95 % bootstrap interval over n seeds; the paper's ± is a 95 % interval.\n",
        task_table(rows, updates),
        "\n![curves](curves.png)",
    ]
    tasks, found = scores(rows, updates)
    if found:
        parts += [aggregates(rows, tasks, found, out)]
    card = "\n".join(parts) + "\n"
    (out / "card.md").write_text(card)
    return card


def aggregates(rows: Sequence[Row], tasks: Sequence[str], found: Scores, out: Path) -> str:
    """The part of the card over all tasks, and its figures."""
    statistic = interquartile_mean
    points = {m: (float(statistic(*t)), interval(statistic, t)) for m, t in found.items()}
    draw_points(out / "aggregate.png", "interquartile mean of the scores", points)
    draw_profiles(found, out / "profiles.png")
    text = (
        f"\nScores over {', '.join(tasks)}: 0 is the mean before training, 1 the best method's "
        f"mean. Intervals are stratified over tasks.\n\n{aggregate_table(rows, found)}\n\n"
        "![aggregate](aggregate.png)\n\n![profiles](profiles.png)"
    )
    first, *others = reversed(found)
    if others:
        pairs = {f"{first} > {other}": [*found[first], *found[other]] for other in others}
        improvement = probability_of_improvement
        points = {k: (float(improvement(*t)), interval(improvement, t)) for k, t in pairs.items()}
        draw_points(out / "improvement.png", "probability of improvement", points)
        text += "\n\n![improvement](improvement.png)"
    return text


def main() -> None:
    """Parses the command line, writes the report and prints the card."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path, help="a folder of runs, or an evaluations.csv")
    parser.add_argument("out", type=Path, help="the folder of the report")
    parser.add_argument("--updates", type=float, help="where to compare")
    arguments = parser.parse_args()
    study = arguments.study
    rows = read_csv(study) if study.suffix == ".csv" else read_runs(study)
    print(write_report(rows, arguments.out, arguments.updates))


if __name__ == "__main__":
    main()
