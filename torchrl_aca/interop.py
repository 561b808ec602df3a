"""Parameters of the official JAX code to a :class:`NoiseLevelCritic`, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from torchrl_aca.critic import NoiseLevelCritic

__all__ = ["load_official", "to_official"]


def load_official(critic: NoiseLevelCritic, *members: Mapping[str, Any]) -> NoiseLevelCritic:
    """Copy the official code's parameters into ``critic``, in place.

    Args:
        critic: built with the sizes of the official networks.
        *members: one mapping per critic (``q1, q2``) from ``"linear.w"``, ``"linear.b"``,
            ``"linear_1.w"``, ... to arrays of shape ``(in, out)`` and ``(out,)``. ``linear`` and
            ``linear_1`` are the level features, then come the hidden layers, then the output.

    Returns:
        ``critic``.

    Raises:
        ValueError: if the number of members, the names or the shapes do not fit; nothing is copied.
    """
    expected = to_official(critic)
    if len(members) != len(expected):
        raise ValueError(f"Expected {len(expected)} critics, got {len(members)}.")
    for index, (member, own) in enumerate(zip(members, expected, strict=True)):
        wanted = {name: array.shape for name, array in own.items()}
        given = {name: np.shape(array) for name, array in member.items()}
        if wanted != given:
            raise ValueError(
                f"Critic {index} does not fit: expected {wanted}, got {given}. "
                "Build the NoiseLevelCritic with the sizes of these arrays."
            )
    with torch.no_grad():
        for index, member in enumerate(members):
            for name, layer in _layers(critic).items():
                layer.weight[index].copy_(torch.as_tensor(np.array(member[f"{name}.w"])))
                layer.bias[index, 0].copy_(torch.as_tensor(np.array(member[f"{name}.b"])))
    return critic


def to_official(critic: NoiseLevelCritic) -> tuple[dict[str, np.ndarray], ...]:
    """The inverse of :func:`load_official`: one dict of arrays per critic."""

    def arrays(index: int) -> dict[str, np.ndarray]:
        out = {}
        for name, layer in _layers(critic).items():
            out[f"{name}.w"] = layer.weight[index].detach().cpu().numpy().copy()
            out[f"{name}.b"] = layer.bias[index, 0].detach().cpu().numpy().copy()
        return out

    return tuple(arrays(index) for index in range(critic.num_critics))


def _layers(critic: NoiseLevelCritic) -> dict[str, Any]:
    layers = [critic.level_in, critic.level_out, *critic.hidden, critic.value]
    return {"linear" if i == 0 else f"linear_{i}": layer for i, layer in enumerate(layers)}
