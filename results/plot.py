"""Evaluation returns of several runs: one figure, and the same numbers as a table.

    python results/plot.py OUT.png runs/one runs/another --line random=5
    python results/plot.py OUT.png runs/mine --x frames

Runs that differ in nothing but their seed are one curve: the mean over seeds with a 95 % bootstrap
interval. A curve of a single run has a band of one standard deviation over episodes. Each task has
a panel. Updates of an offline phase are below zero, so that the online phases of all runs begin at
the same place; on an axis of frames they are all at zero, and the last one counts. The table is
printed in Markdown. Needs the `recipes` extra; reads config.yaml and eval.csv of each run
directory, or of all below a folder.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.axes import Axes
from omegaconf import OmegaConf

from curves import draw_legends, draw_marks, draw_mean, make_panels, shared
from evaluations import read_evaluations

# Not what a run is.
OWN_KEYS = ("seed", "run_dir", "resume", "existing", "logger", "checkpoint", "video")


@dataclass(frozen=True)
class Run:
    """What a curve takes from a run directory."""

    dir: Path
    config: dict[str, Any]
    evaluations: list[dict[str, float]]

    @classmethod
    def read(cls, run_dir: Path) -> Run:
        config, rows = read_evaluations(run_dir)
        return cls(run_dir, OmegaConf.to_container(config), rows)

    @property
    def settings(self) -> str:
        """Everything but the seed and where the run was written, as comparable text."""
        return str({k: v for k, v in sorted(self.config.items()) if k not in OWN_KEYS})

    @property
    def task(self) -> str:
        """The environment's name."""
        return self.config["env"]["name"]

    def returns(self, x: str = "updates", name: str = "return_mean") -> dict[float, float]:
        """A column of its evaluations by another one."""
        return {row[x]: row[name] for row in self.evaluations}


@dataclass(frozen=True)
class Curve:
    """Runs of equal settings, by seed."""

    runs: list[Run]

    def __post_init__(self) -> None:
        seeds = [run.config["seed"] for run in self.runs]
        if len(set(seeds)) < len(seeds):
            dirs = ", ".join(str(run.dir) for run in self.runs)
            raise SystemExit(
                f"error: {dirs} have equal settings and seeds {seeds}. Name each once."
            )

    @property
    def label(self) -> str:
        config, seeds = self.runs[0].config, [run.config["seed"] for run in self.runs]
        phase = config["optim"].get("offline_updates")
        without = ", no offline data" if config.get("offline_fraction") == 0 and not phase else ""
        count = f"{len(seeds)} seeds" if len(seeds) > 1 else f"seed {seeds[0]}"
        return f"{config['algo']['name']}{without}, {count}"

    def at(self, updates: float) -> list[float]:
        """The return of each run after so many updates; none where there was no evaluation."""
        runs = [run.returns() for run in self.runs]
        return [run[updates] for run in runs if updates in run]

    def shared(self) -> list[float]:
        """The updates at which all runs were evaluated."""
        return shared([run.returns() for run in self.runs])


def runs_in(folder: Path) -> list[Path]:
    """A run directory, or all those below a folder."""
    found = sorted(path.parent for path in folder.rglob("eval.csv"))
    if not found:
        raise SystemExit(f"error: {folder} holds no run: expected config.yaml and eval.csv.")
    return found


def make_curves(run_dirs: Sequence[Path]) -> list[Curve]:
    """The curves of run directories, in the order in which they are first named."""
    runs = [Run.read(run_dir) for run_dir in run_dirs]
    order = [run.settings for run in runs]
    runs.sort(key=lambda run: (order.index(run.settings), run.config["seed"]))
    return [Curve(list(group)) for _, group in groupby(runs, key=lambda run: run.settings)]


def labels(curves: Sequence[Curve]) -> list[str]:
    """What the curves are called; with a directory's name where that alone tells two apart."""
    plain = [(curve.runs[0].task, curve.label) for curve in curves]
    return [
        f"{curve.label} ({curve.runs[0].dir.name})" if plain.count(each) > 1 else curve.label
        for curve, each in zip(curves, plain, strict=True)
    ]


def draw(axes: Axes, curve: Curve, label: str, color: str, x: str = "updates") -> None:
    """Adds a curve to a panel."""
    line = draw_mean(axes, label, [run.returns(x) for run in curve.runs], color)
    if len(curve.runs) == 1:
        places, values = line.get_xdata(), line.get_ydata()
        stds = curve.runs[0].returns(x, "return_std").values()
        low, high = zip(*((v - s, v + s) for v, s in zip(values, stds, strict=True)), strict=True)
        axes.fill_between(places, low, high, alpha=0.15, color=color, linewidth=0)


def unit(curves: Sequence[Curve]) -> str:
    """What the horizontal axis counts: updates, and how many frames one is."""
    rates = sorted({1 / curve.runs[0].config["optim"]["utd_ratio"] for curve in curves})
    frames = "env frame" if rates == [1] else "env frames"
    return f"updates ({' or '.join(f'{rate:g}' for rate in rates)} {frames} each)"


def table(curves: Sequence[Curve]) -> str:
    """The means over seeds at each evaluation, with the seeds' own in brackets, in Markdown."""
    lines = ["| " + " | ".join(["updates", *labels(curves)]) + " |"]
    lines.append("|" + "--:|" * (len(curves) + 1))
    for updates in sorted({u for curve in curves for u in curve.shared()}):
        cells = [f"{updates:,.0f}"]
        for curve in curves:
            each = curve.at(updates)
            seeds = f" ({', '.join(f'{value:.0f}' for value in each)})" if len(each) > 1 else ""
            cells.append(f"{mean(each):.0f}{seeds}" if len(each) == len(curve.runs) else "")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def mark(text: str) -> tuple[str, float]:
    """What `--line NAME=RETURN` says."""
    name, _, value = text.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected NAME=RETURN, got {text!r}") from None


def main() -> None:
    """Parses the command line, writes the figure and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("run_dirs", type=Path, nargs="+", help="or folders that hold them")
    parser.add_argument("--x", choices=("updates", "frames"), default="updates")
    parser.add_argument(
        "--line", type=mark, action="append", default=[], help="NAME=RETURN, drawn dashed"
    )
    arguments = parser.parse_args()

    curves = make_curves([run for folder in arguments.run_dirs for run in runs_in(folder)])
    tasks = sorted({curve.runs[0].task for curve in curves})
    xlabel = unit(curves) if arguments.x == "updates" else "environment frames"
    figure, panels = make_panels(tasks, xlabel)
    called = labels(curves)
    colors = {label: f"C{number}" for number, label in enumerate(dict.fromkeys(called))}
    for curve, label in zip(curves, called, strict=True):
        draw(panels[curve.runs[0].task], curve, label, colors[label], arguments.x)
    for axes in panels.values():
        draw_marks(axes, dict(arguments.line))
    draw_legends(figure)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output, dpi=150)
    for task in tasks:
        print(f"{task}\n" * (len(tasks) > 1) + table([c for c in curves if c.runs[0].task == task]))


if __name__ == "__main__":
    main()
