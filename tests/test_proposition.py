from __future__ import annotations

import pytest
import torch

import oracle
from torchrl_aca import NoiseLevelCritic, NoiseSchedule

T, MEAN, STD, BEST = 5, 0.3, 0.5, -0.2


@pytest.fixture(scope="module")
def regressed_critic():
    """A critic regressed, at every level, on the values ``-(a_0 - c)^2`` of the clean actions."""
    torch.manual_seed(0)
    schedule = NoiseSchedule.cosine(T)
    critic = NoiseLevelCritic(1, 1, num_steps=T, num_critics=1, num_cells=(32, 32))
    num_updates, batch = 1500, 2048
    optimizer = torch.optim.Adam(critic.parameters(), 1e-2)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_updates)
    observation, level = torch.zeros(batch, 1), torch.arange(batch) % (T + 1)
    for _ in range(num_updates):
        clean = MEAN + STD * torch.randn(batch, 1)
        noisy = schedule.add_noise(clean, torch.randn(batch, 1), level.clamp(min=1))
        noisy = torch.where(level.unsqueeze(-1) > 0, noisy, clean)
        loss = (critic(observation, noisy, level) + (clean - BEST).square()).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()
    return critic.requires_grad_(False), schedule


@pytest.mark.parametrize("level", range(T + 1))
def test_regression_on_clean_values_finds_the_posterior_mean_of_proposition_1(
    regressed_critic, level
):
    """``Q(s, a_t, t) = E[Q(s, a_0, 0) | a_t]``; compared where 87 % of the noisy actions lie.

    The values there span from 0.01 (nearly pure noise) to 1.6; the tolerance is 0.05.
    """
    critic, schedule = regressed_critic
    alpha_cumprod = float(schedule.alphas_cumprod[level - 1]) if level else 1.0
    std = (alpha_cumprod * STD**2 + 1 - alpha_cumprod) ** 0.5
    action = alpha_cumprod**0.5 * MEAN + std * torch.linspace(-1.5, 1.5, 41).unsqueeze(-1)
    value = critic(torch.zeros(41, 1), action, torch.full((41,), level))
    expected = oracle.proposition_1_closed_form(action, alpha_cumprod, MEAN, STD, BEST)
    torch.testing.assert_close(value, expected, rtol=0, atol=0.05)
