"""Promises of `collector.backend`: the batches of workers, and what becomes of a dead one."""

from __future__ import annotations

import os
import signal

import pytest
import torch
from pydantic import ValidationError
from torchrl.collectors import Collector

from agents import configured, make_agent
from recipe_cases import TINY, checkpoint_leaves, composed, rows_of, run
from torchrl_aca.errors import RunError
from torchrl_aca.training.collection import Collection
from torchrl_aca.training.config import Collector as CollectorSettings
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.randomness import seed_everything
from torchrl_aca.training.workers import make_collection

WORKERS = ["collector.num_envs=4", "collector.num_workers=2", "collector.frames_per_batch=40"]
SETTINGS = [*WORKERS, "collector.backend=multi_process"]


def make(*overrides: str, algo: str = "aca") -> tuple[Collection, torch.nn.Module]:
    """A collection as the recipes make it, and the policy that acts in it."""
    cfg = configured(composed(*TINY[algo], *overrides))
    seed_everything(cfg.seed)
    env = make_vector_env(cfg.env, cfg.collector.num_envs, cfg.seed)
    agent = make_agent(cfg, env, torch.device("cpu"))
    return make_collection(cfg, env, agent.policy, torch.device("cpu")), agent.policy


def batches(collection: Collection, number: int) -> list:
    iterator = iter(collection)
    return [next(iterator).clone() for _ in range(number)]


def assert_true_transitions(data: list) -> int:
    """Each row leads to the next one of its environment, unless it ends; returns how many end."""
    rows = torch.cat(data, -1)
    assert rows.batch_size[0] == 4
    ended = rows["next", "done"][:, :-1, 0]
    leads, begins = rows["next", "observation"][:, :-1], rows["observation"][:, 1:]
    same = (leads == begins).all(-1)
    assert torch.equal(same, ~ended)  # a last observation is the true one, not a reset's
    return int(ended.sum())


def test_batches_are_of_all_environments_exactly_counted_with_random_actions_first():
    collection, _ = make(*SETTINGS)
    try:
        data = batches(collection, 8)
        threads = torch.get_num_threads()
    finally:
        collection.close()
    assert [tuple(batch.shape) for batch in data] == [(4, 10)] * 8
    assert collection.frames == 8 * 40
    assert assert_true_transitions(data) > 0
    # 200 frames of warm-up are uniform in the box and in no worker the same; then the policy acts.
    warm, acted = torch.cat(data[:5], -1)["action"], torch.cat(data[5:], -1)["action"]
    assert warm.abs().max() <= 1
    assert abs(float(warm.var()) - 1 / 3) < 0.06
    assert not torch.equal(warm[:2], warm[2:])
    assert not torch.equal(acted[:2], acted[2:])
    assert threads == torch.get_num_threads()


def test_workers_act_with_the_weights_of_after_the_update():
    collection, policy = make(*SETTINGS, "collector.warmup=policy", algo="sac")
    try:
        iterator = iter(collection)
        before = next(iterator)["action"].clone()
        with torch.no_grad():
            for param in policy.parameters():
                param.zero_()
            *_, bias = policy.parameters()
            bias[:3], bias[3:] = 7.0, -20.0  # tanh(7) is 1; no width
        after = next(iterator)["action"].clone()
    finally:
        collection.close()
    assert before.std() > 0.1
    assert torch.allclose(after, torch.ones(()), atol=1e-4)


def test_same_seed_same_batches_another_seed_others():
    found = []
    for seed in (0, 0, 1):
        collection, _ = make(*SETTINGS, f"seed={seed}")
        try:
            found.append(torch.cat(batches(collection, 6), -1))
        finally:
            collection.close()
    assert torch.equal(found[0]["next", "observation"], found[1]["next", "observation"])
    assert torch.equal(found[0]["action"], found[1]["action"])
    assert not torch.equal(found[0]["action"], found[2]["action"])


