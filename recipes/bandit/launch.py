"""From a composed configuration to a finished study in a directory of its own."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from omegaconf import DictConfig, OmegaConf

from bandit import tables
from bandit.config import BanditConfig, variants
from torchrl_aca.errors import RunError
from torchrl_aca.training.config import checked
from torchrl_aca.training.report import versions
from torchrl_aca.training.run_dir import make_run_dir

Config = TypeVar("Config", bound=BanditConfig)


def begin(cfg: BanditConfig, name: str) -> Path:
    """Makes the directory of this study alone, and writes its configuration there."""
    run_dir = make_run_dir(cfg.run_dir, name)
    try:
        with open(run_dir / "config.yaml", "x") as file:
            file.write(OmegaConf.to_yaml(OmegaConf.create(cfg.model_dump(exclude_unset=True))))
    except FileExistsError:
        raise RunError(
            f"run_dir={run_dir} already holds a study; expected a new directory. Give another one."
        ) from None
    return run_dir


def launch(
    composed: DictConfig,
    schema: type[Config],
    name: str,
    study: Callable[[Config, Path], None],
) -> None:
    """Runs a study into a new directory and writes its card; an error is told in one message."""
    try:
        cfg = checked(schema, composed)
        variants(cfg)  # for their mistakes
        run_dir = begin(cfg, name)
    except RunError as error:
        raise SystemExit(f"error: {error}") from None
    start, info = time.perf_counter(), versions()
    try:
        study(cfg, run_dir)
    except KeyboardInterrupt:
        raise SystemExit(f"stopped; what was finished by then is in {run_dir}") from None
    minutes = round((time.perf_counter() - start) / 60, 1)
    command = " ".join(["python", *sys.argv])
    tables.write_card(run_dir, {"command": command, "wall-clock time": f"{minutes} min", **info})
    print(f"run directory: {run_dir}")
