"""The remedy for TorchRL's n-step returns at the end of an episode."""

from __future__ import annotations

from typing import TypeVar

from torchrl.data.postprocs import MultiStep
from torchrl.envs.transforms import MultiStepTransform

__all__ = ["with_last_flags"]

AnyMultiStep = TypeVar("AnyMultiStep", MultiStep, MultiStepTransform)


def with_last_flags(multi_step: AnyMultiStep) -> AnyMultiStep:
    """Make n-step rows end where their window ends.

    ``MultiStep`` and ``MultiStepTransform`` of TorchRL 0.14 give a row the sum of its window's
    rewards and the observation after the window, but leave it its own ``done``, ``terminated`` and
    ``truncated``. A row whose window holds a terminal state then bootstraps from there: the n - 1
    rows before the last one of every terminated episode are wrong. With this they take the flags of
    the window's last row, as the observation is taken.

    Args:
        multi_step: TorchRL's postprocessing of a collector, or its transform of a replay buffer;
            changed in place.

    Returns:
        The same object.

    Examples:
        >>> from torchrl.data.postprocs import MultiStep
        >>> postproc = with_last_flags(MultiStep(gamma=0.99, n_steps=3))
    """
    multi_step.done_keys = []  # of the entries below "next", these alone are not shifted
    return multi_step
