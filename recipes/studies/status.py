"""How far the jobs of a study are: read from their directories, so at any time and by anybody."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from statistics import fmean

from studies.jobs import Job
from torchrl_aca.training.files import read_csv
from torchrl_aca.training.resume import is_finished, read_evaluations
from torchrl_aca.training.run_dir import is_locked
from torchrl_aca.training.signals import STOPPED

NAMES = ("done", "running", "stopped", "failed", "left")

HYDRA_HINT = "HYDRA_FULL_ERROR=1"


@dataclass(frozen=True)
class State:
    """Where a job is.

    Attributes:
        name: One of `NAMES`: "failed" by itself or was killed; "stopped" was told to, or lost the
            study's own process; "left" has not begun.
        updates: Made in all phases, as far as its table has them.
        seconds: What they took; 0 where nothing is known.
        latest: The latest evaluation return, or None.
    """

    name: str
    updates: int
    seconds: float
    latest: float | None


def state_of(job: Job) -> State:
    """Reads a job's directory."""
    updates, seconds = _progress(job)
    returns = [row["return_mean"] for row in read_evaluations(job.dir)]
    if is_finished(job.dir, job.config):
        name, updates = "done", job.updates
    elif is_locked(job.dir):
        name = "running"
    elif has_failed(job):
        name = "failed"
    else:
        name = "stopped" if job.dir.exists() else "left"
    return State(name, updates, seconds, returns[-1] if returns else None)


def _progress(job: Job) -> tuple[int, float]:
    """Updates and seconds of the last row of a job's metrics.csv."""
    path = job.dir / "metrics.csv"
    if not path.is_file():
        return 0, 0.0
    _, rows = read_csv(path)
    if not rows:
        return 0, 0.0
    updates = int(rows[-1]["updates"]) + int(rows[-1].get("offline_updates") or 0)
    return updates, float(rows[-1]["seconds"])


def has_failed(job: Job) -> bool:
    """Whether the job's latest command has ended in another way than it was asked to."""
    path = job.exit_status
    return path.exists() and int(path.read_text()) not in (0, STOPPED)


def last_line(job: Job) -> str:
    """The last line of a job's output that says why it stopped.

    Indented lines and Hydra's hint behind an exception, or a warning's source, say nothing of it.
    """
    lines = job.output.read_text().splitlines() if job.output.exists() else []
    told = (line for line in reversed(lines) if line[:1].strip() and HYDRA_HINT not in line)
    return next(told, "")


def status_table(jobs: Sequence[Job]) -> str:
    """A line for each job, and a summary."""
    states = [state_of(job) for job in jobs]
    width = max(len(job.dir.name) for job in jobs)
    lines = []
    for job, state in zip(jobs, states, strict=True):
        made = f"{state.updates:,}/{job.updates:,}"
        value = "" if state.latest is None else f"return {state.latest:.1f}"
        why = last_line(job) if state.name in ("stopped", "failed") else ""
        lines.append(
            f"{job.dir.name:<{width}}  {state.name:<8}{made:>20}  {value:<16}{why}".rstrip()
        )
    return "\n".join([*lines, summary(jobs, states)])


def summary(jobs: Sequence[Job], states: Sequence[State]) -> str:
    """How many jobs are where, and how long what is left would take one after the other."""
    counts = Counter(state.name for state in states)
    numbers = ", ".join(f"{counts[name]} {name}" for name in NAMES)
    seconds = left_seconds(jobs, states)
    if seconds is None:
        return f"{numbers}; the time of a method without updates so far is unknown"
    left = f"{numbers}; work left: {timedelta(seconds=round(seconds))}"
    if not (at_once := counts["running"]):
        return left
    return f"{left}; {timedelta(seconds=round(seconds / at_once))} at {at_once} at once"


def left_seconds(jobs: Sequence[Job], states: Sequence[State]) -> float | None:
    """The work left at the speed of each method so far; None if one with work left has none."""
    paces: dict[str, list[float]] = {}
    for job, state in zip(jobs, states, strict=True):
        if state.updates and state.seconds:
            paces.setdefault(job.method, []).append(state.seconds / state.updates)
    total = 0.0
    for job, state in zip(jobs, states, strict=True):
        updates = job.updates - state.updates
        if updates and job.method not in paces:
            return None
        total += updates * fmean(paces.get(job.method, [0.0]))
    return total
