"""What compiling costs: `PYTHONPATH=recipes python benchmarks/compile_time.py`.

Seconds of the recipe's first actions and updates with `compile=true`, twice, each time in a new
process: with an empty cache, and with the cache that the first one left.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time

import torch

from recipe import configure, make_recipe_agent
from test_speed import make_batch
from torchrl_aca.training.envs import make_vector_env


def first_calls(cache: str) -> None:
    """Prints the seconds that acting, two updates and an evaluation's acting take at first."""
    cfg = configure("aca.num_target_candidates=4", "compile=true")
    env, eval_env = (make_vector_env(cfg.env.name, copies, seed=0) for copies in (5, 10))
    agent = make_recipe_agent(cfg, env)
    batch, data, eval_data = make_batch("HalfCheetah"), env.reset(), eval_env.reset()
    start = time.perf_counter()
    with torch.no_grad():
        agent.policy(data)
    for _ in range(2):  # the second one has no noise-level step
        agent.update(batch)
    with torch.no_grad():
        agent.policy(eval_data)
    print(f"{cache} cache: {time.perf_counter() - start:.1f} s")


def main() -> None:
    """Runs `first_calls` in two processes, one after the other."""
    with tempfile.TemporaryDirectory() as cache:
        for state in ("empty", "filled"):
            environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache}
            subprocess.run([sys.executable, __file__, state], env=environment, check=True)


if __name__ == "__main__":
    first_calls(sys.argv[1]) if len(sys.argv) > 1 else main()
