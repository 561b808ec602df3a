"""Soft values of all candidates in the TD target: numbers, limits, and what draws they take."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from loss_cases import NUM_STEPS, make_actor, make_data, make_loss, set_constant
from torchrl_aca import NoiseLevelCritic
from torchrl_aca import functional as F


def oracle(values, temperature):
    """In float64, from the definition."""
    lowest = np.asarray(values, dtype=np.float64).min(-1)
    highest = lowest.max(0)
    return highest + temperature * np.log(np.exp((lowest - highest) / temperature).mean(0))


@pytest.mark.parametrize("temperature", [0.01, 0.3, 2.0, 50.0])
def test_it_equals_the_oracle(temperature):
    values = torch.randn(32, 5, 7, 2)
    actual = F.soft_value(values, temperature)
    np.testing.assert_allclose(actual, oracle(values, temperature), rtol=1e-5, atol=1e-6)


def test_it_is_the_best_of_all_without_temperature_and_their_mean_with_much():
    values = 100 * torch.randn(32, 6, 2) + 1000
    lowest = values.amin(-1)
    best, mean = lowest.amax(0), lowest.mean(0)
    for temperature in (1e-30, 1e-6):
        torch.testing.assert_close(F.soft_value(values, temperature), best)
    for temperature in (1e8, 1e30):  # where exp((V - max) / tau) is 1 in float32
        torch.testing.assert_close(F.soft_value(values, temperature), mean)
    between = F.soft_value(values, 50.0)
    assert ((mean < between) & (between < best)).all()


def test_two_candidates_by_hand():
    values = torch.tensor([[[1.0, 3.0]], [[2.0, 0.0]]])  # the smaller ones are 1 and 0
    # log((e + 1) / 2) = 0.62011
    assert F.soft_value(values, 1.0).item() == pytest.approx(0.62011, abs=1e-5)


def double_loss(**kwargs):
    sizes = {"num_steps": NUM_STEPS, "num_cells": (16, 16), "dtype": torch.float64}
    loss = make_loss(make_actor(NoiseLevelCritic(3, 2, **sizes)), target_value="soft", **kwargs)
    loss.make_value_estimator(gamma=0.875)  # exact in the estimator's float32
    return loss


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
def test_the_target_is_the_soft_value_of_the_target_critics(batch):
    loss = double_loss(temperature=0.05, reward_scale=0.5)
    data = make_data(*batch).apply(lambda x: x.double() if x.is_floating_point() else x)
    data["next_action"] = torch.rand(*batch, 4, 2, dtype=torch.float64) * 2 - 1
    out = loss.qvalue_loss(data)
    critic, level = loss.actor_network.critic, torch.zeros(*batch, 4, dtype=torch.long)
    observation = data["next", "observation"].unsqueeze(-2).expand(*batch, 4, 3)
    with torch.no_grad(), loss.target_qvalue_network_params.to_module(critic):
        values = critic(observation, data["next_action"], level).movedim(-2, 0)
    expected = 0.5 * data["next", "reward"].squeeze(-1).numpy() + 0.875 * oracle(values, 0.05)
    assert out["target_value"].item() == pytest.approx(expected.mean(), rel=1e-10)


def test_all_candidates_of_a_state_are_drawn_each_with_noise_of_its_own():
    loss, data = make_loss(make_actor(exploration_noise=0.0), target_value="soft"), make_data(5)
    clean = loss.sample_next_action(data)
    assert clean.shape == (5, 3, 2) and clean.abs().max() <= 1
    loss.actor_network.exploration_noise = 100.0
    noise = loss.sample_next_action(data)
    assert noise.std(1).min() > 1  # the candidates of one state lie apart


def test_it_goes_with_an_automatic_weight_and_reads_what_it_has_drawn():
    loss, data = make_loss(target_value="soft", guidance_weight="auto"), make_data(5)
    data["next_action"] = loss.sample_next_action(data)
    loss.step_guidance_weight(data)
    first = loss.qvalue_loss(data)
    torch.testing.assert_close(loss.qvalue_loss(data), first, rtol=0, atol=0)


def test_equal_values_have_that_soft_value_whatever_the_temperature():
    for temperature in (1e-6, 0.1, 1e6):
        loss = make_loss(target_value="soft", temperature=temperature, reward_scale=0.0)
        loss.make_value_estimator(gamma=0.5)
        set_constant(loss, online=0.0, target=3.0)
        assert loss.qvalue_loss(make_data(2))["target_value"].item() == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"target_value": "mean"}, "Expected target_value to be one of"),
        ({"temperature": 0.0}, "Expected temperature > 0"),
    ],
)
def test_wrong_settings_are_told(settings, message):
    with pytest.raises(ValueError, match=message):
        make_loss(**settings)
