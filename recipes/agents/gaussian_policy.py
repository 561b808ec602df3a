"""The tanh-squashed Gaussian policy that several algorithms share, and its units."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal


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
