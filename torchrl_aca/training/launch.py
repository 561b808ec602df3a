"""From a command to a run: the configuration of this call, and errors in one message."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from torchrl_aca.errors import DatasetError, RunError
from torchrl_aca.training.resume import resumed_config

Train = Callable[[DictConfig, "dict[str, Any] | None"], object]


def launch(train: Train, cfg: DictConfig) -> None:
    """Starts a run, or goes on with the one in `cfg.resume`.

    Args:
        train: Takes a configuration, and the checkpoint to go on from or None.
        cfg: What Hydra has composed. A job of `--multirun` has the directory that Hydra named after
            its overrides.

    Raises:
        SystemExit: With one message, if the user can mend what is wrong.
    """
    hydra = HydraConfig.get()
    try:
        if hydra.mode is RunMode.MULTIRUN and cfg.run_dir is None:
            cfg.run_dir = hydra.runtime.output_dir
        if cfg.resume is None:
            train(cfg, None)
        else:
            train(*resumed_config(cfg, hydra.overrides.task))
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        print("stopped before the run began: nothing is lost", file=sys.stderr)
        raise SystemExit(130) from None


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
