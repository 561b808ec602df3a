"""Elementwise activations, their slopes, and the forms of them that are fast once compiled."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

__all__ = ["activate", "activation_and_slope", "mish", "mish_and_slope", "relu"]


def mish_and_slope(x: Tensor) -> tuple[Tensor, Tensor]:
    """``mish(x) = x tanh(softplus(x))`` and its derivative from one shared exponential.

    With ``e = exp(x)`` and ``n = e (e + 2)``: ``tanh(softplus(x)) = n / (n + 2)``, whose derivative
    is ``4 e (e + 1) / (n + 2)^2``. Beyond ``x = 40`` both are their limits 1 and 0 to the last
    bit of float64, so the exponent is cut there and never overflows.

    The steps in between reuse their memory, because fresh memory costs a CPU more than the
    arithmetic: the results are not to be differentiated. Float16, where ``n`` is infinite from
    ``x = 5.6`` on, is computed in float32, as PyTorch's own Mish is.
    """
    if x.dtype == torch.float16:
        value, slope = mish_and_slope(x.float())
        return value.half(), slope.half()
    bounded = x.clamp(max=40.0)
    e = bounded.exp()
    n = (e + 2).mul_(e)
    inverse = (n + 2).reciprocal_()
    gate = n.mul_(inverse)
    slope = (e + 1).mul_(e).mul_(inverse).mul_(inverse).mul_(bounded.mul_(4))
    return x * gate, slope.add_(gate)


def mish(x: Tensor) -> Tensor:
    """``mish(x) = x tanh(softplus(x))``; the backward pass multiplies by the forward pass's slope.

    PyTorch's own takes an exponential, a logarithm and a hyperbolic tangent, and a compiler follows
    it there; this takes one exponential (:func:`mish_and_slope`). It is differentiable once.
    """
    return cast(Tensor, _Mish.apply(x)[0])


class _Mish(torch.autograd.Function):
    """Mish and its slope by :func:`mish_and_slope`; in this form ``torch.func`` knows it too."""

    @staticmethod
    def forward(x: Tensor) -> tuple[Tensor, Tensor]:
        return mish_and_slope(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, Tensor]) -> None:
        slope = output[1]
        ctx.mark_non_differentiable(slope)
        ctx.save_for_backward(slope)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: Any) -> Tensor:
        (slope,) = ctx.saved_tensors
        return gradient * slope


def relu(x: Tensor) -> Tensor:
    """``max(x, 0)``; the backward pass multiplies by the sign of the result.

    Of PyTorch's own a compiler keeps where the result is zero, as booleans, which its code for a
    CPU writes so slowly that they cost more than the layer's products (PyTorch 2.13). It is
    differentiable once.
    """
    return cast(Tensor, _ReLU.apply(x))


class _ReLU(torch.autograd.Function):
    """ReLU in the form that ``torch.func`` knows too."""

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.clamp(min=0)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(output)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (output,) = ctx.saved_tensors
        return gradient * output.sign()


def activate(activation: nn.Module, x: Tensor) -> Tensor:
    """``f(x)`` of an elementwise activation: Mish and ReLU in the form that is fast to compile."""
    if torch.compiler.is_compiling():
        if isinstance(activation, nn.Mish):
            return mish(x)
        if isinstance(activation, nn.ReLU):
            return relu(x)
    return activation(x)


def activation_and_slope(activation: nn.Module, x: Tensor) -> tuple[Tensor, Tensor]:
    """``f(x)`` and ``f'(x)`` of an elementwise activation, in one forward-mode pass."""
    if isinstance(activation, nn.Mish):
        return mish_and_slope(x)
    pair = torch.func.jvp(activation, (x,), (torch.ones_like(x),))
    return pair[0], pair[1]
