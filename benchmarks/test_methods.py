"""An update of every method with the same number of candidates, for `make bench`.

SAC has no candidates and is there to compare with. Some methods train their policy, or ACA its
noisy levels, at every second update: a case is two updates, an even and an odd one.
"""

from __future__ import annotations

import pytest
import torch

from agents import AGENTS
from recipe import configure, make_recipe_agent
from test_speed import BATCH, make_batch, measure
from torchrl_aca.training.envs import make_vector_env

WITH_CANDIDATES = ("aca", "qsm", "qvpo", "sdac")


@pytest.mark.parametrize("variant", ["eager", "compiled"])
@pytest.mark.parametrize("num_candidates", [4, 32])
@pytest.mark.parametrize("algo", sorted(AGENTS))
@pytest.mark.parametrize("size", ["HalfCheetah", "Humanoid"])
def test_two_updates(benchmark, size, algo, num_candidates, variant):
    overrides = [f"algo={algo}", f"env={size.lower()}", f"compile={variant == 'compiled'}"]
    case = f"{size}: two updates of {algo}"
    if algo in WITH_CANDIDATES:
        overrides += [f"{algo}.num_{which}candidates={num_candidates}" for which in ("", "target_")]
        case += f", {num_candidates} candidates"
    elif num_candidates == 32:
        pytest.skip("no candidates: once is enough")
    torch._dynamo.reset()
    cfg = configure(*overrides)
    agent = make_recipe_agent(cfg, make_vector_env(cfg.env.name, 1, seed=0))
    batch = make_batch(size)

    def call():
        agent.update(batch)
        agent.update(batch)

    measure(benchmark, call, BATCH * num_candidates, case, variant, work=0)
