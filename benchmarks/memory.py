"""Peak memory of an update beyond parameters and optimisers.

    PYTHONPATH=recipes python benchmarks/memory.py 32
    PYTHONPATH=recipes python benchmarks/memory.py 32 sdac

The arguments are the number of candidates and a method that has such (ACA if none is given); sizes
are HalfCheetah's. Linux and macOS only.
"""

from __future__ import annotations

import resource
import sys

import torch

from recipe import configure, make_recipe_agent
from test_speed import make_batch
from torchrl_aca.training.envs import make_vector_env


def peak_mib() -> float:
    """Largest resident size of this process so far; kilobytes on Linux, bytes on macOS."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def main(num_candidates: int, algo: str) -> None:
    """Prints how far two updates raise the peak over that of two updates on eight rows."""
    torch.set_num_threads(1)
    candidates = (f"{algo}.num_{which}candidates={num_candidates}" for which in ("", "target_"))
    cfg = configure(f"algo={algo}", *candidates)
    agent = make_recipe_agent(cfg, make_vector_env(cfg.env.name, 1, seed=0))
    batch = make_batch("HalfCheetah")
    # An even and an odd one: some losses are there at every second alone.
    agent.update(batch[:8])
    agent.update(batch[:8])
    before = peak_mib()
    agent.update(batch)
    agent.update(batch)
    print(f"{algo}, {num_candidates} candidates: {peak_mib() - before:.0f} MiB")


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "aca")
