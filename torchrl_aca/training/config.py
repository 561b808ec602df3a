"""Checks of a configuration before any long work, and the configuration of a resumed run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_aca.training.checkpoint import read_checkpoint
from torchrl_aca.training.errors import RunError

POSITIVE_INTEGERS = (
    "collector.frames_per_batch",
    "collector.init_random_frames",
    "buffer.capacity",
    "optim.total_updates",
    "optim.batch_size",
    "eval.episodes",
    "checkpoint.keep_last",
)
RANGES = {
    "optim.utd_ratio": (0, float("inf")),
    "optim.gamma": (0, 1),
    "optim.tau": (0, 1),
}
MAY_CHANGE_ON_RESUME = (
    "optim.total_updates",
    "num_threads",
    "logger",
    "checkpoint",
    "video",
    "eval.stop_return",
)
NOT_COMPARED = (*MAY_CHANGE_ON_RESUME, "resume", "run_dir")
PRECISIONS = ("highest", "high", "medium")
LOGGERS = ("csv", "wandb", "tensorboard", "none")


def validate(cfg: DictConfig, algorithms: Iterable[str]) -> None:
    """Checks what can be checked without building anything.

    Raises:
        RunError: Naming the key, what was expected and what was got.
    """
    require(cfg.algo.name in algorithms, cfg, "algo.name", f"one of {sorted(algorithms)}")
    require(cfg.logger.backend in LOGGERS, cfg, "logger.backend", f"one of {list(LOGGERS)}")
    precision = f"one of {list(PRECISIONS)}"
    require(cfg.matmul_precision in PRECISIONS, cfg, "matmul_precision", precision)
    counts, rates = _counts_and_rates(cfg)
    for key in (*POSITIVE_INTEGERS, *counts):
        value = OmegaConf.select(cfg, key)
        require(is_count(value), cfg, key, "a positive integer")
    for key, (low, high) in {**RANGES, **dict.fromkeys(rates, (0, float("inf")))}.items():
        value = OmegaConf.select(cfg, key)
        fits = is_number(value) and low < value <= high
        require(fits, cfg, key, f"a number above {low}, at most {high}")
    stop = cfg.eval.stop_return
    require(stop is None or is_number(stop), cfg, "eval.stop_return", "a number")
    fits = cfg.num_threads is None or is_count(cfg.num_threads)
    require(fits, cfg, "num_threads", "a positive integer or null")
    for name, section in cfg.items():
        if isinstance(section, DictConfig) and "num_cells" in section:
            fits = all(map(is_count, section.num_cells))
            require(fits, cfg, f"{name}.num_cells", "positive integers, one per hidden layer")
    _validate_sizes(cfg)
    _validate_seeds(cfg)


def _counts_and_rates(cfg: DictConfig) -> tuple[list[str], list[str]]:
    """Returns the keys that are counts or intervals, and those that are learning rates, by name."""
    keys = [
        (f"{section}.{name}", name)
        for section, values in cfg.items()
        if isinstance(values, DictConfig)
        for name in values
        if name != "num_cells"
    ]
    counts = [key for key, name in keys if name.startswith("num_") or name.endswith("interval")]
    rates = [key for key, name in keys if name in ("lr", "lr_end") or name.endswith("_lr")]
    return counts, rates


def _validate_seeds(cfg: DictConfig) -> None:
    for key in ("seed", "eval.seed"):
        value = OmegaConf.select(cfg, key)
        require(is_count(value, low=0), cfg, key, "an integer of at least 0")
    first, last = cfg.seed, cfg.seed + cfg.collector.num_envs - 1
    apart = cfg.eval.seed > last or cfg.eval.seed + cfg.eval.episodes <= first
    require(apart, cfg, "eval.seed", f"seeds apart from the training's {first} to {last}")


def _validate_sizes(cfg: DictConfig) -> None:
    batch, frames = cfg.optim.batch_size, cfg.collector.frames_per_batch
    copies, warmup = cfg.collector.num_envs, cfg.collector.init_random_frames
    fits = "at least optim.batch_size"
    require(cfg.buffer.capacity >= batch, cfg, "buffer.capacity", f"{fits} ({batch})")
    require(warmup >= batch, cfg, "collector.init_random_frames", f"{fits} ({batch})")
    require(
        frames % copies == 0,
        cfg,
        "collector.frames_per_batch",
        f"a multiple of collector.num_envs ({copies})",
    )
    require(
        warmup % frames == 0,
        cfg,
        "collector.init_random_frames",
        f"a multiple of collector.frames_per_batch ({frames})",
    )


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_count(value: Any, low: int = 1) -> bool:
    """Whether a value is an integer of at least `low`."""
    return is_number(value) and isinstance(value, int) and value >= low


def require(condition: bool, cfg: DictConfig, key: str, expected: str) -> None:
    """Raises `RunError` with the key, what was expected and what was got, unless `condition`."""
    if not condition:
        value = OmegaConf.select(cfg, key)
        raise RunError(f"{key}={value!r}: expected {expected}. Set it with {key}=... .")


def resumed_config(cfg: DictConfig, overrides: Iterable[str]) -> tuple[DictConfig, dict[str, Any]]:
    """Returns the stored configuration of the run in `cfg.resume` and its newest checkpoint.

    Args:
        cfg: The configuration that was composed for this call.
        overrides: What the user typed, such as "optim.total_updates=2000".

    Raises:
        RunError: If there is no run, or an override would change what the run is.
    """
    run_dir = Path(cfg.resume)
    if not (run_dir / "config.yaml").is_file():
        raise RunError(
            f"resume={cfg.resume}: expected a run directory with config.yaml and checkpoints/, "
            "found no config.yaml. Give the directory that the run printed when it started."
        )
    stored = OmegaConf.load(run_dir / "config.yaml")
    checkpoint = read_checkpoint(run_dir)
    # The checkpoint knows how its networks were built; the file may have been edited since.
    require_equal(stored, OmegaConf.create(checkpoint["config"]), stored, "config.yaml")
    apply_overrides(stored, cfg, overrides)
    done = checkpoint["parts"]["counters"]["updates"]
    if done >= stored.optim.total_updates:
        raise RunError(
            f"resume={cfg.resume}: the run already has {done} updates; expected "
            f"optim.total_updates above that, got {stored.optim.total_updates}. Raise it."
        )
    stored.resume = str(run_dir)
    return stored, checkpoint


def apply_overrides(stored: DictConfig, cfg: DictConfig, overrides: Iterable[str]) -> None:
    """Brings what the user typed into a run's configuration.

    Args:
        stored: The run's configuration; changed in place.
        cfg: The configuration that was composed with the overrides.
        overrides: What the user typed, such as "optim.total_updates=2000".

    Raises:
        RunError: If an override would change what the run is.
    """
    typed = {override.split("=")[0].lstrip("+~") for override in overrides} - {"resume"}
    for key in sorted(typed):
        part = OmegaConf.create({})
        OmegaConf.update(part, key, OmegaConf.select(cfg, key))
        require_equal(part, stored, part, "the command line")
        OmegaConf.update(stored, key, OmegaConf.select(cfg, key))


def require_equal(
    new: DictConfig, run: DictConfig, keys: DictConfig, where: str, prefix: str = ""
) -> None:
    """Compares the entries of `keys` in two configurations, but for those that may change.

    Raises:
        RunError: Naming the first key that `run` has otherwise than `new`, which is from `where`.
    """
    for name in keys:
        key = f"{prefix}{name}"
        if any(key == free or key.startswith(f"{free}.") for free in NOT_COMPARED):
            continue
        value = OmegaConf.select(new, key)
        if isinstance(value, DictConfig):
            require_equal(new, run, value, where, f"{key}.")
        elif value != OmegaConf.select(run, key):
            raise RunError(
                f"{where} has {key}={value}, but the run to resume has "
                f"{key}={OmegaConf.select(run, key)}. Only {', '.join(MAY_CHANGE_ON_RESUME)} may "
                f"change: leave {key} out, or start a new run without resume=."
            )
