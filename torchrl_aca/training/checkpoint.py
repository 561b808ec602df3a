"""Checkpoints of a whole run: written atomically, rotated, checked, restored bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_aca.errors import RunError
from torchrl_aca.training.agent import Stateful
from torchrl_aca.training.files import read_torch_file, replace_file
from torchrl_aca.training.policy import policy_path

FORMAT = "torchrl-aca run 2"
ENTRIES = {"config": dict, "parts": dict, "parts.counters": dict}


@dataclass
class Counters:
    """How far a run is.

    Attributes:
        updates: Gradient updates made in the online phase.
        offline_updates: Those made in the offline phase, on the data set alone.
        seconds: Wall-clock time spent, over all sessions.
    """

    updates: int = 0
    offline_updates: int = 0
    seconds: float = 0.0

    @property
    def total(self) -> int:
        """The updates of both phases."""
        return self.offline_updates + self.updates

    def state_dict(self) -> dict[str, Any]:
        """Returns the numbers."""
        return asdict(self)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.updates = state_dict["updates"]
        self.offline_updates = state_dict["offline_updates"]
        self.seconds = state_dict["seconds"]


def save_checkpoint(
    directory: Path,
    parts: Mapping[str, Stateful],
    config: dict[str, Any],
    updates: int,
    keep_last: int,
) -> Path:
    """Writes `checkpoint_<updates>.pt` and removes all but the newest `keep_last` ones.

    The policies beside the old ones go with them.

    A crash while it is written leaves the earlier checkpoints as they are.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"checkpoint_{updates:010d}.pt"
    write_content(path, parts, config)
    for old in list_checkpoints(directory)[:-keep_last]:
        old.unlink()
        policy_path(directory, updates_of(old)).unlink(missing_ok=True)
    return path


def write_content(
    path: Path, parts: Mapping[str, Stateful], config: dict[str, Any], **more: Any
) -> None:
    """Writes the states of parts, the configuration and `more` to a file, whole or not at all."""
    states = {name: part.state_dict() for name, part in parts.items()}
    content = {"format": FORMAT, "config": config, "parts": states, **more}
    replace_file(path, lambda file: torch.save(content, file))


def updates_of(path: Path) -> int:
    """Returns after how many updates a checkpoint was written; its name tells."""
    return int(path.stem.rpartition("_")[2])


def list_checkpoints(directory: Path) -> list[Path]:
    """Returns the checkpoints in a directory, oldest first."""
    return sorted(directory.glob("checkpoint_*.pt"))


def read_checkpoint(run_dir: Path, updates: int | None = None) -> dict[str, Any]:
    """Reads a checkpoint of a run directory: the newest, or that of so many updates.

    Returns:
        A dict with "config" and "parts".

    Raises:
        RunError: If there is none, or it is damaged or no checkpoint of a recipe. If the one before
            it is intact, the message says how to go on from that.
    """
    checkpoints = list_checkpoints(run_dir / "checkpoints")
    if not checkpoints:
        raise RunError(
            f"resume={run_dir}: expected a run directory with checkpoints/checkpoint_*.pt, found "
            "none. Give the directory that the run printed when it started; a run that was killed "
            "before its first checkpoint is started again by its own command."
        )
    if updates is not None:
        checkpoints = _up_to(checkpoints, updates)
    content, fault = read_content(checkpoints[-1])
    if fault:
        raise RunError(f"{checkpoints[-1]} {fault}. {_way_out(checkpoints)}")
    return content


def _up_to(checkpoints: list[Path], updates: int) -> list[Path]:
    """The checkpoints up to the one of so many updates."""
    kept = [updates_of(path) for path in checkpoints]
    if updates not in kept:
        raise RunError(
            f"{checkpoints[0].parent}: expected a checkpoint of {updates} updates, found those of "
            f"{kept}. Choose one of them."
        )
    return checkpoints[: kept.index(updates) + 1]


def _way_out(checkpoints: list[Path]) -> str:
    """What to do about a newest checkpoint that cannot be used."""
    for before in reversed(checkpoints[:-1]):
        if not read_content(before)[1]:
            return f"{before.name} is intact: delete the newer ones to go on from it."
    return "There is no intact one before it: start a new run."


def read_content(path: Path) -> tuple[dict[str, Any], str]:
    """Returns a checkpoint's content, and what is wrong with it: nothing where it can be used."""
    return read_torch_file(path, FORMAT, ENTRIES)


def restore(parts: Mapping[str, Stateful], states: Mapping[str, Any]) -> None:
    """Loads saved states into the parts of a run, in the order of `parts`.

    Raises:
        RunError: If names or shapes differ, which means that the code or the configuration is
            another one than the checkpoint's.
    """
    if missing := parts.keys() - states.keys():
        raise RunError(
            f"the checkpoint has no {sorted(missing)}; it holds {sorted(states)}. It was written "
            "by another algorithm or version: resume with the code that wrote it."
        )
    for name, part in parts.items():
        try:
            part.load_state_dict(states[name])
        except Exception as error:  # every part has exceptions of its own for foreign values
            raise RunError(
                f"the checkpoint's {name!r} does not fit what the configuration builds: "
                f"{type(error).__name__}: {error}. Resume with the unchanged config.yaml of the "
                "run and the code that wrote it."
            ) from error
