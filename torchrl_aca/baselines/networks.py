"""The networks of the diffusion-policy baselines: a level-conditioned policy, and twin critics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from torchrl_aca import functional as F
from torchrl_aca.activations import activate
from torchrl_aca.checks import check_choice
from torchrl_aca.stacked import StackedLinear, truncated_normal_

__all__ = ["NoiseNetwork", "TwinCritic", "action_gradient"]

Embedding = Literal["mlp", "sinusoidal", "none"]


def action_gradient(
    critic: Any, features: Any, action: Tensor, reduce: Callable[[Tensor], Tensor]
) -> Tensor:
    """Gradient of reduced critic values with respect to the action, shape ``(B, A)``.

    No graph is kept.

    Args:
        critic: a :class:`TwinCritic`, or whatever else has its ``evaluate``.
        features: what ``critic.encode`` returned for ``B`` states.
        action: actions of shape ``(B, A)``.
        reduce: values of shape ``(B, E)`` to ``(B,)``: which critic, or their mean.
    """

    def total(action: Tensor) -> Tensor:
        return reduce(critic.evaluate(features, action)).sum()

    return torch.func.grad(total)(action.detach()).detach()


class NoiseNetwork(nn.Module):
    """A policy's network: the noise in an action, or a score, told by state and noise level.

    It is split in two as ACA's critic is: :meth:`encode` takes the first layer's product with the
    observation once per state and with the level's features once per level, and :meth:`forward`
    only the action's once per row.

    Noise levels are ``1..T`` for every caller; the network knows them by the indices ``0..T-1``, as
    the codes that it restates do. Weights are truncated normal with standard deviation
    ``fan_in^-1/2``, cut at two of them, and biases zero.

    Args:
        observation_dim: size of the observation vector.
        action_dim: size ``A`` of the action vector.

    Keyword Args:
        num_steps: number ``T`` of noise levels. Default: 20.
        num_cells: widths of the hidden layers. Default: three of 256.
        activation: class (or factory) of an elementwise activation. Default: ``nn.Mish``.
        embedding: what the network sees of the level: sinusoidal features through a small network
            (``"mlp"``: linear to twice their number, activation, linear back), as they are
            (``"sinusoidal"``), or nothing (``"none"``). Default: ``"mlp"``.
        embedding_dim: even number of sinusoidal features. Default: 16.
        device: device of the parameters.
        dtype: dtype of the parameters; observations are cast to it.

    Raises:
        ValueError: if a size is not positive or ``embedding_dim`` is odd.

    Examples:
        >>> from torchrl_aca.baselines import NoiseNetwork
        >>> network = NoiseNetwork(17, 6)
        >>> features = network.encode(torch.zeros(8, 17))
        >>> network(features, torch.zeros(32, 8, 6), torch.tensor(20)).shape
        torch.Size([32, 8, 6])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_steps: int = 20,
        num_cells: Sequence[int] = (256, 256, 256),
        activation: Callable[[], nn.Module] = nn.Mish,
        embedding: Embedding = "mlp",
        embedding_dim: int = 16,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_choice(("mlp", "sinusoidal", "none"), embedding=embedding)
        _check_sizes(self, observation_dim, action_dim, num_steps, *num_cells)
        if embedding_dim < 2 or embedding_dim % 2:
            raise ValueError(f"Expected an even embedding_dim >= 2, got {embedding_dim}.")
        self.action_dim, self.num_steps = action_dim, num_steps
        self.embedding, self.embedding_dim = embedding, embedding_dim
        self.activation = activation()
        num_features = 0 if embedding == "none" else embedding_dim
        self._first_sizes = [observation_dim, action_dim, num_features]
        widths = [sum(self._first_sizes), *num_cells, action_dim]
        factory = {"device": device, "dtype": dtype}
        self.layers = nn.ModuleList(_linear(i, o, **factory) for i, o in pairwise(widths))
        if embedding == "mlp":
            self.level_in = _linear(embedding_dim, 2 * embedding_dim, **factory)
            self.level_out = _linear(2 * embedding_dim, embedding_dim, **factory)

    def encode(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """First layer: each state's share ``(B, H)`` and each level's ``(T, H)``."""
        first = self._first
        observation_weight, _, level_weight = first.weight.split(self._first_sizes, dim=1)
        state_share = observation.to(first.weight.dtype) @ observation_weight.T + first.bias
        return state_share, self._level_features(first.weight) @ level_weight.T

    def forward(self, features: tuple[Tensor, Tensor], action: Tensor, level: Tensor) -> Tensor:
        """Noise or scores of shape ``(*N, B, A)``.

        Args:
            features: what :meth:`encode` returned for ``B`` states.
            action: noisy actions of shape ``(*N, B, A)``; ``*N`` is empty or ``N`` candidates.
            level: integers from ``1..T`` of shape ``()``, ``(B,)`` or ``(*N, B)``; without an
                embedding, any.
        """
        state_share, level_share = features
        share = state_share
        if self.embedding != "none":
            level_share = level_share.index_select(0, level.reshape(-1) - 1)
            share = share + level_share.reshape(*level.shape, -1)
        _, action_weight, _ = self._first.weight.split(self._first_sizes, dim=1)
        x = action @ action_weight.T + share
        for layer in self._others:
            x = layer(activate(self.activation, x))
        return x

    def _level_features(self, like: Tensor) -> Tensor:
        """Features of all levels, ``(T, embedding_dim)``; of none, ``(T, 0)``."""
        if self.embedding == "none":
            return like.new_zeros(self.num_steps, 0)
        indices = torch.arange(self.num_steps, device=like.device, dtype=like.dtype)
        features = F.sinusoidal_embedding(indices, self.embedding_dim)
        if self.embedding == "sinusoidal":
            return features
        return self.level_out(self.activation(self.level_in(features)))

    @property
    def _first(self) -> nn.Linear:
        return cast(nn.Linear, self.layers[0])

    @property
    def _others(self) -> list[nn.Module]:
        return list(self.layers)[1:]


class TwinCritic(nn.Module):
    """``E`` independent critics ``Q_i(s, a)``, evaluated together by batched matrix products.

    :meth:`encode` takes the first layer's product with the observation once per state, however many
    actions :meth:`evaluate` then sees of it. The initialisation is that of :class:`NoiseNetwork`.

    Args:
        observation_dim: size of the observation vector.
        action_dim: size ``A`` of the action vector.

    Keyword Args:
        num_critics: number ``E`` of critics. Default: 2.
        num_outputs: numbers that each critic gives; two for a mean and a standard deviation.
            Default: 1.
        num_cells: widths of the hidden layers. Default: three of 256.
        activation: class (or factory) of an elementwise activation. Default: ``nn.Mish``.
        device: device of the parameters.
        dtype: dtype of the parameters; observations are cast to it.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> from torchrl_aca.baselines import TwinCritic
        >>> critic = TwinCritic(17, 6)
        >>> critic(torch.zeros(8, 17), torch.zeros(8, 6)).shape
        torch.Size([8, 2])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_critics: int = 2,
        num_outputs: int = 1,
        num_cells: Sequence[int] = (256, 256, 256),
        activation: Callable[[], nn.Module] = nn.Mish,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        _check_sizes(self, observation_dim, action_dim, num_critics, num_outputs, *num_cells)
        self.num_critics, self.num_outputs = num_critics, num_outputs
        self.activation = activation()
        self._first_sizes = [observation_dim, action_dim]
        widths = [observation_dim + action_dim, *num_cells, num_outputs]
        factory: dict[str, Any] = {"device": device, "dtype": dtype}
        self.layers = nn.ModuleList(
            StackedLinear(num_critics, i, o, **factory) for i, o in pairwise(widths)
        )

    def encode(self, observation: Tensor) -> Tensor:
        """First layer: each state's share, ``(E, B, H)``."""
        first = self._first
        observation_weight, _ = first.weight.split(self._first_sizes, dim=1)
        rows = observation.to(first.weight.dtype).expand(self.num_critics, -1, -1)
        return torch.baddbmm(first.bias, rows, observation_weight)

    def evaluate(self, features: Tensor, action: Tensor) -> Tensor:
        """Values of shape ``(*N, B, E)``, and ``(*N, B, E, num_outputs)`` if there are several.

        Args:
            features: what :meth:`encode` returned for ``B`` states.
            action: actions of shape ``(*N, B, A)``; ``*N`` is empty or ``N`` candidates.
        """
        _, action_weight = self._first.weight.split(self._first_sizes, dim=1)
        rows = action.reshape(-1, action.shape[-1]).expand(self.num_critics, -1, -1)
        num_candidates = action.shape[:-2].numel()
        product = rows @ action_weight
        product = product.reshape(self.num_critics, num_candidates, *features.shape[1:])
        x = (product + features.unsqueeze(1)).flatten(1, 2)
        for layer in self._others:
            x = layer(activate(self.activation, x))
        outputs = () if self.num_outputs == 1 else (self.num_outputs,)
        return x.movedim(0, 1).reshape(*action.shape[:-1], self.num_critics, *outputs)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values of ``B`` states and as many actions; see :meth:`evaluate`."""
        return self.evaluate(self.encode(observation), action)

    @property
    def _first(self) -> StackedLinear:
        return cast(StackedLinear, self.layers[0])

    @property
    def _others(self) -> list[nn.Module]:
        return list(self.layers)[1:]


def _linear(num_in: int, num_out: int, **factory: Any) -> nn.Linear:
    layer = nn.Linear(num_in, num_out, **factory)
    nn.init.zeros_(layer.bias)
    truncated_normal_(layer.weight, num_in)
    return layer


def _check_sizes(network: nn.Module, *sizes: int) -> None:
    """A ValueError unless all sizes are positive."""
    if min(sizes) < 1:
        raise ValueError(
            f"{type(network).__name__} expects positive sizes, got {min(sizes)} among "
            f"{list(sizes)}."
        )
