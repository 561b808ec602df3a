"""Peak memory of an update beyond parameters and batch.

    PYTHONPATH=recipes python benchmarks/memory.py 32


The argument is the number of target candidates; sizes are HalfCheetah's. Linux and macOS only.
"""

from __future__ import annotations

import resource
import sys

import torch
from torchrl.objectives import SoftUpdate

from test_speed import make_actor, make_batch
from torchrl_aca import ACALoss


def update(loss: ACALoss) -> None:
    """Both gradients of an even update."""
    batch = make_batch("HalfCheetah")
    for name in ("qvalue", "noise_level"):
        getattr(loss, f"{name}_loss")(batch)[f"loss_{name}"].backward()


def peak_mib() -> float:
    """Largest resident size of this process so far; kilobytes on Linux, bytes on macOS."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def main(num_candidates: int) -> None:
    """Prints how far an update raises the peak over that of an update with one candidate."""
    torch.set_num_threads(1)
    loss = ACALoss(make_actor("HalfCheetah", "eager", num_candidates), num_target_candidates=1)
    SoftUpdate(loss, tau=0.005)  # the loss warns where its targets have no updater
    update(loss)
    before = peak_mib()
    loss.num_target_candidates = num_candidates
    update(loss)
    print(f"{num_candidates} target candidates: {peak_mib() - before:.0f} MiB")


if __name__ == "__main__":
    main(int(sys.argv[1]))
