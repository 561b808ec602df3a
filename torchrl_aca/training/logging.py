"""Where numbers go: CSV tables always, and another logger by choice."""

from __future__ import annotations

import csv
import math
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.record.loggers import get_logger

from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Logger
from torchrl_aca.training.files import read_csv, write_csv, write_text


class MetricMeans:
    """Means of update metrics since the last row, each over the updates that reported it."""

    def __init__(self) -> None:
        """Starts empty."""
        self.sums: dict[str, torch.Tensor] = {}
        self.counts: dict[str, int] = {}

    def add(self, metrics: TensorDictBase) -> None:
        """Adds the scalars of one update, without waiting for the device."""
        for name, value in metrics.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value.clone()
            self.counts[name] = self.counts.get(name, 0) + 1

    def pop(self) -> dict[str, float]:
        """Returns the means and starts again.

        Raises:
            RunError: If a mean is NaN or infinite.
        """
        means = {name: (total / self.counts[name]).item() for name, total in self.sums.items()}
        self.sums, self.counts = {}, {}
        for name, value in means.items():
            if not math.isfinite(value):
                raise RunError(
                    f"the metric {name!r} became {value}; expected a finite number. The training "
                    "has diverged: lower optim.lr or the reward scale, and resume or start again."
                )
        return means

    def state_dict(self) -> dict[str, Any]:
        """Returns sums and counts."""
        return {"sums": {k: v.cpu() for k, v in self.sums.items()}, "counts": dict(self.counts)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.sums, self.counts = dict(state_dict["sums"]), dict(state_dict["counts"])


class CsvTable:
    """A CSV file with one column per metric, from the first row on; columns may appear later."""

    def __init__(self, path: Path, until: Mapping[str, int] | None = None) -> None:
        """Opens a table.

        Args:
            path: The file.
            until: Keep the rows of an earlier session in which no column of these has a larger
                value; None starts anew.
        """
        self.path = path
        self.columns: list[str] = []
        self.rows: list[dict[str, Any]] = []
        if until is not None and path.exists():
            self.columns, rows = read_csv(path)
            self.rows = [row for row in rows if not _is_later(row, until)]
            self._rewrite()

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds a row and writes it at once."""
        self.rows.append(dict(row))
        if new := [name for name in row if name not in self.columns]:
            self.columns += new
            self._rewrite()
        else:
            with open(self.path, "a", newline="") as file:
                csv.DictWriter(file, self.columns).writerow(row)

    def _rewrite(self) -> None:
        """Replaces the file, so that a kill leaves the rows that were there."""
        write_csv(self.path, self.columns, self.rows)


def _is_later(row: Mapping[str, str | None], until: Mapping[str, int]) -> bool:
    try:
        return any(int(row.get(name) or 0) > last for name, last in until.items())
    except ValueError:  # half a row of a full disk, with another one behind it
        return True


class RunLogger:
    """Writes metrics.csv and eval.csv, and the same numbers to wandb or tensorboard if asked."""

    def __init__(
        self,
        run_dir: Path,
        config: Mapping[str, Any],
        until: Mapping[str, int] | None = None,
    ) -> None:
        """Opens the tables of a run and the second logger that `config["logger"]` names.

        Args:
            run_dir: The run's directory.
            config: The whole configuration.
            until: Where a resumed run goes on: updates and frames; None for a new one.

        Raises:
            RunError: If wandb is to be online and nobody is logged in.
        """
        settings = config["logger"]
        self.tables = {
            "metrics": CsvTable(run_dir / "metrics.csv", until),
            "eval": CsvTable(run_dir / "eval.csv", until),
        }
        self.second = None
        if settings["backend"] == "tensorboard":
            self.second = get_logger("tensorboard", str(run_dir), "tensorboard")
        elif settings["backend"] == "wandb":
            offline = settings["wandb_mode"] == "offline"
            self.second = get_logger(
                "wandb",
                str(run_dir),
                run_dir.name,
                wandb_kwargs={
                    "project": settings["project"],
                    "id": _wandb_id(run_dir, new=until is None),
                    "offline": offline,
                    "mode": settings["wandb_mode"],
                    "config": dict(config),
                    "log_env_packages": False,
                },
            )

    def log(
        self, table: str, axes: Mapping[str, int], step: int, values: Mapping[str, float]
    ) -> None:
        """Adds a row to "metrics" or "eval".

        Args:
            table: The table's name.
            axes: Updates and frames: the first columns.
            step: Updates of all phases, by which the second logger orders its rows.
            values: The other columns.
        """
        self.tables[table].append({**axes, **values})
        if self.second is not None:
            shown = {**values, "frames": axes["frames"]}
            self.second.log_metrics({f"{table}/{k}": v for k, v in shown.items()}, step=step)

    def close(self) -> None:
        """Ends a wandb run; the CSV files need nothing."""
        experiment = getattr(self.second, "experiment", None)
        for end in ("finish", "close"):
            if hasattr(experiment, end):
                getattr(experiment, end)()
                break


def _wandb_id(run_dir: Path, new: bool) -> str:
    """An id that no other run has, kept for the time when this one is resumed."""
    path = run_dir / "wandb_id"
    if new or not path.exists():
        earlier = not new and (run_dir / "wandb").exists()  # of a version whose id was the name
        write_text(path, run_dir.name if earlier else uuid.uuid4().hex)
    return path.read_text()


def require_wandb_login(settings: Logger) -> None:
    """Checks, before any long work, that wandb can be reached without a question at the terminal.

    Raises:
        RunError: If wandb is missing or nobody is logged in.
    """
    if settings.backend != "wandb" or settings.wandb_mode == "offline":
        return
    try:
        import wandb

        logged_in = wandb.login(prompt=False)
    except Exception as error:  # wandb raises its own kinds, or ImportError
        raise RunError(f"logger.backend=wandb cannot be used: {error}.") from error
    if not logged_in:
        raise RunError(
            "logger.backend=wandb: expected a wandb login, found none. Run `wandb login`, set "
            "WANDB_API_KEY, or use logger.wandb_mode=offline."
        )
