"""What users pass to the writer and the importers: checked before any work, or a `DatasetError`."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

import torch

from torchrl_aca.errors import DatasetError

Bounds = tuple[float | Sequence[float], float | Sequence[float]]


def as_size(name: str, given: Any) -> int:
    """A number of columns, as a Python integer: JSON does not know NumPy's."""
    try:
        number = operator.index(given)
    except TypeError:
        number = 0
    if number < 1:
        raise DatasetError(f"{name}={given!r}: expected an integer of at least 1.")
    return number


def as_bounds(given: Bounds, action_dim: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The smallest and the largest action, shape (A,) each."""
    try:
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in given)
    except (TypeError, ValueError):
        raise DatasetError(
            f"action_bounds={given!r}: expected (low, high), numbers or {action_dim} numbers each."
        ) from None
    if low.shape not in ((), (action_dim,)) or high.shape not in ((), (action_dim,)):
        raise DatasetError(
            f"action_bounds={given}: expected two numbers, or two lists of {action_dim} numbers."
        )
    if not (low.isfinite() & high.isfinite() & (low < high)).all():
        raise DatasetError(f"action_bounds={given}: expected finite numbers with low < high.")
    return low.expand(action_dim).clone(), high.expand(action_dim).clone()


def as_scores(scores: tuple[float, float] | None) -> dict[str, float] | None:
    """Reference scores as the metadata hold them."""
    if scores is None:
        return None
    try:
        low, high = map(float, scores)
    except (TypeError, ValueError):
        low = high = 0.0
    if not -math.inf < low < high < math.inf:
        raise DatasetError(
            f"reference_scores={scores!r}: expected (low, high), finite and with low < high."
        )
    return {"min": low, "max": high}
