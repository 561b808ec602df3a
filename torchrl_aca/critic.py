"""Noise-level critics ``Q(s, a_t, t)``: what chain and loss ask of one, and the paper's MLP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_aca import functional as F
from torchrl_aca.activations import activate, activation_and_slope
from torchrl_aca.checks import check_keys
from torchrl_aca.stacked import StackedLinear

__all__ = ["NoiseLevelCritic", "NoiseLevelCriticBase"]


class NoiseLevelCriticBase(TensorDictModuleBase):
    """What an actor and a loss need of a critic, whatever the network.

    A critic is split in two, so that what depends on the state alone is computed once per state and
    not once per candidate and denoising step: :meth:`encode` maps observations to features, and
    :meth:`evaluate` maps features, actions and noise levels to values.

    Noise levels are ``0..T`` for every caller, 0 the clean action. Here alone a level becomes the
    index by which the network knows it. A subclass defines :meth:`encode` and
    ``_evaluate(features, action, index)``, and may define ``_action_gradient`` of the same
    arguments where it knows a faster way than automatic differentiation.

    Args:
        observation_keys: keys of the observations, in the order :meth:`encode` takes them.
        action_key: key of the (noisy) action in critic units, [-1, 1].
        noise_level_key: key of the integer noise level, of shape ``(*batch,)``.
        value_key: key of the output, of shape ``(*batch, E)`` with one entry per critic.
        first_level: the network's index of level 1. ``1``: indices are levels, and 0 is the clean
            action alone, as in the paper. ``0``: the clean action and level 1 share index 0, as in
            the official code, whose indices are ``0..T-1``.
    """

    def __init__(
        self,
        observation_keys: Sequence[NestedKey] = ("observation",),
        action_key: NestedKey = "action",
        noise_level_key: NestedKey = "noise_level",
        value_key: NestedKey = "state_action_value",
        first_level: int = 1,
    ) -> None:
        super().__init__()
        if first_level not in (0, 1):
            raise ValueError(f"first_level must be 0 or 1, got {first_level!r}.")
        self.observation_keys = list(observation_keys)
        self.action_key = action_key
        self.noise_level_key = noise_level_key
        self.value_key = value_key
        self.first_level = first_level
        self.in_keys = [*self.observation_keys, action_key, noise_level_key]
        self.out_keys = [value_key]

    def encode(self, *observations: Tensor) -> Any:
        """Features of ``B`` states, from observations of shape ``(B, ...)``."""
        raise NotImplementedError(f"{type(self).__name__} must define encode(*observations).")

    def evaluate(self, features: Any, action: Tensor, noise_level: Tensor) -> Tensor:
        """Values of shape ``(*N, B, E)``.

        Args:
            features: what :meth:`encode` returned for ``B`` states.
            action: actions of shape ``(*N, B, A)``; ``*N`` is empty or ``N`` candidates.
            noise_level: integers from ``0..T`` of shape ``()`` or ``(B,)``.
        """
        return self._evaluate(features, action, self._index(noise_level))

    def action_gradient(self, features: Any, action: Tensor, noise_level: Tensor) -> Tensor:
        """Gradient of the sum of the critics with respect to the action, shape ``(*N, B, A)``.

        The sum, because the official code guides with ``Q_1 + Q_2``. No graph is kept; it works
        under ``no_grad``, ``inference_mode`` and ``torch.compile(fullgraph=True)``.

        Args:
            features: as in :meth:`evaluate`.
            action: as in :meth:`evaluate`.
            noise_level: as in :meth:`evaluate`.
        """
        return self._action_gradient(features, action, self._index(noise_level))

    def _index(self, noise_level: Tensor) -> Tensor:
        """The network's index of a level."""
        return noise_level if self.first_level else (noise_level - 1).clamp(min=0)

    def _evaluate(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        raise NotImplementedError(
            f"{type(self).__name__} must define _evaluate(features, action, index)."
        )

    def _action_gradient(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        def total(action: Tensor) -> Tensor:
            return self._evaluate(features, action, index).sum()

        return torch.func.grad(total)(action.detach()).detach()

    def batch_shape(self, observations: Sequence[Tensor], batch_size: torch.Size) -> torch.Size:
        """Batch shape of observations that came in a TensorDict of ``batch_size``."""
        return batch_size

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``value_key`` for the observations, actions and noise levels of any batch shape."""
        action = tensordict[self.action_key]
        batch = action.shape[:-1]
        observations = [tensordict[key] for key in self.observation_keys]
        rows = [o.reshape(batch.numel(), *o.shape[len(batch) :]) for o in observations]
        level = tensordict[self.noise_level_key].expand(batch).reshape(-1)
        value = self.evaluate(self.encode(*rows), action.reshape(-1, action.shape[-1]), level)
        return tensordict.set(self.value_key, value.reshape(*batch, value.shape[-1]))


class NoiseLevelCritic(NoiseLevelCriticBase):
    """The paper's critic: ``E`` independent MLPs of (observation, noisy action, level features).

    The level features of each MLP are its own: sinusoidal features of the level, a linear layer to
    twice their number, the activation, and a linear layer back. The members are stacked into one
    set of parameters and evaluated together by batched matrix products.

    The first hidden layer is a sum of three products, so the observation's is taken once per state
    (:meth:`encode`), the level's once per level, and only the action's once per row.

    Args:
        observation_dim: size of the observation vector; with several, the sum of their sizes.
        action_dim: size ``A`` of the action vector.

    Keyword Args:
        num_steps: number ``T`` of noise levels. Default: 20.
        num_critics: number ``E`` of critics. Default: 2.
        num_cells: widths of the hidden layers. Default: three of 256.
        activation: class (or factory) of an elementwise activation module. Default: ``nn.Mish``.
        embedding_dim: even number of sinusoidal level features. Default: 16.
        first_level: see :class:`NoiseLevelCriticBase`. Default: 1, the paper.
        in_keys: one or several observation keys, whose vectors are joined in this order, then the
            action's and the noise level's key.
        out_keys: the value key.
        device: device of the parameters.
        dtype: dtype of the parameters; observations are cast to it.

    Raises:
        ValueError: if a size is not positive, ``embedding_dim`` is odd or there are fewer than
            three ``in_keys``, or keys are not in a list; in a call, if observations are not
            ``observation_dim`` numbers.

    Examples:
        >>> critic = NoiseLevelCritic(17, 6)
        >>> value = critic(torch.zeros(8, 17), torch.zeros(8, 6), torch.zeros(8, dtype=torch.long))
        >>> value.shape
        torch.Size([8, 2])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_steps: int = 20,
        num_critics: int = 2,
        num_cells: Sequence[int] = (256, 256, 256),
        activation: type[nn.Module] = nn.Mish,
        embedding_dim: int = 16,
        first_level: int = 1,
        in_keys: Sequence[NestedKey] = ("observation", "action", "noise_level"),
        out_keys: Sequence[NestedKey] = ("state_action_value",),
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        if isinstance(in_keys, str) or len(in_keys) < 3:
            raise ValueError(
                "NoiseLevelCritic expects in_keys=[*observation keys, action key, noise-level "
                f"key], at least three, got {in_keys!r}."
            )
        check_keys(out_keys=out_keys)
        *observation_keys, action_key, noise_level_key = in_keys
        super().__init__(observation_keys, action_key, noise_level_key, out_keys[0], first_level)
        sizes = (observation_dim, action_dim, num_steps, num_critics, *num_cells)
        if min(sizes) < 1 or not num_cells or embedding_dim < 2 or embedding_dim % 2:
            raise ValueError(
                "NoiseLevelCritic expects positive sizes, at least one hidden layer and an even "
                f"embedding_dim; got observation_dim={observation_dim}, action_dim={action_dim}, "
                f"num_steps={num_steps}, num_critics={num_critics}, num_cells={tuple(num_cells)}, "
                f"embedding_dim={embedding_dim}."
            )
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.num_steps, self.num_critics = num_steps, num_critics
        self.embedding_dim = embedding_dim
        self.activation = activation()

        def linear(num_in: int, num_out: int) -> StackedLinear:
            return StackedLinear(num_critics, num_in, num_out, device=device, dtype=dtype)

        self.level_in = linear(embedding_dim, 2 * embedding_dim)
        self.level_out = linear(2 * embedding_dim, embedding_dim)
        widths = [observation_dim + action_dim + embedding_dim, *num_cells]
        self.hidden = nn.ModuleList(map(linear, widths, num_cells))
        self.value = linear(widths[-1], 1)

    def encode(self, *observations: Tensor) -> tuple[Tensor, Tensor]:
        """First layer: each state's share ``(E, B, H)`` and each level's ``(E, levels, H)``."""
        first = self._first
        observation_weight, _, level_weight = self._first_weights()
        observation = self._joined(observations).to(first.weight.dtype)
        num_indices = self.num_steps + self.first_level
        indices = torch.arange(num_indices, device=first.weight.device, dtype=first.weight.dtype)
        embedding = F.sinusoidal_embedding(indices, self.embedding_dim)
        embedding = embedding.expand(self.num_critics, -1, -1)
        embedding = self.level_out(self.activation(self.level_in(embedding)))
        state_share = observation.expand(self.num_critics, -1, -1) @ observation_weight
        return state_share, torch.baddbmm(first.bias, embedding, level_weight)

    def _joined(self, observations: Sequence[Tensor]) -> Tensor:
        """One vector of all observations, ``(B, O)``."""
        sizes = [observation.shape[-1] for observation in observations]
        if sum(sizes) != self.observation_dim:
            raise ValueError(
                f"NoiseLevelCritic has observation_dim={self.observation_dim}, got observations of "
                f"{' + '.join(map(str, sizes))} numbers. Build it with observation_dim={sum(sizes)}"
                f", or give it other in_keys than {self.in_keys}."
            )
        return observations[0] if len(observations) == 1 else torch.cat(tuple(observations), -1)

    def _evaluate(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        x = activate(self.activation, self._first_layer(features, action, index))
        for layer in self._others:
            x = activate(self.activation, layer(x))
        return (
            self.value(x).squeeze(-1).movedim(0, -1).reshape(*action.shape[:-1], self.num_critics)
        )

    def _action_gradient(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        """The chain rule written out.

        Forward, each layer keeps the slope of its activation; backward, the gradient is multiplied
        by slope and transposed weight, layer by layer, down to the action's share of the first.
        """
        with torch.no_grad():
            x = self._first_layer(features, action, index)
            x, slope = activation_and_slope(self.activation, x)
            slopes = [slope]
            for layer in self._others:
                x, slope = activation_and_slope(self.activation, layer(x))
                slopes.append(slope)
            gradient = self.value.weight.mT
            for layer, slope in zip(reversed(self._others), reversed(slopes[1:]), strict=True):
                gradient = (gradient * slope) @ layer.weight.mT
            _, action_weight, _ = self._first_weights()
            return ((gradient * slopes[0]) @ action_weight.mT).sum(0).view(action.shape)

    def batch_shape(self, observations: Sequence[Tensor], batch_size: torch.Size) -> torch.Size:
        """All dimensions of the observation but its last, whatever the TensorDict's own."""
        return observations[0].shape[:-1]

    @property
    def _first(self) -> StackedLinear:
        return cast(StackedLinear, self.hidden[0])

    @property
    def _others(self) -> list[StackedLinear]:
        return cast("list[StackedLinear]", list(self.hidden)[1:])

    def _first_weights(self) -> tuple[Tensor, ...]:
        """The first layer's weight, split by its inputs: observation, action, level features."""
        sizes = [self.observation_dim, self.action_dim, self.embedding_dim]
        return self._first.weight.split(sizes, dim=1)

    def _first_layer(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        """Pre-activation of the first layer, shape ``(E, rows, H)``."""
        state_share, level_share = features
        _, action_weight, _ = self._first_weights()
        share = state_share + level_share[:, index.reshape(-1)]  # (E, B, H)
        rows = action.reshape(-1, self.action_dim).expand(self.num_critics, -1, -1)
        product = rows @ action_weight
        num_states = share.shape[1]
        num_candidates = rows.shape[1] // max(num_states, 1)
        product = product.unflatten(1, (num_candidates, num_states))
        return (product + share.unsqueeze(1)).flatten(1, 2)
