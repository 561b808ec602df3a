"""Ctrl-C and SIGTERM, in a run and in what starts runs."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

from torchrl_aca.training.progress import say

STOPPED = 143  # exit status of a run that was told to stop; that of a shell for SIGTERM
TWINS = 0.1  # seconds; `timeout` tells the process, and then its group, which is one wish


class StopSignal:
    """Turns the first Ctrl-C or SIGTERM into a wish to stop; a second one stops at once.

    Both hold where signals were ignored before as well: a script's `&` makes its jobs ignore
    Ctrl-C.

    Attributes:
        received: The signal's name, or None.
        at_once: Whether a second Ctrl-C came: commands that were told to stop end without saving.
        activity: What the run is in the middle of, for the answer to the user.
    """

    def __init__(self, tell: Callable[[str], None] = say) -> None:
        """Does nothing until it is entered.

        Args:
            tell: Shows a line to the user; called at once when a signal arrives.
        """
        self.received: str | None = None
        self.at_once = False
        self.activity = "iteration"
        self._tell = tell

    def __enter__(self) -> StopSignal:
        """Installs the handlers."""
        numbers = (signal.SIGINT, signal.SIGTERM)
        self._previous = {number: signal.signal(number, self._handle) for number in numbers}
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Puts the earlier handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.received:  # here once more while waiting below
            return
        self.received = signal.Signals(number).name
        time.sleep(TWINS)
        # A second one does what it does by itself, whatever the handlers of before.
        signal.signal(signal.SIGINT, self._quit)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        self._tell(f"{self.received}: stopping after this {self.activity}; Ctrl-C again quits")

    def _quit(self, number: int, frame: FrameType | None) -> None:
        self.at_once = True
        signal.default_int_handler(number, frame)


def run_command(command: Sequence[str], stop: StopSignal, **options: Any) -> int:
    """Runs a command to its end, and tells it if it is to stop.

    Args:
        command: A program and its arguments.
        stop: The wish to stop; the program gets it as SIGTERM, and as more of them `at_once`.
        options: For `subprocess.Popen`.

    Returns:
        The exit status; that of a program which a signal has killed is negative, but `STOPPED` for
        one that was told so before it could listen.
    """
    # A session of its own: Ctrl-C reaches it once, through this process.
    process = subprocess.Popen(command, start_new_session=True, **options)
    told = False
    try:
        while True:
            if stop.received and (stop.at_once or not told):
                process.terminate()
                told = True
            try:
                code = process.wait(timeout=0.2)
                return STOPPED if told and code == -signal.SIGTERM else code
            except subprocess.TimeoutExpired:
                continue
    except BaseException:
        process.terminate()  # the first one lets it save, a second one ends it at once
        raise
