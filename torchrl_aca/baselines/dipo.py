"""DIPO: a diffusion policy that imitates actions, which the critics improve."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchrl_aca.chain import StepRunner
from torchrl_aca.checks import check_above, check_at_least

__all__ = ["improve_actions"]

_EAGER = StepRunner(compiled=False)


def improve_actions(
    gradient: Callable[[Tensor], Tensor],
    action: Tensor,
    *,
    num_steps: int = 30,
    lr: float = 0.03,
    max_norm: float = 0.16,
    run: Callable[..., Any] = _EAGER,
) -> Tensor:
    """DIPO's action gradient: steps of a fresh Adam up the critics' value, inside [-1, 1].

    The gradient of the whole batch has its length cut at ``max_norm`` before Adam sees it, and
    actions are clipped after each step. Adam hardly knows the gradient's scale: each coordinate
    moves about ``lr`` a step where its sign is stable.

    Args:
        gradient: ``action -> dQ/da`` of the same shape.
        action: where to start, shape ``(B, A)``, in [-1, 1].

    Keyword Args:
        num_steps: ``K``. Default: 30.
        lr: Adam's learning rate. Default: 0.03.
        max_norm: largest length of the gradient, over all ``B * A`` numbers. Default: 0.16.
        run: calls a step with its arguments; a :class:`~torchrl_aca.chain.StepRunner` to compile
            it.

    Returns:
        Improved actions of the same shape.

    Raises:
        ValueError: if a number is out of range.
    """
    check_at_least(1, num_steps=num_steps)
    check_above(0, lr=lr, max_norm=max_norm)
    state = action, torch.zeros_like(action), torch.zeros_like(action)
    for count in torch.arange(1, num_steps + 1, dtype=action.dtype, device=action.device):
        state = run(_ascend, gradient, lr, max_norm, count, *state)
    return state[0]


def _ascend(
    gradient: Callable[[Tensor], Tensor],
    lr: float,
    max_norm: float,
    count: Tensor,
    action: Tensor,
    first: Tensor,
    second: Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of Adam upwards: the action and both moments."""
    slope = gradient(action)
    norm = torch.linalg.vector_norm(slope)
    slope = slope * (max_norm / norm.clamp(min=max_norm))
    first = betas[0] * first + (1 - betas[0]) * slope
    second = betas[1] * second + (1 - betas[1]) * slope.square()
    mean = first / (1 - betas[0] ** count)
    scale = (second / (1 - betas[1] ** count)).sqrt() + eps
    return (action + lr * mean / scale).clamp(-1, 1), first, second
