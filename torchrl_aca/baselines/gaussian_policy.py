"""Gaussian policies of a small network: a tanh-squashed one, and a clipped one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, TanhNormal

from torchrl_aca.stacked import truncated_normal_

__all__ = ["make_clipped_gaussian_policy", "make_gaussian_policy", "make_mlp"]


class BoundedNormalParams(nn.Module):
    """Splits (..., 2A) into a mean and a standard deviation whose logarithm is clamped."""

    def __init__(self, log_std_min: float, log_std_max: float) -> None:
        """Takes the bounds of the logarithm."""
        super().__init__()
        self.bounds = (log_std_min, log_std_max)

    def forward(self, params: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation, (..., A) each."""
        mean, log_std = params.chunk(2, dim=-1)
        return mean, log_std.clamp(*self.bounds).exp()


class UncorrectedTanhNormal(TanhNormal):
    """A squashed Gaussian that scores an action by the density of what was squashed.

    This is no density of the action: the correction for the tanh is missing, as in the code base
    that ACA's paper compares in.
    """

    def rsample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Returns actions with a gradient, and their scores."""
        value = self.base_dist.rsample(torch.Size(sample_shape))
        return self.transforms[0](value), self.base_dist.log_prob(value)

    def sample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Returns actions without a gradient, and their scores."""
        value = self.base_dist.sample(torch.Size(sample_shape))
        return self.transforms[0](value), self.base_dist.log_prob(value)

    def log_prob(self, value: Tensor) -> Tensor:
        """Returns the scores of any actions."""
        return self.base_dist.log_prob(self.transforms[0].inv(value))


class RescaledTanhNormal(TanhNormal):
    """A squashed Gaussian that scores an action by the density of that action rescaled to [-1, 1].

    So entropies do not depend on the units of the actions, and are what target entropies mean.
    """

    def rsample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Returns actions with a gradient, and their scores."""
        action, log_prob = super().rsample_and_log_prob(torch.Size(sample_shape))
        return action, log_prob + self._log_half_range

    def sample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Returns actions without a gradient, and their scores."""
        action, log_prob = super().sample_and_log_prob(torch.Size(sample_shape))
        return action, log_prob + self._log_half_range

    def log_prob(self, value: Tensor) -> Tensor:
        """Returns the scores of any actions."""
        return super().log_prob(value) + self._log_half_range

    @property
    def _log_half_range(self) -> Tensor:
        return ((self.high - self.low) / 2).log().sum(-1)


class ClippedNormal(IndependentNormal):
    """A Gaussian whose samples are clipped to bounds; its densities are those before the clip.

    TorchRL's ``safe=True`` clips too, but first reads whether it must, which no CUDA graph can.
    """

    def __init__(self, loc: Tensor, scale: Tensor, *, low: Tensor, high: Tensor) -> None:
        """Takes mean and standard deviation, (..., A) each, and the bounds, (A,) each."""
        super().__init__(loc, scale)
        self.low, self.high = low.to(loc.device), high.to(loc.device)

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Returns actions with a gradient, where the bounds leave one."""
        return super().rsample(torch.Size(sample_shape)).clamp(self.low, self.high)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Returns actions without a gradient."""
        return super().sample(torch.Size(sample_shape)).clamp(self.low, self.high)

    @property
    def mean(self) -> Tensor:
        """The mean, clipped."""
        return super().mean.clamp(self.low, self.high)

    @property
    def mode(self) -> Tensor:
        """The same: where the density is highest within the bounds."""
        return self.mean


