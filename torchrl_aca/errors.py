"""The exceptions that are meant for the person at the keyboard."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

__all__ = ["DatasetError", "RunError", "require"]


class RunError(ValueError):
    """A run cannot start or go on: the message says what was expected, what was got and the fix."""


class DatasetError(ValueError):
    """Data cannot be stored, imported or loaded: says what was expected, what was got, the fix."""


def require(
    module: str, user: str, extra: str, error: type[RunError | DatasetError] = RunError
) -> ModuleType:
    """Imports what `user` alone needs; where it is missing, `error` names the extra that has it."""
    try:
        return import_module(module)
    except ImportError as missing:
        raise error(f"{user} needs {module}: pip install 'torchrl-aca[{extra}]'") from missing
