"""What a shorter chain costs and changes: `python results/short_chains.py`.

Writes short_chains/trade.png from what other commands wrote: the cost of an update (`make bench`),
how many times as wide as the whole chain's the candidates of a state are on trained critics
(`recipes/chain_fidelity.py`), and the returns of `study=short_chains` at the last evaluation that
all runs of a task have.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from evaluations import by_setting, names, read_study
from figures import draw_settings

HERE = Path(__file__).parent
CASE = r"\| HalfCheetah: update, (\d+) target candidates, chain of (\d+) levels \| compiled "
COST = re.compile(CASE + r"\| ([\d.]+) ms")
PAPER = ("cosine", "20", "True")
METHOD = r"levels(?P<setting>\d+)_(?P<line>n\d+)"
Points = dict[str, dict[int, list[float]]]  # of each line, by the number of levels


def costs(table: str) -> Points:
    """Milliseconds of an update, by N."""
    found: Points = {}
    for candidates, levels, time in COST.findall(table):
        found.setdefault(f"N = {candidates}", {})[int(levels)] = [float(time)]
    return found


def spreads(folder: Path) -> Points:
    """Ratios of the candidates' standard deviation to the whole chain's, by critic.

    The chains are of 20 levels of the cosine schedule along normalised gradients, as in the paper,
    and the shorter ones visit the levels that the package chooses.
    """
    found: Points = {}
    for path in sorted(folder.glob("*/fidelity.csv")):
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            paper = (row["schedule"], row["num_steps"], row["normalized"]) == PAPER
            if paper and row["spacing"] in ("quartic", "all"):
                label = f"{row['task']}, {int(row['updates']):,} updates"
                found.setdefault(label, {})[int(row["gradients"]) + 1] = [float(row["std_ratio"])]
    return found


def draw(axes: Axes, title: str, ylabel: str, points: Points) -> None:
    """A panel of values by the number of levels."""
    if not points:
        raise SystemExit(f"error: nothing to draw for {title!r}. Run what measures it first.")
    draw_settings(axes, points)
    axes.set(title=title, xlabel="levels that the chain visits", ylabel=ylabel)


def main() -> None:
    """Draws the figure."""
    rows = read_study(HERE / "short_chains/evaluations.csv")
    tasks = names(rows, "task")
    figure = Figure(figsize=(4 * (2 + len(tasks)), 3.6), layout="constrained")
    cost, fidelity, *panels = figure.subplots(1, 2 + len(tasks))
    table = (HERE / "speed.md").read_text()
    draw(cost, "cost", "update, ms", costs(table))
    draw(
        fidelity,
        "fidelity",
        "spread of the candidates / whole chain",
        spreads(HERE / "chain_fidelity"),
    )
    for task, axes in zip(tasks, panels, strict=True):
        lines = {f"N = {n[1:]}": line for n, line in by_setting(rows, task, METHOD).items()}
        draw(axes, f"return, {task}", "evaluation return", lines)
    for axes in (cost, *panels):
        axes.set_ylim(bottom=0)
    figure.savefig(HERE / "short_chains/trade.png", dpi=110)


if __name__ == "__main__":
    main()
