"""What a run shows while it goes on: a bar on a terminal, lines elsewhere, the time left."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

from tqdm import tqdm

SHOWN = ("return", "loss")
REFRESH = 0.2  # seconds between two changes of the bar's description
UNREADABLE = (OSError, RuntimeError, ValueError)  # gone, within another line, no such letter


def say(message: str) -> None:
    """Prints a line at once. What is lost where nobody can read it is the line, and not the run.

    A reader such as `head` or an interrupted `tee` may have gone, a disk may be full, and a signal
    may come in the middle of another line.
    """
    with suppress(*UNREADABLE):
        try:
            print(message, flush=True)
        except BrokenPipeError:  # or Python fails again when it ends, and has another exit status
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), sys.stdout.fileno())


def duration(seconds: float) -> str:
    """Returns a time in its two largest units: "45 s", "3 h 20 min", "11 d 4 h"."""
    minutes, hours = round(seconds / 60), round(seconds / 3600)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    if hours < 24:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{hours // 24} d {hours % 24} h"


class Pace:
    """Seconds that an update has taken since the second one, because the first may compile.

    All that comes between updates is in it: steps of the environments, evaluations, checkpoints.
    """

    ENOUGH = 10.0  # seconds of updates before an estimate is worth telling

    def __init__(self, updates: int) -> None:
        """Begins where a session or a phase does, after so many updates."""
        self._begun_at, self._since = updates, 0.0
        self._from = self._now = updates
        self._is_told = False

    def advance(self, updates: int) -> None:
        """Takes how many updates have been made."""
        if updates == self._now:
            return
        if self._from == self._begun_at:
            self._from, self._since = updates, time.perf_counter()
        self._now = updates

    def left(self, total: int) -> float | None:
        """Seconds that the updates up to `total` will take; None before two have been made."""
        if self._now == self._from:
            return None
        return (total - self._now) * (time.perf_counter() - self._since) / (self._now - self._from)

    def first_estimate(self, total: int) -> str | None:
        """What to tell a user, once, as soon as it is known."""
        left = self.left(total)
        if not left or self._is_told or time.perf_counter() - self._since < self.ENOUGH:
            return None
        self._is_told = True
        updates = total - self._now
        each = left / updates
        return (
            f"about {duration(left)} left at this speed: {each:.2g} s for each of {updates} updates"
        )


class ProgressBar:
    """A progress bar on a terminal; plain lines elsewhere."""

    def __init__(self, total: int, initial: int) -> None:
        """Counts updates from `initial` to `total`."""
        self.total = total
        self.pace = Pace(initial)
        self.bar = tqdm(total=total, initial=initial, unit="upd", disable=not sys.stdout.isatty())
        self._refreshed = 0.0

    def advance(self, updates: int, activity: str) -> None:
        """Moves the bar to `updates`, and tells once how long the rest will take."""
        self.pace.advance(updates)
        if estimate := self.pace.first_estimate(self.total):
            self.write(estimate)
        self.describe(activity)
        self._change(lambda: self.bar.update(updates - self.bar.n))

    def describe(self, activity: str) -> None:
        """Says what is going on, in front of the bar."""
        if time.monotonic() - self._refreshed > REFRESH:
            self._change(lambda: self.bar.set_description_str(activity))
            self._refreshed = time.monotonic()

    def show_metrics(self, updates: int, frames: int, values: Mapping[str, float]) -> None:
        """Shows a row of training metrics behind the bar, or as a line of its own."""
        if not self.bar.disable:
            self.bar.set_postfix_str(_status(values), refresh=False)
            return
        left = self.pace.left(self.total)
        pace = f"{values['updates_per_second']:.3g} updates/s"
        pace += "" if left is None else f", {duration(left)} left"
        self.write(f"{self._place(updates, frames)}  {pace}  {_status(values)}")

    def show_evaluation(
        self, updates: int, frames: int, values: Mapping[str, float], best: float
    ) -> None:
        """Shows a row of evaluation results, and the best return so far, as a line of its own."""
        self.write(f"{self._place(updates, frames)}  {_status(values)}  best {best:.4g}")

    def _place(self, updates: int, frames: int) -> str:
        return f"updates {updates}/{self.total}  frames {frames}"

    def write(self, message: str) -> None:
        """Prints a line above the bar."""
        if not self.bar.disable:
            self._change(lambda: self.bar.write(message))
        if self.bar.disable:
            say(message)

    def close(self) -> None:
        """Leaves the bar as it stands."""
        self._change(self.bar.close)

    def _change(self, change: Callable[[], object]) -> None:
        """Changes what is on the terminal; where that has gone, there is no bar any more."""
        try:
            change()
        except UNREADABLE:
            self.bar.disable = True


def _status(values: Mapping[str, float]) -> str:
    # Returns first: what does not fit on a narrow terminal is cut off.
    shown = [(name, values[name]) for part in SHOWN for name in values if part in name]
    return "  ".join(f"{name} {value:.4g}" for name, value in shown)
