"""Checkpoints of a whole run: written atomically, rotated, restored bit for bit."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_aca.training.agent import Stateful
from torchrl_aca.training.errors import RunError

FORMAT = "torchrl-aca run 1"


@dataclass
class Counters:
    """How far a run is.

    Attributes:
        updates: Gradient updates made.
        frames: Environment steps made, over all copies, warm-up included.
        seconds: Wall-clock time spent, over all sittings.
    """

    updates: int = 0
    frames: int = 0
    seconds: float = 0.0

    def passed(self, interval: int, since: int) -> bool:
        """Tells whether a multiple of `interval` lies in the updates after `since`."""
        return since // interval < self.updates // interval

    def state_dict(self) -> dict[str, Any]:
        """Returns the three numbers."""
        return asdict(self)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.updates = state_dict["updates"]
        self.frames = state_dict["frames"]
        self.seconds = state_dict["seconds"]


def save_checkpoint(
    directory: Path,
    parts: Mapping[str, Stateful],
    config: dict[str, Any],
    updates: int,
    keep_last: int,
) -> Path:
    """Writes `checkpoint_<updates>.pt` and removes all but the newest `keep_last` ones.

    The file is written under a temporary name and renamed when it is complete: a crash in between
    leaves the earlier checkpoints as they are.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"checkpoint_{updates:010d}.pt"
    temporary = path.with_suffix(".tmp")
    states = {name: part.state_dict() for name, part in parts.items()}
    with open(temporary, "wb") as file:
        torch.save({"format": FORMAT, "config": config, "parts": states}, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    for old in list_checkpoints(directory)[:-keep_last]:
        old.unlink()
    return path


def updates_of(path: Path) -> int:
    """Returns after how many updates a checkpoint was written; its name tells."""
    return int(path.stem.rpartition("_")[2])


def list_checkpoints(directory: Path) -> list[Path]:
    """Returns the checkpoints in a directory, oldest first."""
    return sorted(directory.glob("checkpoint_*.pt"))


def read_checkpoint(run_dir: Path) -> dict[str, Any]:
    """Reads the newest checkpoint of a run directory.

    Returns:
        A dict with "config" and "parts".

    Raises:
        RunError: If there is none, or it is no checkpoint of a recipe.
    """
    checkpoints = list_checkpoints(run_dir / "checkpoints")
    if not checkpoints:
        raise RunError(
            f"resume={run_dir}: expected a run directory with checkpoints/checkpoint_*.pt, found "
            "none. Give the directory that the run printed when it started."
        )
    try:
        content = torch.load(checkpoints[-1], map_location="cpu", weights_only=True)
    except Exception as error:  # what unpickling raises depends on the foreign bytes
        raise RunError(
            f"{checkpoints[-1]} cannot be read as a checkpoint ({type(error).__name__}); expected "
            "a file that this recipe wrote. Delete it to go on from the one before."
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise RunError(
            f"{checkpoints[-1]} is no checkpoint of this recipe: expected format {FORMAT!r}, got "
            f"{content.get('format') if isinstance(content, dict) else type(content).__name__!r}."
        )
    return content


def restore(
    parts: Mapping[str, Stateful], states: Mapping[str, Any], optional: Collection[str] = ()
) -> None:
    """Loads saved states into the parts of a run.

    Args:
        parts: What to restore, by name.
        states: The "parts" of a checkpoint.
        optional: Parts that stay as they are if the checkpoint leaves them out.

    Raises:
        RunError: If names or shapes differ, which means that the code or the configuration is
            another one than the checkpoint's.
    """
    if missing := parts.keys() - states.keys() - set(optional):
        raise RunError(
            f"the checkpoint has no {sorted(missing)}; it holds {sorted(states)}. It was written "
            "by another algorithm or version: resume with the code that wrote it."
        )
    for name in parts.keys() & states.keys():
        try:
            parts[name].load_state_dict(states[name])
        except (RuntimeError, ValueError, KeyError) as error:
            raise RunError(
                f"the checkpoint's {name!r} does not fit what the configuration builds: {error}. "
                "Resume with the unchanged config.yaml of the run."
            ) from error
