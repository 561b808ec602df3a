"""The evaluations of a study as rows of one table: read from run directories, and compared."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from curves import shared

COLUMNS = [
    "method",
    "task",
    "seed",
    "updates",
    "frames",
    "return_mean",
    "return_std",
    "num_episodes",
    "updates_per_second",
]
TEXT = ("method", "task")
Row = dict[str, Any]
Scores = dict[str, list[np.ndarray]]  # of each method, for each task


def read_csv(path: Path) -> list[Row]:
    """The rows of a CSV file, numbers as numbers."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v if k in TEXT or not v else float(v) for k, v in row.items()} for row in rows]


def read_runs(folder: Path) -> list[Row]:
    """Every evaluation of the runs below a folder; a run without an update is left out."""
    runs = [path.parent for path in sorted(folder.rglob("eval.csv"))]
    rows = [row for run in runs for row in read_run(run)]
    if not rows:
        raise SystemExit(f"error: {folder}: expected directories of runs that have begun to train.")
    return rows


def read_run(run_dir: Path) -> list[Row]:
    """The evaluations of a run, with what it is."""
    config, rows = OmegaConf.load(run_dir / "config.yaml"), read_csv(run_dir / "eval.csv")
    if not rows or rows[-1]["updates"] == 0:
        return []
    metrics = read_csv(run_dir / "metrics.csv") if (run_dir / "metrics.csv").exists() else []
    speeds = [row["updates_per_second"] for row in metrics if row.get("updates_per_second")]
    own = {
        "task": config.env.name,
        "method": method_of(run_dir, config),
        "seed": config.seed,
        "updates_per_second": round(float(np.median(speeds)), 3) if speeds else "",
    }
    return [{name: {**row, **own}[name] for name in COLUMNS} for row in rows]


def method_of(run_dir: Path, config: Any) -> str:
    """What the study calls the method of a run; outside of a study the algorithm."""
    path = run_dir.parent / "study.yaml"
    if path.exists():
        study = OmegaConf.load(path)
        for task, method in product(study.tasks, study.methods):
            if run_dir.name == f"{task}-{method}-s{config.seed}":
                return method
    return config.algo.name


def names(rows: Sequence[Row], key: str) -> list[str]:
    """The tasks or methods, in their first order."""
    return list(dict.fromkeys(row[key] for row in rows))


def by_seed(rows: Sequence[Row], task: str, method: str) -> dict[float, dict[float, float]]:
    """The returns of a method on a task: for each seed, by updates."""
    seeds: dict[float, dict[float, float]] = {}
    for row in rows:
        if (row["task"], row["method"]) == (task, method):
            seeds.setdefault(row["seed"], {})[row["updates"]] = row["return_mean"]
    return seeds


def compared_at(rows: Sequence[Row], task: str, updates: float | None) -> float:
    """The updates at which a task's methods are compared."""
    runs = [run for m in names(rows, "method") for run in by_seed(rows, task, m).values()]
    return shared(runs)[-1] if updates is None else updates


def returns(rows: Sequence[Row], task: str, method: str, updates: float) -> np.ndarray:
    """The return of each seed that was evaluated at `updates`."""
    runs = by_seed(rows, task, method).values()
    return np.array([run[updates] for run in runs if updates in run])


def scores(rows: Sequence[Row], updates: float | None) -> tuple[list[str], Scores]:
    """Scores of the methods on the tasks that all of them have, and these tasks.

    A task on which no method is better than before training has no scale, and is left out.
    """
    methods, tasks, found = names(rows, "method"), [], {}
    for task in names(rows, "task"):
        at = compared_at(rows, task, updates)
        each = [returns(rows, task, method, at) for method in methods]
        first = np.concatenate([returns(rows, task, method, 0.0) for method in methods]).mean()
        if not all(map(len, each)) or (best := max(map(np.mean, each))) <= first:
            continue
        tasks.append(task)
        for method, values in zip(methods, each, strict=True):
            found.setdefault(method, []).append((values - first) / (best - first))
    return tasks, found
