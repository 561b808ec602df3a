"""How far the actions of two chains are apart."""

from __future__ import annotations

import torch
from torch import Tensor


def energy_distance_test(
    samples: Tensor, others: Tensor, num_permutations: int, generator: torch.Generator
) -> tuple[float, float]:
    """The energy distance of two samples, and the p-value of its permutation test.

    The distance is `2 E|X - Y| - E|X - X'| - E|Y - Y'|` (Szekely & Rizzo 2013), zero for equal
    distributions; the test shuffles who belongs to which sample.

    Args:
        samples: Points of shape `(n, A)`.
        others: Points of shape `(n, A)`, as many.
        num_permutations: How many shuffles the p-value rests on.
        generator: Draws the shuffles.

    Returns:
        The distance, and the share of the shuffles, the given order among them, that reach it.
    """
    pooled = torch.cat([samples, others])
    distances = torch.cdist(pooled, pooled, compute_mode="donot_use_mm_for_euclid_dist")
    signs = torch.ones(len(pooled), 1)
    signs[len(samples) :] = -1
    shuffled = [
        signs[torch.randperm(len(pooled), generator=generator)] for _ in range(num_permutations)
    ]
    signs = torch.cat([signs, *shuffled], dim=1).to(distances)
    # With signs +1 and -1, the three means are one quadratic form.
    statistics = -(signs * (distances @ signs)).sum(0) / len(samples) ** 2
    return float(statistics[0]), float((statistics >= statistics[0]).double().mean())


def spread(candidates: Tensor) -> float:
    """The standard deviation over the candidates, dimension 0, averaged over all else."""
    return float(candidates.std(0).mean())
