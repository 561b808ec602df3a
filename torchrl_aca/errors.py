"""The exceptions that are meant for the person at the keyboard."""

from __future__ import annotations

__all__ = ["DatasetError", "RunError"]


class RunError(ValueError):
    """A run cannot start or go on: the message says what was expected, what was got and the fix."""


class DatasetError(ValueError):
    """Data cannot be stored, imported or loaded: says what was expected, what was got, the fix."""