class FreeStd(nn.Module):
    """Puts a mean in [-1, 1] into env units, beside a standard deviation that no state changes."""

    centre: Tensor
    half_range: Tensor

    def __init__(self, action_spec: Bounded, log_std_min: float, log_std_max: float) -> None:
        """Begins with a standard deviation of half the action's range."""
        super().__init__()
        low, high = action_spec.space.low, action_spec.space.high
        self.bounds = (log_std_min, log_std_max)
        self.register_buffer("centre", (low + high) / 2)
        self.register_buffer("half_range", (high - low) / 2)
        self.log_std = nn.Parameter(torch.zeros_like(low))

    def forward(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation, (..., A) each, in env units."""
        std = self.half_range * self.log_std.clamp(*self.bounds).exp()
        return self.centre + self.half_range * mean, std.expand_as(mean)


def make_mlp(
    num_in: int,
    num_out: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation: str = "ReLU",
    layer_norm: bool = False,
    device: torch.device | str | None = None,
) -> MLP:
    """Builds TorchRL's MLP with the first weights of ACA's critic: truncated normal, no biases.

    Args:
        num_in: size of the input.
        num_out: size of the output.

    Keyword Args:
        num_cells: widths of the hidden layers. Default: two of 256.
        activation: name of an activation in ``torch.nn``. Default: ReLU.
        layer_norm: normalise each hidden layer, with ``eps=1e-6``. Default: False.
        device: device of the parameters.
    """
    norm: dict[str, Any] = {}
    if layer_norm:
        kwargs = [{"normalized_shape": cells, "eps": 1e-6} for cells in num_cells]
        norm = {"norm_class": nn.LayerNorm, "norm_kwargs": kwargs}
    kind = getattr(nn, activation)
    mlp = MLP(num_in, num_out, num_cells=num_cells, activation_class=kind, device=device, **norm)
    for layer in mlp:
        if isinstance(layer, nn.Linear):
            truncated_normal_(layer.weight, layer.in_features)
            nn.init.zeros_(layer.bias)
    return mlp


def make_gaussian_policy(
    observation_dim: int,
    spec: Bounded,
    *,
    log_std_min: float = -20.0,
    log_std_max: float = 2.0,
    squash_correction: bool = True,
    rescaled: bool = False,
    device: torch.device | str | None = None,
    **mlp: Any,
) -> ProbabilisticActor:
    """Builds the tanh-squashed Gaussian of SAC, whose network tells mean and standard deviation.

    Args:
        observation_dim: size ``O`` of the observation vector.
        spec: bounded spec of one env's action, of shape ``(A,)``; the squash is to its bounds.

    Keyword Args:
        log_std_min: lower bound of the logarithm of the standard deviation. Default: -20.
        log_std_max: upper bound. Default: 2.
        squash_correction: the log-probability is of the action. False: of what was squashed, as in
            the code base of the comparison in ACA's paper. Default: True.
        rescaled: the log-probability is of the action rescaled to [-1, 1], for losses that do not
            rescale themselves, such as TorchRL's ``SACLoss``. Default: False.
        device: device of the parameters.
        mlp: keywords of :func:`make_mlp`.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_aca.baselines import make_gaussian_policy
        >>> policy = make_gaussian_policy(17, Bounded(-2.0, 2.0, shape=(6,)), num_cells=[64, 64])
        >>> policy(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """
    spec = spec.to(device)
    corrected = RescaledTanhNormal if rescaled else TanhNormal
    network = nn.Sequential(
        make_mlp(observation_dim, 2 * spec.shape[-1], device=device, **mlp),
        BoundedNormalParams(log_std_min, log_std_max),
    )
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=corrected if squash_correction else UncorrectedTanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    )


def make_clipped_gaussian_policy(
    observation_dim: int,
    spec: Bounded,
    *,
    log_std_min: float = -20.0,
    log_std_max: float = 2.0,
    device: torch.device | str | None = None,
    **mlp: Any,
) -> ProbabilisticActor:
    """Builds the Gaussian of IQL, without a squash, whose actions are clipped to the bounds.

    The network tells the mean, in units in which [-1, 1] is the action's range; the standard
    deviation is the same in every state.

    Args:
        observation_dim: size ``O`` of the observation vector.
        spec: bounded spec of one env's action, of shape ``(A,)``.

    Keyword Args:
        log_std_min: lower bound of the logarithm of the standard deviation, in the same units.
            Default: -20.
        log_std_max: upper bound. Default: 2.
        device: device of the parameters.
        mlp: keywords of :func:`make_mlp`.
    """
    spec = spec.to(device)
    network = nn.Sequential(
        make_mlp(observation_dim, spec.shape[-1], device=device, **mlp),
        FreeStd(spec, log_std_min, log_std_max),
    )
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=ClippedNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    )
