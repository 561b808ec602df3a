"""Where the time of `recipes/online_mujoco.py` goes: an iteration and its parts.

With the paper's settings and with `--config-name fast`. An iteration is a step of five environments
and one update. What is neither acting nor the update is TorchRL's and the recipe's own overhead.
"""

from __future__ import annotations

import os

import pytest
import torch

from recipe import configure, make_recipe_agent
from torchrl_aca.replay import make_replay_buffer, transitions
from torchrl_aca.training.collection import Collection
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.logging import MetricMeans

torch.set_num_threads(int(os.environ.get("THREADS", os.cpu_count() or 1)))


LOOPS = {
    "paper, compiled": ("online_mujoco", "compile=true"),
    "fast, eager": ("fast", "compile=false"),
    "fast, compiled": ("fast", "compile=true"),
}


@pytest.fixture(scope="module", params=LOOPS)
def loop(request):
    """The parts of a training loop after its warm-up, and the name of the variant."""
    torch._dynamo.reset()
    name, override = LOOPS[request.param]
    cfg = configure(override, "collector.warmup_frames=500", name=name)
    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, seed=0)
    agent = make_recipe_agent(cfg, env)
    collection = Collection(env, agent.policy, cfg.collector)
    buffer = make_replay_buffer(10000, cfg.optim.batch_size)
    batches = iter(collection)
    for _ in range(110):
        buffer.extend(transitions(next(batches)))
    yield env, agent, batches, buffer, request.param
    collection.close()


def measure(benchmark, call, part: str, loop: str) -> None:
    """Times `call`; the calls before that compile it where it is compiled."""
    settings, variant = loop.split(", ")
    info = {"case": f"iteration, {settings}: {part}", "variant": variant, "rows": 0, "flops": 0}
    benchmark.extra_info.update({**info, "threads": torch.get_num_threads()})
    rounds = 12 if settings == "paper" else 60
    benchmark.pedantic(call, rounds=rounds, warmup_rounds=4, iterations=1)


def test_whole_iteration(benchmark, loop):
    _, agent, batches, buffer, variant = loop
    means = MetricMeans()

    def iteration():
        buffer.extend(transitions(next(batches)))
        means.add(agent.update(buffer.sample()))

    measure(benchmark, iteration, "whole", variant)


def test_acting(benchmark, loop):
    env, agent, *_, variant = loop
    data = env.reset()

    def act():
        with torch.no_grad():
            agent.policy(data)

    measure(benchmark, act, "acting, 5 states x 32", variant)


def test_update(benchmark, loop):
    _, agent, _, buffer, variant = loop
    batch = buffer.sample()
    measure(benchmark, lambda: agent.update(batch), "update", variant)


def test_update_without_its_chain(benchmark, loop, monkeypatch):
    """Losses, backward passes, Adam and targets: the next actions are there beforehand."""
    _, agent, _, buffer, variant = loop
    batch = buffer.sample()
    loss = agent.state["loss"]
    action = loss.sample_next_action(batch)
    monkeypatch.setattr(loss, "sample_next_action", lambda batch: action)
    measure(benchmark, lambda: agent.update(batch), "update without its chain", variant)


def test_buffer(benchmark, loop):
    *_, batches, buffer, variant = loop
    rows = transitions(next(batches))

    def extend_and_sample():
        buffer.extend(rows)
        buffer.sample()

    measure(benchmark, extend_and_sample, "buffer: extend, sample", variant)


def test_collector_without_a_policy(benchmark):
    """Five environments, the collector, and actions that cost nothing: those of the warm-up."""
    cfg = configure("collector.warmup_frames=1000000")
    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, seed=0)
    collection = Collection(env, make_recipe_agent(cfg, env).policy, cfg.collector)
    batches = iter(collection)
    measure(benchmark, lambda: next(batches), "collector, random actions", "any, eager")
    collection.close()


def test_environments_alone(benchmark):
    """The same five environments through Gymnasium alone."""
    env = make_vector_env(configure().env.name, 5, seed=0)
    env.reset()
    copies, action = env.envs, env.action_space.sample()

    def step():
        for copy, each in zip(copies, action, strict=True):
            copy.step(each)

    measure(benchmark, step, "environments alone", "any, eager")
