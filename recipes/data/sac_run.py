"""The SAC run behind `medium` and `medium_replay` data: the documented command, to its end."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig

from agents import AGENTS, without_methods
from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import list_checkpoints
from torchrl_aca.training.config import override
from torchrl_aca.training.resume import (
    ENDS,
    apply_overrides,
    is_finished,
    read_config,
    require_equal,
)
from torchrl_aca.training.signals import STOPPED, StopSignal, run_command

SCRIPT = Path(__file__).parents[1] / "online_mujoco.py"


def finished_sac_run(env_name: str, seed: int, overrides: Sequence[str], run_dir: Path) -> Path:
    """Starts the run of `dataset_sac.yaml`, or goes on with it, where need be.

    Returns:
        Its directory, `run_dir`.

    Raises:
        RunError: If the run is another one than the configuration asks for, or was stopped.
    """
    typed, here = [f"env.name={env_name}", f"seed={seed}", *overrides], override("run_dir", run_dir)
    try:
        wanted = hydra.compose("dataset_sac", [*typed, here])
    except HydraException as error:
        raise RunError(f"sac.overrides: {str(error).splitlines()[0]}") from None
    stored = read_config(run_dir)
    if stored is None or not list_checkpoints(run_dir / "checkpoints"):
        _run("--config-name", "dataset_sac", *typed, here)
    else:
        # A task's file may hold settings of other methods, which a run does not keep.
        own = without_methods(wanted, AGENTS["sac"].sections)
        require_equal(own, stored, own, "the SAC run's configuration")
        apply_overrides(stored, wanted, [*typed, *ENDS])
        if not is_finished(run_dir, stored):
            ends = [f"{key}={_selected(wanted, key)}" for key in ENDS]
            _run("--config-name", "dataset_sac", override("resume", run_dir), *overrides, *ends)
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
        code = run_command([sys.executable, str(SCRIPT), *arguments], stop)
    if code not in (0, STOPPED):
        raise RunError(f"the SAC run ended with status {code}; see its message above.")
