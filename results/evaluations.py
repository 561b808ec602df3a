"""The evaluations of a study as rows of one table: read from run directories, and compared.

Updates of an offline phase are below zero, so that the online phases of all runs begin at the same
place; on an axis of frames they are all at zero, and the last one counts.
"""

from __future__ import annotations

import csv
import json
import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from curves import shared
from torchrl_aca.training import files

TEXT = ("method", "task", "commit")
COLUMNS = [
    "method",
    "task",
    "seed",
    "updates",
    "frames",
    "return_mean",
    "return_std",
    "num_episodes",
    "normalized_score",
    "seconds",
    "updates_per_second",
    "parameters",
    "commit",
]
NEEDED = ("method", "task", "seed", "updates", "return_mean")
Row = dict[str, Any]
Scores = dict[str, list[np.ndarray]]  # of each method, for each task


# --- reading --------------------------------------------------------------------------------------


def read_csv(path: Path) -> list[Row]:
    """The rows of a CSV file, numbers as numbers."""
    with open(path, newline="") as file:
        return [_numbers(path, row) for row in csv.DictReader(file)]


def _numbers(path: Path, row: Mapping[str, str]) -> Row:
    """A row of a table with its numbers as numbers."""
    return {name: _value(path, name, text) for name, text in row.items()}


def _value(path: Path, name: str, text: str) -> Any:
    if name in TEXT or not text:
        return text
    try:
        return float(text)
    except ValueError:
        raise SystemExit(
            f"error: {path}: expected a number in column {name}, got {text!r}. Mend it, or take "
            "the column out."
        ) from None


def rows_of_run(path: Path) -> list[Row]:
    """The rows of a table that a run may still be writing."""
    return [_numbers(path, row) for row in files.read_csv(path)[1]]


def read_evaluations(run_dir: Path) -> tuple[DictConfig, list[Row]]:
    """The configuration of a run, and its evaluations, those of an offline phase below zero."""
    rows, config = rows_of_run(run_dir / "eval.csv"), OmegaConf.load(run_dir / "config.yaml")
    for row in rows:
        row["updates"] += row.get("offline_updates", 0) - _offline_updates(config)
    return config, rows


def _offline_updates(config: DictConfig) -> int:
    """The length of a run's offline phase, which it may still be in."""
    return OmegaConf.select(config, "optim.offline_updates", default=0)


def read_study(source: Path) -> list[Row]:
    """Every evaluation of a study: its CSV, or the runs below its folder.

    A run without an update is left out, and a column that a CSV lacks is empty. Two runs of one
    task, method and seed are an error: settings that differ need methods of their own.
    """
    if source.suffix == ".csv":
        return [dict.fromkeys(COLUMNS, "") | row for row in _read_table(source)]
    found: dict[Any, tuple[Path, list[Row]]] = {}
    for path in sorted(source.rglob("eval.csv")):
        for key, rows in by_run(read_run(path.parent)).items():
            if key in found:
                raise SystemExit(
                    f"error: {found[key][0]} and {path.parent} are both {key[1]} on {key[0]} with "
                    f"seed {key[2]}; expected one run of each. Move one of them away, or name "
                    "them apart as methods of a study."
                )
            found[key] = path.parent, rows
    if not found:
        raise SystemExit(f"error: {source}: expected directories of runs that have begun to train.")
    return [row for _, rows in found.values() for row in rows]


def _read_table(source: Path) -> list[Row]:
    """The rows of a study's CSV; that of evaluate.py has the same name and is another one."""
    rows = read_csv(source) if source.is_file() else []
    if not rows or (missing := [name for name in NEEDED if name not in rows[0]]):
        found = "no rows" if source.is_file() else "no file"
        found = f"one without {', '.join(missing)}" if rows else found
        raise SystemExit(
            f"error: {source}: expected the evaluations.csv of a study, found {found}. Give the "
            "table that report.py has written, or a folder of runs."
        )
    return rows


def read_studies(sources: Sequence[Path]) -> list[Row]:
    """Every evaluation of several sources: of a run that many have, those of the last one."""
    runs: dict[Any, list[Row]] = {}
    for source in sources:
        runs |= by_run(read_study(source))
    return [row for run in runs.values() for row in run]


def read_run(run_dir: Path) -> list[Row]:
    """The evaluations of a run, with what it is and what it took."""
    config, rows = read_evaluations(run_dir)
    if len({row["updates"] for row in rows}) < 2:
        return []
    path = run_dir / "metrics.csv"
    metrics = rows_of_run(path) if path.exists() else []
    speeds = [row["updates_per_second"] for row in metrics if row.get("updates_per_second")]
    (task, method), versions = place_in_study(run_dir, config), _versions(run_dir)
    own = {
        "task": task,
        "method": method,
        "seed": config.seed,
        "updates_per_second": round(float(np.median(speeds)), 3) if speeds else "",
        "parameters": float(count) if (count := versions.get("parameters")) else "",
        "commit": versions.get("commit") or "",
    }
    times = _times(metrics, rows, _offline_updates(config))
    return [
        dict.fromkeys(COLUMNS, "")
        | {name: value for name, value in row.items() if name in COLUMNS}
        | own
        | {"seconds": seconds}
        for row, seconds in zip(rows, times, strict=True)
    ]


