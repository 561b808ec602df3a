"""Gaussian policies: the tanh-squashed one that several algorithms share, and a clipped one."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal


class BoundedNormalParams(nn.Module):
    """Splits (..., 2A) into a mean and a standard deviation whose logarithm is clamped."""

    def __init__(self, log_std_min: float, log_std_max: float) -> None:
        """Takes the bounds of the logarithm."""
        super().__init__()
        self.bounds = (log_std_min, log_std_max)

    def forward(self, params: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns mean and standard deviation, (..., A) each."""
        mean, log_std = params.chunk(2, dim=-1)
        return mean, log_std.clamp(*self.bounds).exp()


def log_half_range(action_spec: Bounded) -> float:
    """Returns what the entropy in env units is above that of the same actions in [-1, 1]."""
    return ((action_spec.space.high - action_spec.space.low) / 2).log().sum().item()


def make_gaussian_policy(
    network: nn.Module,
    action_spec: Bounded,
    log_std_min: float,
    log_std_max: float,
    device: torch.device,
) -> ProbabilisticActor:
    """Returns the policy of a network that maps observations to (..., 2A)."""
    network = nn.Sequential(network, BoundedNormalParams(log_std_min, log_std_max))
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=action_spec.to(device),
        distribution_class=TanhNormal,
        distribution_kwargs={
            "low": action_spec.space.low.to(device),
            "high": action_spec.space.high.to(device),
        },
    )


class FreeStd(nn.Module):
    """Puts a mean in [-1, 1] into env units, beside a standard deviation that no state changes."""

    def __init__(self, action_spec: Bounded, log_std_min: float, log_std_max: float) -> None:
        """Begins with a standard deviation of half the action's range."""
        super().__init__()
        low, high = action_spec.space.low, action_spec.space.high
        self.bounds = (log_std_min, log_std_max)
        self.register_buffer("centre", (low + high) / 2)
        self.register_buffer("half_range", (high - low) / 2)
        self.log_std = nn.Parameter(torch.zeros_like(low))

    def forward(self, mean: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns mean and standard deviation, (..., A) each, in env units."""
        std = self.half_range * self.log_std.clamp(*self.bounds).exp()
        return self.centre + self.half_range * mean, std.expand_as(mean)


def make_clipped_policy(
    network: nn.Module,
    action_spec: Bounded,
    log_std_min: float,
    log_std_max: float,
    device: torch.device,
) -> ProbabilisticActor:
    """Returns a Gaussian without a squash, whose actions are clipped to the environment's range.

    Args:
        network: Maps observations to a mean, (..., A), in which [-1, 1] is the action's range.
        action_spec: The environment's.
        log_std_min: Least logarithm of the standard deviation, in the same units.
        log_std_max: The largest one.
        device: Of the parameters.
    """
    spec = action_spec.to(device)
    network = nn.Sequential(network, FreeStd(spec, log_std_min, log_std_max))
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        safe=True,
        distribution_class=IndependentNormal,
    )
