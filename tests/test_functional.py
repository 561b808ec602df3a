"""Every equation against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from by_hand import TENSORS, assert_close, tensor
from torchrl_aca import functional as F


def test_cosine_betas_by_hand():
    # Without offset g = cos^2 is 1, 1/2, 0 at t = 0, 1, 2: the betas are 1/2 and 1, cut to 0.999.
    assert_close(F.cosine_betas(2, offset=0.0), tensor(0.5, 0.999))


def test_linear_betas_by_hand():
    assert_close(F.linear_betas(3, 0.1, 0.3, scale=0.5), tensor(0.05, 0.1, 0.15))


def test_vp_betas_by_hand():
    # T = 2: rates 0.1/2 + 9.9 * 1/8 = 1.2875 and 0.1/2 + 9.9 * 3/8 = 3.7625.
    assert_close(F.vp_betas(2), tensor(1 - math.exp(-1.2875), 1 - math.exp(-3.7625)))


def test_add_noise_by_hand():
    # alpha_bar = 0.64: 0.8 * 0.5 + 0.6 * (-1) = -0.2.
    assert_close(F.add_noise(tensor(0.5), tensor(-1.0), tensor(0.64)), tensor(-0.2))


def test_predict_clean_by_hand_inverts_add_noise():
    # -0.2 / 0.8 - sqrt(1 / 0.64 - 1) * (-1) = -0.25 + 0.75 = 0.5.
    assert_close(F.predict_clean(tensor(-0.2), tensor(-1.0), tensor(0.64)), tensor(0.5))


def test_guided_noise_by_hand_points_against_the_gradient():
    # -50 * 0.1 * (1, -2) = (-5, 10).
    assert_close(F.guided_noise(tensor(1.0, -2.0), 50.0, tensor(0.1)[0]), tensor(-5.0, 10.0))


def test_normalize_gradient_by_hand():
    # ||(3, 4)|| = 5; the zero vector stays zero.
    gradient = torch.stack([tensor(3.0, 4.0), tensor(0.0, 0.0)])
    assert_close(
        F.normalize_gradient(gradient), torch.stack([tensor(0.6, 0.8), tensor(0.0, 0.0)]), atol=1e-8
    )


def test_posterior_mean_by_hand():
    # 0.25 * 2 + 0.5 * 4 = 2.5.
    assert_close(F.posterior_mean(tensor(2.0), tensor(4.0), tensor(0.25), tensor(0.5)), tensor(2.5))


def test_langevin_step_by_hand():
    # 1 + 0.04/2 * 3 * 2 + 0.2 * (-0.5) = 1 + 0.12 - 0.1 = 1.02.
    step_size = tensor(0.04)[0]
    assert_close(
        F.langevin_step(tensor(1.0), tensor(2.0), 3.0, step_size, tensor(-0.5)), tensor(1.02)
    )


def test_sinusoidal_embedding_by_hand():
    # dim = 4: frequencies 1 and 10000^(-1/2) = 0.01, sines first, all over sqrt(4).
    expected = tensor(math.sin(3), math.sin(0.03), math.cos(3), math.cos(0.03)) / 2
    assert_close(F.sinusoidal_embedding(tensor(3.0)[0], 4), expected)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_sinusoidal_embedding_appends_one_dimension(shape):
    assert F.sinusoidal_embedding(torch.zeros(shape), 16).shape == (*shape, 16)


def test_noise_level_target_by_hand():
    clean = torch.stack([tensor(1.0, 3.0), tensor(-2.0, 0.0)])
    assert_close(F.noise_level_target(clean, "self"), clean)
    expected = torch.stack([tensor(2.0, 2.0), tensor(-1.0, -1.0)])
    assert_close(F.noise_level_target(clean, "mean"), expected)


def test_select_best_by_hand_takes_the_largest_minimum():
    # Minima of the three candidates: 0, 1, -5. The mean or the first critic would take the third.
    candidates = torch.arange(6, **TENSORS).view(3, 2)
    values = torch.stack([tensor(0.0, 4.0), tensor(1.0, 2.0), tensor(99.0, -5.0)])
    assert_close(F.select_best(candidates, values), candidates[1])


def test_select_best_takes_the_first_of_equals():
    candidates = torch.arange(6, **TENSORS).view(3, 2)
    values = torch.stack([tensor(0.0, 4.0), tensor(1.0, 2.0), tensor(2.0, 1.0)])
    assert_close(F.select_best(candidates, values), candidates[1])


@pytest.mark.parametrize("batch", [(), (4,), (4, 2)])
def test_select_best_chooses_state_by_state(batch):
    candidates, values = torch.randn(5, *batch, 3), torch.randn(5, *batch, 2)
    best = F.select_best(candidates, values).reshape(-1, 3)
    rows, scores = candidates.reshape(5, -1, 3), values.amin(-1).reshape(5, -1)
    for i, action in enumerate(best):
        assert_close(action, rows[scores[:, i].argmax(), i])


def test_surrogate_entropy_by_hand():
    # A = 2, scale * alpha = 0.1 * 10 = 1: entropy of a standard normal in two dimensions.
    expected = tensor(math.log(2 * math.pi * math.e))[0]
    assert_close(F.surrogate_entropy(tensor(math.log(10))[0], 2), expected)
    # Half the standard deviation costs log 2 nats per dimension.
    assert_close(F.surrogate_entropy(tensor(math.log(5))[0], 2, 0.1), expected - 2 * math.log(2))
    assert_close(F.surrogate_entropy(tensor(math.log(10))[0], 2, 0.05), expected - 2 * math.log(2))
