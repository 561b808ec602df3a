"""The one exception of the recipes that is meant for the person at the keyboard."""

from __future__ import annotations


class RunError(ValueError):
    """A run cannot start or go on: the message says what was expected, what was got and the fix."""
