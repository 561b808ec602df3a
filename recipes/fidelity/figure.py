"""The figure and the table of the fidelity of short chains."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.figure import Figure

PANELS = {
    "value_difference": "mean value, in spreads of a state's candidates",
    "std_ratio": "std of the candidates, over that of the whole chain",
    "rejected": "share of states with p < 0.05",
}
Row = dict[str, Any]


def averaged(rows: Sequence[Row]) -> list[Row]:
    """Returns one row for each spacing and number of gradients: means, and the worst of each."""

    def chain(row: Row) -> tuple[str, int]:
        return row["spacing"], row["gradients"]

    means = []
    for (spacing, gradients), group in groupby(sorted(rows, key=chain), chain):
        same = list(group)
        row: Row = {"spacing": spacing, "gradients": gradients, "levels": same[0]["levels"]}
        for key in PANELS:
            row[key] = mean(r[key] for r in same)
        row["worst_value_difference"] = max((r["value_difference"] for r in same), key=abs)
        row["worst_std_ratio"] = max((r["std_ratio"] for r in same), key=lambda x: abs(x - 1))
        means.append(row)
    return means


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draws the measures against the number of gradients, a line for each spacing."""
    means = averaged(rows)
    spacings = list(dict.fromkeys(row["spacing"] for row in rows))
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for axes, (key, label) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
        for spacing in spacings:
            line = [row for row in means if row["spacing"] == spacing]
            axes.plot(
                [row["gradients"] for row in line],
                [row[key] for row in line],
                marker="o",
                markersize=4,
                label=spacing,
            )
        axes.set_xlabel("critic gradients of a chain")
        axes.set_title(label, fontsize=9)
    axes.legend(fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def print_table(rows: Sequence[Row]) -> None:
    """Prints the means over all checkpoints, and the worst checkpoint, in Markdown."""
    print("| spacing | gradients | levels | mean value (worst) | std (worst) | p < 0.05 |")
    print("|---|--:|---|--:|--:|--:|")
    for row in sorted(averaged(rows), key=lambda row: (row["gradients"], row["spacing"])):
        print(
            f"| {row['spacing']} | {row['gradients']} | {row['levels']} "
            f"| {row['value_difference']:+.2f} ({row['worst_value_difference']:+.2f}) "
            f"| {row['std_ratio']:.3f} ({row['worst_std_ratio']:.3f}) | {row['rejected']:.2f} |"
        )
