"""Where the time of `recipes/online_mujoco.py` goes: an iteration with N = 1, and its parts.

An iteration is a step of five environments and one update. What is neither acting nor the update is
TorchRL's and the recipe's own overhead.
"""

from __future__ import annotations

import os

import pytest
import torch
from recipe import configure, make_aca, make_collector
from torchrl.modules import RandomPolicy

from torchrl_aca.training.data import EpisodeTracker, make_replay_buffer, transitions
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.logging import MetricMeans

torch.set_num_threads(int(os.environ.get("THREADS", os.cpu_count() or 1)))
DEVICE = torch.device("cpu")


@pytest.fixture(scope="module", params=[False, True], ids=["eager", "compiled"])
def loop(request):
    """The parts of a training loop after its warm-up, and the name of the variant."""
    torch._dynamo.reset()
    cfg = configure(
        "aca.num_target_candidates=1",
        f"compile={request.param}",
        "collector.init_random_frames=500",
    )
    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, seed=0)
    agent = make_aca(cfg, env, DEVICE)
    collector = make_collector(cfg, env, agent, 0, DEVICE)
    buffer = make_replay_buffer(10000, cfg.optim.batch_size)
    batches = iter(collector)
    for _ in range(110):
        buffer.extend(transitions(next(batches)))
    yield cfg, env, agent, collector, batches, buffer, "compiled" if request.param else "eager"
    collector.shutdown()


def measure(benchmark, call, part: str, variant: str) -> None:
    """Times `call`; two calls before that compile it where it is compiled."""
    info = {"case": f"iteration, N = 1: {part}", "variant": variant, "rows": 0, "flops": 0}
    benchmark.extra_info.update({**info, "threads": torch.get_num_threads()})
    benchmark.pedantic(call, rounds=60, warmup_rounds=4, iterations=1)


def test_whole_iteration(benchmark, loop):
    cfg, _, agent, collector, batches, buffer, variant = loop
    episodes, means = EpisodeTracker(cfg.collector.num_envs), MetricMeans()

    def iteration():
        data = next(batches)
        episodes.add(data)
        buffer.extend(transitions(data))
        means.add(agent.update(buffer.sample().to(DEVICE)))
        collector.update_policy_weights_()

    measure(benchmark, iteration, "whole", variant)


def test_acting(benchmark, loop):
    _, env, agent, *_, variant = loop
    data = env.reset()

    def act():
        with torch.no_grad():
            agent.policy(data)

    measure(benchmark, act, "acting, 5 states x 32", variant)


def test_update(benchmark, loop):
    *_, buffer, variant = loop
    agent, batch = loop[2], buffer.sample()
    measure(benchmark, lambda: agent.update(batch), "update", variant)


def test_buffer(benchmark, loop):
    *_, batches, buffer, variant = loop
    rows = transitions(next(batches))

    def extend_and_sample():
        buffer.extend(rows)
        buffer.sample()

    measure(benchmark, extend_and_sample, "buffer: extend, sample", variant)


def test_collector_without_a_policy(benchmark):
    """Five environments, the collector, and actions that cost nothing."""
    cfg = configure()
    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, seed=0)

    class Free:
        policy = RandomPolicy(env.action_spec)

    collector = make_collector(cfg, env, Free, cfg.collector.init_random_frames, DEVICE)
    batches = iter(collector)
    measure(benchmark, lambda: next(batches), "collector and environments, random actions", "eager")
    collector.shutdown()


def test_environments_alone(benchmark):
    """The same five environments through Gymnasium alone."""
    env = make_vector_env(configure().env.name, 5, seed=0)
    env.reset()
    copies, action = env.envs, env.action_space.sample()

    def step():
        for copy, each in zip(copies, action, strict=True):
            copy.step(each)

    measure(benchmark, step, "environments alone", "eager")
