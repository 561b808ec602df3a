"""The SAC run behind `medium` and `medium_replay` data: the documented command, to its end."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig

from agents import AGENTS, without_methods
from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import list_checkpoints, updates_of
from torchrl_aca.training.resume import apply_overrides, read_config, require_equal
from torchrl_aca.training.run import has_reached
from torchrl_aca.training.signals import StopSignal

SCRIPT = Path(__file__).parents[1] / "online_mujoco.py"
ENDS = ("eval.stop_return", "optim.total_updates")  # where the run ends is this command's say


def finished_sac_run(env_name: str, seed: int, overrides: Sequence[str], run_dir: Path) -> Path:
    """Starts the run of `dataset_sac.yaml`, or goes on with it, where need be.

    Returns:
        Its directory, `run_dir`.

    Raises:
        RunError: If the run is another one than the configuration asks for, or was stopped.
    """
    typed = [f"env.name={env_name}", f"seed={seed}", *overrides]
    try:
        wanted = hydra.compose("dataset_sac", [*typed, f"run_dir={run_dir}"])
    except HydraException as error:
        raise RunError(f"sac.overrides: {str(error).splitlines()[0]}") from None
    stored = read_config(run_dir)
    if stored is None or not list_checkpoints(run_dir / "checkpoints"):
        _run("--config-name", "dataset_sac", *typed, f"run_dir={run_dir}")
    else:
        # A task's file may hold settings of other methods, which a run does not keep.
        own = without_methods(wanted, AGENTS["sac"].sections)
        require_equal(own, stored, own, "the SAC run's configuration")
        apply_overrides(stored, wanted, [*typed, *ENDS])
        if not is_finished(run_dir, stored):
            ends = [f"{key}={_selected(wanted, key)}" for key in ENDS]
            _run("--config-name", "dataset_sac", f"resume={run_dir}", *overrides, *ends)
    stored = read_config(run_dir)
    if stored is None or not is_finished(run_dir, stored):
        raise RunError(
            f"the SAC run in {run_dir} was stopped before its end, so no data set was made. The "
            "same command goes on with it."
        )
    return run_dir


def _selected(cfg: DictConfig, key: str) -> Any:
    section, name = key.split(".")
    return "null" if cfg[section][name] is None else cfg[section][name]


def _run(*arguments: str) -> None:
    """Runs `online_mujoco.py`; a signal is passed on, so that the run leaves a checkpoint."""
    with StopSignal() as stop:
        # A session of its own: Ctrl-C reaches it once, through this process.
        process = subprocess.Popen(
            [sys.executable, str(SCRIPT), *arguments], start_new_session=True
        )
        try:
            told = False
            while process.poll() is None:
                if stop.received and not told:
                    process.terminate()
                    told = True
                try:
                    process.wait(timeout=0.2)
                except subprocess.TimeoutExpired:
                    continue
        finally:
            if process.poll() is None:
                process.kill()
    if code := process.returncode:
        raise RunError(f"the SAC run ended with status {code}; see its message above.")


def is_finished(run_dir: Path, cfg: DictConfig) -> bool:
    """Whether a run has made all its updates, or stopped at the return it was to reach."""
    history = evaluations(run_dir)
    checkpoints = list_checkpoints(run_dir / "checkpoints")
    if not history or not checkpoints:
        return False
    updates = history[-1]["updates"]
    # A run that was killed between its last evaluation and its last checkpoint still has to go on.
    saved = updates_of(checkpoints[-1]) == updates
    enough = updates >= cfg.optim.total_updates or has_reached(history, cfg.eval.stop_return)
    return saved and enough


def evaluations(run_dir: Path) -> list[dict[str, float]]:
    """The rows of a run's eval.csv; none where it has not evaluated yet."""
    path = run_dir / "eval.csv"
    if not path.is_file():
        return []
    with open(path, newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
