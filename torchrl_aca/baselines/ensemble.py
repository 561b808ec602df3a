"""An ensemble of MLPs as one module."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_aca.activations import activate
from torchrl_aca.stacked import StackedLinear

__all__ = ["EnsembleMLP"]


class EnsembleMLP(nn.Module):
    """``E`` independent MLPs with one output each, evaluated together by batched matrix products.

    A hidden layer is linear, LayerNorm, ReLU. Every parameter is a stack over the members along its
    first dimension, so ``p[members]`` of each is an ensemble of some of them. Weights are
    Xavier-uniform, drawn for each member on its own, and biases zero.

    Args:
        in_features: size of the input, after all inputs have been joined.
        num_members: number ``E`` of networks. Default: 10.

    Keyword Args:
        num_cells: widths of the hidden layers. Default: two of 256.
        layer_norm: normalise each hidden layer before its ReLU. Default: True.
        device: device of the parameters.
        dtype: dtype of the parameters.

    Raises:
        ValueError: if a size is not positive or there is no hidden layer.

    Examples:
        >>> from torchrl_aca.baselines import EnsembleMLP
        >>> critics = EnsembleMLP(3 + 2, num_members=10)
        >>> critics(torch.zeros(8, 3), torch.zeros(8, 2)).shape
        torch.Size([8, 10])
    """

    def __init__(
        self,
        in_features: int,
        num_members: int = 10,
        *,
        num_cells: Sequence[int] = (256, 256),
        layer_norm: bool = True,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        widths = [in_features, *num_cells]
        if min(num_members, *widths) < 1 or not num_cells:
            raise ValueError(
                "EnsembleMLP expects positive sizes and at least one hidden layer; got "
                f"in_features={in_features}, num_members={num_members}, "
                f"num_cells={tuple(num_cells)}."
            )
        factory = {"device": device, "dtype": dtype}
        layers: list[nn.Module] = []
        for num_in, num_out in zip(widths, num_cells, strict=False):
            layers.append(StackedLinear(num_members, num_in, num_out, _xavier_uniform, **factory))
            if layer_norm:
                layers.append(_StackedLayerNorm(num_members, num_out, **factory))
            layers.append(nn.ReLU())
        layers.append(StackedLinear(num_members, widths[-1], 1, _xavier_uniform, **factory))
        self.layers = nn.Sequential(*layers)

    @property
    def weights(self) -> list[nn.Parameter]:
        """The linear layers' weights, first to last, ``(E, in, out)`` each."""
        return [layer.weight for layer in self.layers if isinstance(layer, StackedLinear)]

    def forward(self, *inputs: Tensor) -> Tensor:
        """Outputs ``(*batch, E)`` for inputs ``(*batch, ...)``, joined along the last dimension."""
        x = torch.cat(inputs, -1)
        weight = self.weights[0]
        rows = x.reshape(-1, x.shape[-1]).expand(weight.shape[0], -1, -1)
        for layer in self.layers:
            rows = activate(layer, rows) if isinstance(layer, nn.ReLU) else layer(rows)
        return rows.squeeze(-1).mT.reshape(*x.shape[:-1], weight.shape[0])


def _xavier_uniform(weight: Tensor, num_in: int) -> None:
    """Member by member: of the stack, Xavier's rule would misread the sizes."""
    for member in weight:
        nn.init.xavier_uniform_(member)


class _StackedLayerNorm(nn.Module):
    """``E`` layer normalisations over the last dimension; epsilon is 1e-6, as in Flax."""

    def __init__(self, num_members: int, num_features: int, **factory: Any) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num_members, 1, num_features, **factory))
        self.bias = nn.Parameter(torch.zeros(num_members, 1, num_features, **factory))

    def forward(self, x: Tensor) -> Tensor:
        normalised = nn.functional.layer_norm(x, x.shape[-1:], eps=1e-6)
        return torch.addcmul(self.bias, normalised, self.weight)
