"""Layers of several networks at once: what critics and ensembles are made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["StackedLinear", "truncated_normal_"]


def truncated_normal_(weight: Tensor, num_in: int) -> None:
    """Fill with a truncated normal of standard deviation ``num_in^-1/2``, cut at two of them."""
    std = num_in**-0.5
    nn.init.trunc_normal_(weight, std=std, a=-2 * std, b=2 * std)


class StackedLinear(nn.Module):
    """``E`` independent linear layers as one product, ``(E, rows, in) -> (E, rows, out)``.

    Biases begin at zero.

    Args:
        num_members: ``E``.
        num_in: size of the input.
        num_out: size of the output.
        init: fills the weights, shape ``(E, in, out)``, given them and ``num_in``. Default:
            :func:`truncated_normal_`.
        factory: device and dtype.
    """

    def __init__(
        self,
        num_members: int,
        num_in: int,
        num_out: int,
        init: Callable[[Tensor, int], object] = truncated_normal_,
        **factory: Any,
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num_members, num_in, num_out, **factory))
        self.bias = nn.Parameter(torch.empty(num_members, 1, num_out, **factory))
        self._init = init
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw the weights anew."""
        self._init(self.weight, self.weight.shape[1])
        nn.init.zeros_(self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """The layers' outputs."""
        # Not baddbmm, which first fills its output with the bias: a compiler can fuse the sum.
        return (x @ self.weight).add_(self.bias)

    def extra_repr(self) -> str:
        """Sizes, for ``repr``."""
        num_members, num_in, num_out = self.weight.shape
        return f"num_members={num_members}, num_in={num_in}, num_out={num_out}"
