"""The tables of the bandit study: our numbers beside the paper's, as CSV and as text."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bandit.env import HIGH_MODES
from torchrl_aca.training import files

METHODS = {
    "aca": "ACA",
    "diffusion_q": "Diffusion-Q",
    "langevin_q": "Langevin-Q",
    "sdac": "SDAC",
    "qsm": "QSM",
    "dacer": "DACER",
    "dipo": "DIPO",
    "nclql": "NC-LQL",
}
PAPER = {
    "aca": (0.240, 0.256, 0.243, 0.254, 0.993),
    "diffusion_q": (0.141, 0.182, 0.160, 0.153, 0.636),
    "langevin_q": (0.141, 0.147, 0.139, 0.143, 0.570),
    "sdac": (0.227, 0.227, 0.239, 0.234, 0.927),
    "qsm": (0.118, 0.115, 0.117, 0.115, 0.465),
    "dacer": (0.000, 1.000, 0.000, 0.000, 1.000),
    "dipo": (0.100, 0.099, 0.104, 0.098, 0.401),
}
NUMBERS = (*HIGH_MODES, "sum", "reward_mean", "reward_std")
Row = dict[str, Any]


def summary(rows: Sequence[Row]) -> list[Row]:
    """Means over the seeds, one row for each method, each beside the paper's if it has one.

    `w` is what the reward has chosen: the guidance weight, or the one setting of a rival.
    """
    table = []
    for method, label in METHODS.items():
        runs = [row for row in rows if row["method"] == method]
        if not runs:
            continue
        mean = {key: statistics.fmean(run[key] for run in runs) for key in NUMBERS}
        sums = [run["sum"] for run in runs]
        weights = " ".join(f"{run['weight']:g}" for run in runs if run["weight"] is not None)
        table.append(
            {"method": label, "source": f"here, {len(runs)} seeds"}
            | {key: f"{value:.3f}" for key, value in mean.items()}
            | {"lowest_sum": f"{min(sums):.3f}", "highest_sum": f"{max(sums):.3f}", "w": weights}
        )
        if method not in PAPER:
            continue
        paper = dict(zip((*HIGH_MODES, "sum"), PAPER[method], strict=True))
        table.append(
            {"method": label, "source": "paper", **{k: f"{v:.3f}" for k, v in paper.items()}}
        )
    return table


def side_by_side(rows: Sequence[Row], settings: Sequence[str]) -> list[Row]:
    """One row for each combination of `settings`: per method the sum of shares, and its w."""
    table: dict[tuple, Row] = {}
    for row in rows:
        values = {name: row[name] for name in settings}
        line = table.setdefault(tuple(values.values()), values)
        runs = [r for r in rows if all(r[k] == row[k] for k in (*settings, "method"))]
        line[f"{METHODS[row['method']]} sum"] = f"{statistics.fmean(r['sum'] for r in runs):.3f}"
        line[f"{METHODS[row['method']]} w"] = " ".join(f"{r['weight']:g}" for r in runs)
    return list(table.values())


def write_card(run_dir: Path, info: Mapping[str, Any]) -> None:
    """Writes card.md: the command, the versions and the machine."""
    lines = [f"| {name} | {value} |" for name, value in info.items() if value is not None]
    text = "\n".join(["# The 2D bandit study", "", "| | |", "|---|---|", *lines, ""])
    (run_dir / "card.md").write_text(text)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Writes the rows below their keys; numbers to four digits after the point."""
    names = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    rounded = (
        {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows
    )
    files.write_csv(path, names, rounded)


def as_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows below their keys, in columns."""
    names = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    lines = [names, *([_cell(row.get(name, "")) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _cell(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)
