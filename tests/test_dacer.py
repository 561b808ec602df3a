"""DACER against NumPy: critics that tell a Gaussian, the chain that is climbed, the temperature."""

from __future__ import annotations

import numpy as np
import torch

from torchrl_aca.baselines.dacer import distributional_error, running_scale

# --- the critics' error ---------------------------------------------------------------------------


def oracle_slopes(q, std, y, y_z, scale, eps=0.1):
    """Per number: the derivative of the critics' error by the mean and by the deviation."""
    by_q, by_std = np.empty_like(q), np.empty_like(q)
    for row, i in np.ndindex(q.shape):
        m, s = scale[i], std[row, i]
        bounded = q[row, i] + np.clip(y_z[row, i] - q[row, i], -3 * m, 3 * m)
        by_q[row, i] = -(m**2 + eps) * (y[row, 0] - q[row, i]) / (s**2 + eps)
        by_std[row, i] = -(m**2 + eps) * ((q[row, i] - bounded) ** 2 - s**2) / (s**3 + eps)
    return by_q, by_std


def numbers(seed=0, rows=9):
    rng = np.random.default_rng(seed)
    q, y_z = rng.normal(size=(2, rows, 2))
    std, y = np.exp(rng.normal(size=(rows, 2))), rng.normal(size=(rows, 1))
    return q, std, y, 4 * y_z, np.array([0.3, 1.2])


def test_errors_and_their_slopes_are_the_oracles():
    q, std, y, y_z, scale = numbers()
    tensors = [torch.from_numpy(value) for value in (q, std, y, y_z, scale)]
    outputs = [tensor.requires_grad_() for tensor in tensors[:2]]
    error = distributional_error(*tensors)
    by_q, by_std = oracle_slopes(q, std, y, y_z, scale)
    np.testing.assert_allclose(error.detach(), q * by_q + std * by_std, rtol=1e-12)
    mean_slope, std_slope = torch.autograd.grad(error.sum(), outputs)
    np.testing.assert_allclose(mean_slope, by_q, rtol=1e-12)
    np.testing.assert_allclose(std_slope, by_std, rtol=1e-12)


def test_the_draw_is_bounded_by_three_deviations_of_the_batch():
    q, std, y, y_z, scale = map(torch.from_numpy, numbers())
    far = q + 100 * (y_z - q).sign() * scale
    bounded = distributional_error(q, std, y, far, scale)
    edge = distributional_error(q, std, y, q + 3 * (y_z - q).sign() * scale, scale)
    torch.testing.assert_close(bounded, edge)
    assert not torch.allclose(distributional_error(q, std, y, y_z, scale), bounded)


def test_the_fixed_point_is_the_targets_mean_and_deviation():
    """Where mean and deviation are the target's, the slopes vanish in the mean over draws."""
    torch.manual_seed(0)
    y_z = 2.0 + 0.5 * torch.randn(200_000, 1, dtype=torch.float64)
    mean = torch.full((200_000, 1), 2.0, dtype=torch.float64, requires_grad=True)
    std = torch.full((200_000, 1), 0.5, dtype=torch.float64, requires_grad=True)
    target, scale = torch.full_like(mean, 2.0).detach(), torch.tensor([10.0]).double()
    error = distributional_error(mean, std, target, y_z, scale).mean()
    slopes = torch.autograd.grad(error, (mean, std))
    weight = 100.1 / (0.125 + 0.1)
    assert slopes[0].abs().max() == 0
    assert abs(slopes[1].sum().item()) < 5 * weight * 0.25 * 2**0.5 / 200_000**0.5


def test_the_running_scale_begins_with_the_first_batch_and_then_moves_slowly():
    std = torch.rand(4, 3, 2, dtype=torch.float64) + 0.1
    first = running_scale(torch.zeros(2).double(), std, 0.25)
    torch.testing.assert_close(first, std.mean((0, 1)))
    second = running_scale(first, 3 * std, 0.25)
    torch.testing.assert_close(second, 1.5 * first)
