"""Activations against numbers worked out by hand, against PyTorch's own, and compiled."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from by_hand import TENSORS, assert_close, tensor
from torchrl_aca import activations as A


def test_mish_and_slope_by_hand():
    # tanh(log 2) = 3/5 at x = 0: mish = 0, slope = 3/5.
    value, slope = A.mish_and_slope(tensor(0.0))
    assert_close(value, tensor(0.0))
    assert_close(slope, tensor(0.6))


MISH_DTYPES = [
    (torch.float16, 1e-3),
    (torch.bfloat16, 1e-2),
    (torch.float32, 2e-6),
    (torch.float64, 5e-15),
]


@pytest.mark.parametrize(("dtype", "tolerance"), MISH_DTYPES)
def test_mish_and_slope_agree_with_autograd_and_stay_finite(dtype, tolerance):
    x = torch.linspace(-100, 100, 20_001, dtype=dtype)
    exact = x.double().requires_grad_()
    expected = nn.functional.mish(exact)
    (expected_slope,) = torch.autograd.grad(expected.sum(), exact)
    value, slope = A.mish_and_slope(x)
    assert value.dtype == slope.dtype == dtype
    assert value.isfinite().all() and slope.isfinite().all()
    torch.testing.assert_close(value.double(), expected.detach(), rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(slope.double(), expected_slope, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", [dtype for dtype, _ in MISH_DTYPES])
def test_slope_of_mish_is_one_up_to_the_largest_number(dtype):
    large = torch.tensor([50.0, 1e3, torch.finfo(dtype).max], dtype=dtype)
    value, slope = A.mish_and_slope(large)
    assert torch.equal(value, large) and (slope == 1).all()


def test_mish_by_hand():
    # e = 2 and n = 8 at x = log 2: mish = 4/5 log 2.
    assert_close(A.mish(tensor(math.log(2))), tensor(0.8 * math.log(2)))


@pytest.mark.parametrize(("dtype", "tolerance"), MISH_DTYPES)
def test_mish_and_its_gradient_agree_with_pytorchs(dtype, tolerance):
    x = torch.linspace(-100, 100, 20_001, dtype=dtype).requires_grad_()
    exact = x.detach().double().requires_grad_()
    expected, value = nn.functional.mish(exact), A.mish(x)
    (expected_slope,) = torch.autograd.grad(expected.sum(), exact)
    (slope,) = torch.autograd.grad(value.sum(), x)
    assert value.dtype == slope.dtype == dtype
    torch.testing.assert_close(value.double(), expected.detach(), rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(slope.double(), expected_slope, rtol=tolerance, atol=tolerance)


def test_relu_and_its_gradient_by_hand():
    x = tensor(-2.0, 0.0, 3.0).requires_grad_()
    value = A.relu(x)
    assert_close(value.detach(), tensor(0.0, 0.0, 3.0))
    (slope,) = torch.autograd.grad(value, x, tensor(5.0, 5.0, 5.0))
    assert_close(slope, tensor(0.0, 0.0, 5.0))  # at 0 as PyTorch's own


@pytest.mark.parametrize("activation", [nn.Mish(), nn.ReLU(), nn.Tanh()])
def test_an_activation_is_the_same_compiled_and_not(activation):
    x = torch.linspace(-5, 5, 101, dtype=torch.float64).requires_grad_()
    compiled = torch.compile(A.activate, fullgraph=True)(activation, x)
    torch.testing.assert_close(compiled, activation(x), rtol=1e-12, atol=1e-12)
    slopes = [torch.autograd.grad(y.sum(), x)[0] for y in (compiled, activation(x))]
    torch.testing.assert_close(*slopes, rtol=1e-12, atol=1e-12)


ACTIVATIONS = [nn.Mish, nn.ReLU, nn.GELU, nn.SiLU, nn.Tanh, nn.ELU, nn.Softplus, nn.LeakyReLU]


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_activation_and_slope_agree_with_autograd_in_every_grad_mode(activation, mode):
    x = torch.linspace(-4, 4, 80, **TENSORS).requires_grad_()  # does not touch the kink at 0
    expected = activation()(x)
    (expected_slope,) = torch.autograd.grad(expected.sum(), x)
    with mode():
        value, slope = A.activation_and_slope(activation(), x.detach())
    assert_close(value.detach(), expected.detach())
    assert_close(slope.detach(), expected_slope)
