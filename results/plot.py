"""Evaluation returns of several runs in one figure.

    python results/plot.py results/quickstart/curve.png results/quickstart/seed* --line random=-280

Needs the `recipes` extra. Reads config.yaml and eval.csv of each run directory.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from omegaconf import OmegaConf


def plot_run(axes: Axes, run_dir: Path) -> float:
    """Draws mean +- std over episodes against updates; returns the frames of an update."""
    config = OmegaConf.load(run_dir / "config.yaml")
    with open(run_dir / "eval.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    updates, mean, std = (
        [float(row[name]) for row in rows] for name in ("updates", "return_mean", "return_std")
    )
    label = f"{config.algo.name}, seed {config.seed}"
    (line,) = axes.plot(updates, mean, marker="o", markersize=3, label=label)
    low = [m - s for m, s in zip(mean, std, strict=True)]
    high = [m + s for m, s in zip(mean, std, strict=True)]
    axes.fill_between(updates, low, high, alpha=0.15, color=line.get_color(), linewidth=0)
    axes.set_title(config.env.name)
    return 1 / config.optim.utd_ratio


def main() -> None:
    """Parses the command line and writes the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("run_dirs", type=Path, nargs="+")
    parser.add_argument("--line", action="append", default=[], help="NAME=RETURN, drawn dashed")
    arguments = parser.parse_args()

    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.subplots()
    frames_per_update = {plot_run(axes, run_dir) for run_dir in arguments.run_dirs}
    for text in arguments.line:
        name, value = text.split("=")
        axes.axhline(float(value), color="0.4", linestyle="--", linewidth=1, label=name)
    unit = " or ".join(f"{frames:g}" for frames in sorted(frames_per_update))
    axes.set(xlabel=f"updates ({unit} env frames each)", ylabel="evaluation return")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(arguments.output, dpi=150)


if __name__ == "__main__":
    main()
