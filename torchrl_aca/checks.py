"""Checks of arguments: what was expected, what was got, how to fix it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

__all__ = [
    "action_spec",
    "check_above",
    "check_at_least",
    "check_choice",
    "check_keys",
    "first_parameter",
]


def check_at_least(least: int, **numbers: float) -> None:
    """Raise a ValueError for a number below ``least``, or NaN."""
    for name, number in numbers.items():
        if not number >= least:
            raise ValueError(f"Expected {name} >= {least}, got {name}={number}.")


def check_above(least: float, **numbers: float) -> None:
    """Raise a ValueError for a number not above ``least``, or NaN."""
    for name, number in numbers.items():
        if not number > least:
            raise ValueError(f"Expected {name} > {least}, got {name}={number}.")


def check_choice(choices: Sequence[str], **values: str) -> None:
    """Raise a ValueError for a value that is none of ``choices``."""
    for name, value in values.items():
        if value not in choices:
            raise ValueError(f"Expected {name} to be one of {tuple(choices)}, got {value!r}.")


def check_keys(**keys: Sequence[NestedKey] | None) -> None:
    """Raise a ValueError for a string where a list of keys is expected: it would be its letters."""
    for name, value in keys.items():
        if isinstance(value, str):
            raise ValueError(f"Expected {name} as a list of keys, such as [{value!r}], got a str.")


def first_parameter(network: nn.Module) -> nn.Parameter:
    """A parameter, which tells device and dtype; a ValueError where there is none to train."""
    for parameter in network.parameters():
        return parameter
    raise ValueError(
        f"The network must have parameters to train, got {type(network).__name__} with none."
    )


def action_spec(spec: TensorSpec | None, key: NestedKey, action_dim: int | None) -> TensorSpec:
    """The bounded vector spec of one env's action; an unbounded one where no spec was given.

    Args:
        spec: the action's spec, a ``Composite`` that holds it under ``key``, or None.
        key: the action's key.
        action_dim: the network's action size, where it tells one.

    Raises:
        ValueError: if the spec is not a bounded vector of ``action_dim`` floating-point numbers.
    """
    if spec is None:
        if action_dim is None:
            raise ValueError("Pass spec= or action_dim=: the network does not tell its action_dim.")
        return Unbounded(shape=(action_dim,))
    if isinstance(spec, Composite):
        if key not in spec.keys(True, True):
            raise ValueError(
                f"spec must hold the action's key {key!r}, got {list(spec.keys(True, True))}. "
                "Pass out_keys=[...] to name the action, or the action's own spec."
            )
        spec = spec[key]
    if not isinstance(spec, Bounded) or spec.ndim != 1 or not spec.dtype.is_floating_point:
        raise ValueError(
            "spec must be a bounded, continuous action spec of shape (A,), such as "
            f"env.action_spec_unbatched; got {spec}."
        )
    low, high = spec.space.low, spec.space.high
    if not torch.isfinite(high - low).all() or not (high > low).all():
        raise ValueError(
            f"The bounds of the action spec must be finite with low < high, got {low} and {high}. "
            "Wrap the env so that it declares the range that it uses."
        )
    if action_dim not in (None, spec.shape[-1]):
        raise ValueError(
            f"The network has action_dim={action_dim}, the spec {spec.shape[-1]}: they must agree."
        )
    return spec
