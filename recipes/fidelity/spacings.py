"""Which levels a short chain could visit: the package's choice and others, to compare."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_aca import NoiseSchedule
from torchrl_aca.chain import inference_levels


def power(exponent: float) -> Callable[[NoiseSchedule, Tensor], Tensor]:
    """Steps that grow as a power of their number; 1 is even, 2 the quadratic one of DDIM's code."""
    return lambda schedule, grid: 1 + (schedule.num_steps - 1) * grid**exponent


def geometric(schedule: NoiseSchedule, grid: Tensor) -> Tensor:
    """Equal steps of the level's logarithm."""
    return schedule.num_steps**grid


def log_snr(schedule: NoiseSchedule, grid: Tensor) -> Tensor:
    """Equal steps of the logarithm of the signal-to-noise ratio, `alpha_bar / (1 - alpha_bar)`."""
    ratio = torch.logit(schedule.alphas_cumprod)
    wanted = ratio[0] + (ratio[-1] - ratio[0]) * grid
    return 1.0 + (ratio - wanted[:, None]).abs().argmin(1)


def low(schedule: NoiseSchedule, grid: Tensor) -> Tensor:
    """The top, and below it cubic steps among the levels whose signal is above their noise."""
    num_clear = int((schedule.alphas_cumprod >= 0.5).sum())
    steps = 1 + (num_clear - 1) * (grid / grid[-2].clamp(min=0.5)) ** 3
    return torch.cat([steps[:-1], steps.new_tensor([schedule.num_steps])])


SPACINGS: dict[str, Callable[[NoiseSchedule, Tensor], Tensor]] = {
    "even": power(1),
    "log SNR": log_snr,
    "quadratic": power(2),
    "geometric": geometric,
    "cubic": power(3),
    "low": low,
}
PACKAGE = "quartic"  # torchrl_aca.chain.inference_levels


def levels_of(spacing: str, schedule: NoiseSchedule, num_steps: int) -> list[int]:
    """Returns rising levels from 1 to T: rounded, and moved apart where two would coincide."""
    num_levels = schedule.num_steps
    if spacing == PACKAGE or num_steps == num_levels:
        return inference_levels(num_levels, num_steps)
    grid = torch.linspace(0, 1, num_steps, dtype=torch.float64)
    levels = SPACINGS[spacing](schedule, grid).round().long().tolist()
    for k in range(1, num_steps):
        levels[k] = max(levels[k], levels[k - 1] + 1)
    for k in reversed(range(num_steps)):
        levels[k] = min(levels[k], num_levels - (num_steps - 1 - k))
    return levels