def _versions(run_dir: Path) -> dict[str, Any]:
    path = run_dir / "versions.json"
    return json.loads(path.read_text()) if path.exists() else {}


def _times(metrics: Sequence[Row], rows: Sequence[Row], offline_updates: int) -> list[Any]:
    """When each evaluation was made, by the latest row of metrics before it: seconds."""
    timed = [row for row in metrics if row.get("seconds")]
    places = [row["updates"] + row.get("offline_updates", 0) for row in timed]
    found = [bisect_right(places, row["updates"] + offline_updates) for row in rows]
    return [round(timed[i - 1]["seconds"], 1) if i else 0.0 for i in found]


def place_in_study(run_dir: Path, config: Any) -> tuple[str, str]:
    """A study's names of a run's task and method; outside of one, environment and algorithm."""
    path = run_dir.parent / "study.yaml"
    if path.exists():
        study = OmegaConf.load(path)
        for task, method in product(study.tasks, study.methods):
            if run_dir.name == f"{task}-{method}-s{config.seed}":
                return task, method
    return config.env.name, config.algo.name


# --- comparing ------------------------------------------------------------------------------------


def names(rows: Sequence[Row], key: str) -> list[str]:
    """The tasks or methods, in their first order."""
    return list(dict.fromkeys(row[key] for row in rows))


def by_run(rows: Sequence[Row]) -> dict[Any, list[Row]]:
    """The rows of each run, by its task, method and seed."""
    runs: dict[Any, list[Row]] = {}
    for row in rows:
        runs.setdefault((row["task"], row["method"], row["seed"]), []).append(row)
    return runs


def viewed(rows: Sequence[Row], x: str, value: str) -> list[Row]:
    """The rows with what is compared, `value`, and where, `x`; those without it are left out."""
    found = [row | {"x": row[x], "value": row[value]} for row in rows if row[value] != ""]
    if not found:
        raise SystemExit(f"error: no evaluation has a {value}. Compare another value.")
    return found


def by_seed(rows: Sequence[Row], task: str, method: str) -> dict[float, dict[float, float]]:
    """The values of a method on a task: for each seed, by place."""
    seeds: dict[float, dict[float, float]] = {}
    for row in rows:
        if (row["task"], row["method"]) == (task, method):
            seeds.setdefault(row["seed"], {})[row["x"]] = row["value"]
    return seeds


def last_shared(rows: Sequence[Row], task: str) -> float:
    """The last place at which all runs of a task were evaluated."""
    runs = [run for m in names(rows, "method") for run in by_seed(rows, task, m).values()]
    if not (places := shared(runs)):
        raise SystemExit(
            f"error: the runs of {task} have no evaluation at the same place. Leave out what has "
            "hardly begun; report.py compares elsewhere with --at."
        )
    return places[-1]


def values_at(rows: Sequence[Row], task: str, method: str, place: float) -> np.ndarray:
    """The value of each seed that was evaluated at a place."""
    runs = by_seed(rows, task, method).values()
    return np.array([run[place] for run in runs if place in run])


def by_setting(rows: Sequence[Row], task: str, method: str) -> dict[str, dict[int, list[float]]]:
    """The values of all seeds where all runs of a task were evaluated last, by line and setting.

    `method` is a pattern of the methods' names with groups `line` and `setting`, a number.
    """
    rows, found = viewed(rows, "updates", "return_mean"), {}
    place = last_shared(rows, task)
    for name in names(rows, "method"):
        values = values_at(rows, task, name, place)
        if len(values) and (match := re.fullmatch(method, name)):
            line = found.setdefault(match["line"], {})
            line[int(match["setting"])] = values.tolist()
    return found


def before_training(rows: Sequence[Row], task: str) -> float:
    """The mean over all runs of a task of their first evaluation."""
    first = {}
    for row in rows:
        if row["task"] == task:
            first.setdefault((row["method"], row["seed"]), row["value"])
    return float(np.mean(list(first.values())))


def scores(rows: Sequence[Row], place: float | None) -> tuple[list[str], Scores]:
    """Scores of the methods on the tasks that all of them have, and these tasks.

    A task on which no method is better than before training has no scale, and is left out.
    """
    methods, tasks, found = names(rows, "method"), [], {}
    for task in names(rows, "task"):
        at = last_shared(rows, task) if place is None else place
        each = [values_at(rows, task, method, at) for method in methods]
        first = before_training(rows, task)
        if not all(map(len, each)) or (best := max(map(np.mean, each))) <= first:
            continue
        tasks.append(task)
        for method, values in zip(methods, each, strict=True):
            found.setdefault(method, []).append((values - first) / (best - first))
    return tasks, found
