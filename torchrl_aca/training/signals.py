"""Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType


class StopSignal:
    """Turns the first Ctrl-C or SIGTERM into a wish to stop; a second one stops at once.

    Attributes:
        received: The signal's name, or None.
        activity: What the run is in the middle of, for the answer to the user.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, say: Callable[[str], None] = print) -> None:
        """Does nothing until it is entered.

        Args:
            say: Shows a line to the user; called at once when a signal arrives.
        """
        self.received: str | None = None
        self.activity = "iteration"
        self._say = say

    def __enter__(self) -> StopSignal:
        """Installs the handlers."""
        self._previous = {number: signal.signal(number, self._handle) for number in self.SIGNALS}
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Puts the earlier handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.received = signal.Signals(number).name
        for each, handler in self._previous.items():
            signal.signal(each, handler)
        self._say(f"{self.received}: stopping after this {self.activity}; Ctrl-C again quits")
