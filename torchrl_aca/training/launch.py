"""From a command to a run: the configuration of this call, and errors in one message."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrl_aca.errors import DatasetError, RunError
from torchrl_aca.training.checkpoint import list_checkpoints, read_checkpoint
from torchrl_aca.training.files import write_text
from torchrl_aca.training.resume import (
    ENDS,
    continued_config,
    has_ended,
    is_finished,
    read_config,
    read_evaluations,
    resumed_config,
)
from torchrl_aca.training.run_dir import DONE, lock
from torchrl_aca.training.signals import STOPPED

Train = Callable[[DictConfig, "dict[str, Any] | None"], Path]


def launch(train: Train, cfg: DictConfig) -> None:
    """Starts a run, or goes on with the one in `cfg.resume`, or in `cfg.run_dir` where it may.

    Args:
        train: Takes a configuration, and the checkpoint to go on from or None; returns the run's
            directory.
        cfg: What Hydra has composed. A job of `--multirun` has the directory that Hydra named after
            its overrides.

    Raises:
        SystemExit: With one message, if the user can mend what is wrong; with status 143 after a
            run that was told to stop.
        RunError, DatasetError: The same mistakes in a job of `--multirun`, whose others go on.
    """
    hydra = HydraConfig.get()
    is_job = hydra.mode is RunMode.MULTIRUN
    try:
        if is_job and cfg.run_dir is None:
            cfg.run_dir = hydra.runtime.output_dir
        run_dir = start(train, cfg, hydra.overrides.task)
    except (DatasetError, RunError) as error:
        if is_job:  # Hydra raises it after the last job, and that of the first one alone
            print(f"error: {error}", file=sys.stderr)
            raise
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None  # a run has told how to go on
    if not (run_dir / DONE).exists():
        raise SystemExit(STOPPED)


def start(train: Train, cfg: DictConfig, overrides: Iterable[str]) -> Path:
    """Trains from where the run is, unless it is finished, and returns its directory."""
    if cfg.resume is not None:
        return _go_on(train, *resumed_config(cfg, overrides))
    if cfg.existing != "resume" or cfg.run_dir is None:
        return train(cfg, None)
    run_dir = Path(cfg.run_dir)
    done = (run_dir / DONE).exists()
    if not done and not list_checkpoints(run_dir / "checkpoints"):
        return train(cfg, None)
    if done:
        stored = read_config(run_dir) or OmegaConf.create(read_checkpoint(run_dir)["config"])
        if is_finished(run_dir, continued_config(cfg, stored)):
            print(f"{run_dir} is finished: nothing to do", flush=True)
            return run_dir
    checkpoint = read_checkpoint(run_dir)
    stored = OmegaConf.create(checkpoint["config"])
    return _go_on(train, continued_config(cfg, stored), checkpoint)


def _go_on(train: Train, cfg: DictConfig, checkpoint: dict[str, Any]) -> Path:
    """Trains from a checkpoint, but for a run that was killed between its last one and its end."""
    run_dir, updates = Path(cfg.resume), checkpoint["parts"]["counters"]["updates"]
    stored, rows = OmegaConf.create(checkpoint["config"]), read_evaluations(run_dir)
    as_before = all(OmegaConf.select(cfg, key) == OmegaConf.select(stored, key) for key in ENDS)
    at_its_end = has_ended(rows, stored) and rows[-1]["updates"] == updates
    if (run_dir / DONE).exists() or not (as_before and at_its_end):
        return train(cfg, checkpoint)
    with lock(run_dir):
        write_text(run_dir / DONE, f"{updates}\n")
    print(f"{run_dir} has all its {updates} updates: nothing to do", flush=True)
    return run_dir


def make_device(cfg: Any) -> torch.device:
    """Sets threads and precision and returns the device; "auto" is CUDA where there is one.

    Args:
        cfg: A `RunConfig`.

    Raises:
        RunError: If the device is not there.
    """
    torch.set_float32_matmul_precision(cfg.matmul_precision)
    device = find_device(cfg.device, cfg.num_threads)
    if cfg.cudagraphs and device.type != "cuda":
        raise RunError(
            f"cudagraphs=true: expected device=cuda, got {device}. Leave it out on a CPU; "
            "compile=true works there."
        )
    return device


def find_device(name: str, num_threads: int | None) -> torch.device:
    """Sets the threads, where a number is given, and returns the device of that name.

    Raises:
        RunError: If the device is not there.
    """
    if num_threads is not None:
        torch.set_num_threads(num_threads)
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        message = str(error).splitlines()[0]
        raise RunError(f"device={name}: {message}. Use device=cpu or device=auto.") from error
    if device.type == "cuda":
        torch.cuda.set_device(device)
    return device
