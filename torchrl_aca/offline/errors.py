"""The exception of offline data that is meant for the person at the keyboard."""

from __future__ import annotations


class DatasetError(ValueError):
    """Data cannot be stored, imported or loaded: says what was expected, what was got, the fix."""
