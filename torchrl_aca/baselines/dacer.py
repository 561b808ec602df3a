"""DACER: a diffusion policy that climbs the critics through its whole chain."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["distributional_error", "running_scale"]


def distributional_error(
    mean: Tensor,
    std: Tensor,
    target: Tensor,
    target_draw: Tensor,
    scale: Tensor,
    eps: float = 0.1,
) -> Tensor:
    """Errors of critics that tell a Gaussian of the return (DSAC-T), shape of ``mean``.

    With ``y`` the target's mean, ``y_z`` a draw of the target, ``M`` the critic's running standard
    deviation and ``y_b = q + clip(y_z - q, -3M, 3M)``::

        -(M^2 + eps) (q sg[(y - q) / (std^2 + eps)]
                      + std sg[((q - y_b)^2 - std^2) / (std^3 + eps)])

    whose gradient, not whose value, means something.

    Args:
        mean: the critics' means ``q``, shape ``(*batch, E)``.
        std: their standard deviations, same shape.
        target: ``y``, shape ``(*batch, 1)``.
        target_draw: ``y_z``, broadcastable to that of ``mean``.
        scale: ``M``, shape ``(E,)``.
        eps: keeps the divisions bounded. Default: 0.1.
    """
    q, deviation = mean.detach(), std.detach()
    bounded = q + torch.minimum((target_draw - q).maximum(-3 * scale), 3 * scale)
    by_mean = (target - q) / (deviation.square() + eps)
    by_std = ((q - bounded).square() - deviation.square()) / (deviation.pow(3) + eps)
    return -(scale.square() + eps) * (mean * by_mean + std * by_std)


def running_scale(scale: Tensor, std: Tensor, tau: float) -> Tensor:
    """``M`` after another batch: ``tau mean(std) + (1 - tau) M``, and the first batch's mean.

    Args:
        scale: ``M`` so far, shape ``(E,)``; zero before the first batch.
        std: the critics' standard deviations, shape ``(*batch, E)``.
        tau: rate.
    """
    latest = std.detach().reshape(-1, std.shape[-1]).mean(0)
    return torch.where(scale > 0, tau * latest + (1 - tau) * scale, latest)