def test_a_killed_worker_is_told_and_replaced_and_the_frames_stay_exact():
    collection, _ = make(*SETTINGS, "collector.max_restarts=1")
    try:
        iterator = iter(collection)
        next(iterator)
        kill_one(collection)
        with pytest.warns(UserWarning, match=r"a worker failed after \d+ frames.*1 of 1"):
            data = [next(iterator).clone() for _ in range(3)]
        assert collection.frames == 4 * 40
        assert_true_transitions(data)
        kill_one(collection)
        with pytest.raises(RunError, match=r"replaced 1 times.*max_restarts=1.*direct"):
            for _ in range(3):
                next(iterator)
    finally:
        collection.close()


def kill_one(collection: Collection) -> None:
    """Kills a worker and waits until it is dead."""
    process = collection._collector.procs[1]
    os.kill(process.pid, signal.SIGKILL)
    process.join(10)
    assert not process.is_alive()


def test_a_run_of_workers_stops_resumes_with_new_episodes_and_leaves_no_process(tmp_path):
    typed = [*TINY["sac"], *SETTINGS, "collector.frames_per_batch=4", "compile=false"]
    run_dir = tmp_path / "run"
    code, output, errors = run(*typed, f"run_dir={run_dir}", "optim.total_updates=30", cwd=tmp_path)
    assert code == 0, errors
    assert "it is in other processes" in output + errors
    code, _, errors = run(f"resume={run_dir}", "optim.total_updates=60", cwd=tmp_path)
    assert code == 0, errors
    assert [row["updates"] for row in rows_of(run_dir / "eval.csv")] == ["0", "30", "60"]
    state = checkpoint_leaves(run_dir)
    assert state["/counters/updates"] == 60
    assert state["/collection/frames"] == 200 + 60 * 5
    assert state["/collection/env"] is None


def test_direct_is_the_default_and_torchrls_in_process_collector():
    collection, _ = make()
    try:
        batches(collection, 1)
        assert type(collection) is Collection
        assert isinstance(collection._collector, Collector)
    finally:
        collection.close()


def test_ray_is_told_of_where_it_is_missing():
    try:
        import ray  # noqa: F401
    except ImportError:
        with pytest.raises(RunError, match=r"needs Ray: pip install.*multi_process"):
            make(*WORKERS, "collector.backend=ray")


def test_ray_collects_what_processes_collect_and_replaces_a_dead_worker():
    ray = pytest.importorskip("ray")
    found = []
    for backend in ("multi_process", "ray"):
        collection, _ = make(*WORKERS, f"collector.backend={backend}")
        try:
            iterator = iter(collection)
            found.append(torch.cat([next(iterator).clone() for _ in range(6)], -1))
            if backend == "ray":
                ray.kill(collection._collector.remote_collectors[0])
                with pytest.warns(UserWarning, match="a worker failed"):
                    next(iterator)
                assert collection.frames == 7 * 40
        finally:
            collection.close()
    ray.shutdown()
    assert torch.equal(found[0]["action"], found[1]["action"])
    assert assert_true_transitions([found[1]]) > 0


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("num_workers", 2, "another collector.backend than direct"),
        ("num_workers", 0, "greater than or equal to 1"),
        ("backend", "threads", "'direct', 'multi_process' or 'ray'"),
        ("max_restarts", -1, "greater than or equal to 0"),
    ],
)
def test_wrong_settings_are_told(key, value, message):
    fitting = {"num_envs": 4, "frames_per_batch": 4, "warmup_frames": 4, "warmup": "random"}
    with pytest.raises(ValidationError, match=message):
        CollectorSettings(**fitting, **{key: value})


def test_workers_that_do_not_share_the_environments_evenly_are_told():
    with pytest.raises(RunError, match=r"collector.num_workers=2.*divisor.*num_envs \(5\)"):
        configured(composed("collector.backend=multi_process", "collector.num_workers=2"))
