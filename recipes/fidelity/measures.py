"""How far the actions of two chains are apart."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_aca import CriticGuidedDenoisingActor
from torchrl_aca import functional as F


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


@torch.no_grad()
def border_shares(
    actor: CriticGuidedDenoisingActor, states: Tensor, num_candidates: int
) -> list[float]:
    """How many coordinates of the clean estimate the clip moves, at each level of a whole chain.

    Args:
        actor: An actor that visits all of its levels.
        states: Observations of shape `(states, O)`.
        num_candidates: Chains for each state.

    Returns:
        The shares, from level 1 to T.
    """
    schedule, shape = actor.schedule, (num_candidates, len(states), actor.action_dim)
    path = actor.trajectory(states, torch.randn(schedule.num_steps + 1, *shape))
    features = actor.encode(states, states.shape[:-1])
    shares = []
    for level in schedule.noise_levels:
        action = path[schedule.num_steps - level]
        gradient = actor.critic.action_gradient(features, action, level)
        if actor.normalize_gradient:
            gradient = F.normalize_gradient(gradient)
        sigma = schedule.posterior_variance[level - 1].sqrt()
        noise = F.guided_noise(gradient, actor.guidance_weight, sigma)
        clean = F.predict_clean(action, noise, schedule.alphas_cumprod[level - 1])
        shares.append(float((clean.abs() > 1).double().mean()))
    return shares
