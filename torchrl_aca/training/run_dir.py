"""The directory of a run: made once, for one process at a time."""

from __future__ import annotations

import time
from pathlib import Path

from filelock import FileLock, Timeout

from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import list_checkpoints, updates_of

DONE = "done"  # a file in the directory of a run that has ended by itself: its updates


def make_run_dir(run_dir: str | None, name: str) -> Path:
    """Creates the directory of a new run.

    Args:
        run_dir: The user's choice. A run that was killed in there before its first checkpoint is
            begun anew.
        name: Without a choice, the directory is runs/<name>-<time>, and never one that is there.

    Raises:
        RunError: If `run_dir` already holds a run that can go on.
    """
    if run_dir is None:
        return _fresh(Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    path = Path(run_dir)
    if list_checkpoints(path / "checkpoints"):
        raise RunError(
            f"run_dir={run_dir} already holds a run; expected a new directory. Give another "
            f"run_dir, or go on with resume={run_dir} or existing=resume."
        )
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"run_dir={run_dir} cannot be made: {error}. Give another one.") from error
    return path


def _fresh(path: Path) -> Path:
    """Creates `path`, or path-2, path-3, ... where another run of the same second has it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    number, candidate = 1, path
    while True:
        try:
            candidate.mkdir()
        except FileExistsError:
            number += 1
            candidate = path.with_name(f"{path.name}-{number}")
        else:
            return candidate


def lock(run_dir: Path) -> FileLock:
    """Takes a run directory for this process; the system gives it back when the process ends.

    The file stays: to remove it would let two processes lock two files of one name.

    Raises:
        RunError: If another process has it, or the directory cannot be written.
    """
    found = _lock_of(run_dir)
    try:
        found.acquire(blocking=False)
    except Timeout:
        raise RunError(
            f"{run_dir}: another process is at work on this run. Wait for its end, or stop it with "
            "Ctrl-C first: it leaves a checkpoint."
        ) from None
    except OSError as error:
        raise RunError(f"{run_dir} cannot be written: {error}. Mend that.") from error
    return found


def _lock_of(run_dir: Path) -> FileLock:
    return FileLock(run_dir / ".lock")


def is_locked(run_dir: Path) -> bool:
    """Whether a process, on this machine or another one of a shared disk, is at work on a run.

    False as well where that cannot be told, as the disk is for reading alone.
    """
    if not (run_dir / ".lock").exists():
        return False
    try:
        with _lock_of(run_dir).acquire(blocking=False):
            return False
    except Timeout:
        return True
    except OSError:
        return False


def require_newest(run_dir: Path, updates: int) -> None:
    """Raises `RunError` if a checkpoint newer than the one just read has come meanwhile."""
    newest = list_checkpoints(run_dir / "checkpoints")[-1]
    if updates_of(newest) != updates:
        raise RunError(
            f"{run_dir} went on to {newest.name} while its checkpoint of {updates} updates was "
            "read. Resume it again."
        )
