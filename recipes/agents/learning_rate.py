"""The linear decay of a learning rate, counted in steps of its own optimiser."""

from __future__ import annotations

from functools import partial

import torch
from pydantic import model_validator
from torch.optim.lr_scheduler import LambdaLR

from torchrl_aca.training.config import NonNegative, Optim, Positive


class DecayOptim(Optim):
    """A section `optim` with a learning rate that decays between two steps."""

    lr: Positive
    lr_decay_start: NonNegative
    lr_decay_end: NonNegative

    @model_validator(mode="after")
    def _decay(self) -> DecayOptim:
        if self.lr_decay_end < self.lr_decay_start:
            expected = f"at least optim.lr_decay_start ({self.lr_decay_start})"
            self.refuse("lr_decay_end", expected)
        return self


def linear_decay(
    optimizer: torch.optim.Optimizer, optim: DecayOptim, first: float, last: float
) -> LambdaLR:
    """Returns a scheduler from the rate `first` to `last`, to be stepped with the optimiser."""
    return LambdaLR(optimizer, partial(lr_factor, optim, last / first))


def lr_factor(optim: DecayOptim, ratio: float, step: int) -> float:
    """Returns the factor of the first rate after so many steps: linear, from 1 to `ratio`."""
    span = max(optim.lr_decay_end - optim.lr_decay_start, 1)
    progress = min(max((step - optim.lr_decay_start) / span, 0.0), 1.0)
    return 1 + progress * (ratio - 1)
