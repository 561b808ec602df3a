"""A toy agent with an offline phase: stopped anywhere and resumed, a run is the unbroken one."""

from __future__ import annotations

import dataclasses
import os
import signal
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type

from recipe_cases import assert_same_state, rows_of, without_time
from torchrl_aca.errors import RunError
from torchrl_aca.replay import TRANSITION_KEYS, MixedReplayBuffer, make_replay_buffer, transitions
from torchrl_aca.training import run as run_module
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import list_checkpoints, read_checkpoint
from torchrl_aca.training.collection import Collection
from torchrl_aca.training.config import RunConfig, checked
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.randomness import seed_everything
from torchrl_aca.training.run import Run
from torchrl_aca.training.run_dir import DONE, lock

OFFLINE, WARMUP, UPDATES = 30, 40, 40
SETTINGS = {
    "seed": 0,
    "device": "cpu",
    "num_threads": 1,
    "compile": False,
    "matmul_precision": "highest",
    "cudagraphs": False,
    "resume": None,
    "env": {"name": "Hopper-v4"},
    "algo": {"name": "toy"},
    "collector": {"num_envs": 2, "frames_per_batch": 2, "warmup_frames": WARMUP},
    "buffer": {"capacity": 100},
    "optim": {
        "total_updates": UPDATES,
        "offline_updates": OFFLINE,
        "utd_ratio": 0.5,
        "batch_size": 8,
        "gamma": 0.99,
        "tau": 0.5,
    },
    "eval": {
        "interval": 20,
        "episodes": 1,
        "seed": 100,
        "random": False,
        "draws": "fresh",
        "max_steps": None,
        "stop_return": None,
    },
    "checkpoint": {"interval": 15, "keep_last": 1},
    "logger": {"backend": "none", "interval": 10, "project": "toy", "wandb_mode": "offline"},
    "video": {"enabled": False},
}


class NoisyLinear(nn.Module):
    """A policy whose actions say whether they were drawn for exploration."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(11, 3)

    def forward(self, observation):
        action = self.linear(observation).tanh()
        if exploration_type() == ExplorationType.DETERMINISTIC:
            return action, torch.zeros_like(action)
        draw = torch.rand_like(action)
        return (action + 0.1 * draw).clamp(-1, 1), draw


def toy_agent() -> Agent:
    """Behaviour cloning with momentum; the batch, the draws and the step all matter."""
    network = NoisyLinear()
    policy = TensorDictModule(network, in_keys=["observation"], out_keys=["action", "draw"])
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)

    def update(batch, phase):
        target = batch["action"] + 0.1 * torch.randn_like(batch["action"])
        loss = (network.linear(batch["observation"]).tanh() - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return TensorDict({f"loss_{phase}": loss.detach(), "draw": batch["draw"].mean()})

    return Agent(
        policy,
        lambda batch: update(batch, "online"),
        {"network": network, "optimizer": optimizer},
        offline_update=lambda batch: update(batch, "offline"),
        extra_keys=("draw",),
    )


def offline_rows(num: int = 50) -> TensorDict:
    generator = torch.Generator().manual_seed(5)
    flag = torch.zeros(num, 1, dtype=torch.bool)
    observation = torch.randn(num, 11, generator=generator)
    following = {
        "observation": observation + 1,
        "reward": torch.zeros(num, 1),
        "done": flag,
        "terminated": flag.clone(),
    }
    action = torch.rand(num, 3, generator=generator)
    row = {"observation": observation, "action": action, "draw": action + 1, "next": following}
    return TensorDict(row, batch_size=[num])


def train(run_dir: Path, *, warmup="random", stop=None, resume=False, changes=None) -> list[str]:
    """The loop of the recipes; `stop=(phase, n)` sends SIGTERM at the n-th step of a phase.

    Returns what happened, in order.
    """
    cfg = checked(
        RunConfig,
        {**SETTINGS, "run_dir": str(run_dir), **(changes or {})}
        | {"collector": {**SETTINGS["collector"], "warmup": warmup}},
    )
    checkpoint = read_checkpoint(run_dir) if resume else None
    cfg.resume = str(run_dir) if resume else None
    seed_everything(cfg.seed)
    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, cfg.seed)
    agent, history = toy_agent(), []
    buffer = MixedReplayBuffer(
        offline_rows(),
        make_replay_buffer(cfg.buffer.capacity, cfg.optim.batch_size),
        offline_fraction=0.5,
        batch_size=cfg.optim.batch_size,
        keys=(*TRANSITION_KEYS, *agent.extra_keys),
    )
    collection = Collection(env, agent.policy, cfg.collector)

    def step(phase, number):
        history.append(phase)
        if stop == (phase, number):
            os.kill(os.getpid(), signal.SIGTERM)

    def evaluate(watch):
        watch(1)
        weight = agent.state["network"].linear.weight.mean().item()
        return {"return_mean": weight, "return_std": 0.0, "num_episodes": 1.0}

    with Run(cfg, agent, buffer, collection, evaluate, checkpoint, script="toy.py") as run:
        buffer.offline_fraction = 1.0
        for batch in run.offline_phase(buffer):
            assert (batch["draw"] >= 1).all()  # offline rows alone
            run.add(agent.offline_update(batch))
            step("offline", run.counters.offline_updates + 1)
        buffer.offline_fraction = 0.5
        for data in collection:
            drawn = data.get("draw", None) is not None and bool((data["draw"] > 0).any())
            step("policy" if drawn else "random", collection.frames)
            if data.get("draw", None) is None:
                data["draw"] = torch.zeros_like(data["action"])
            buffer.extend(transitions(data, agent.extra_keys))
            for batch in run.due(buffer):
                assert (batch["draw"] >= 1).sum() == 4 * 3  # half of the eight rows
                run.add(agent.update(batch))
                step("online", run.counters.updates + 1)
            if run.end_iteration():
                break
    return history


@pytest.fixture(scope="module", params=["random", "policy"])
def unbroken(request, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("toy") / request.param
    history = train(run_dir, warmup=request.param)
    return run_dir, request.param, history


def test_the_phases_follow_one_another(unbroken):
    run_dir, warmup, history = unbroken
    assert history[:OFFLINE] == ["offline"] * OFFLINE
    assert history[OFFLINE : OFFLINE + WARMUP // 2] == [warmup] * (WARMUP // 2)
    assert history[OFFLINE + WARMUP // 2 :] == ["policy", "online"] * UPDATES
    rows = rows_of(run_dir / "metrics.csv")
    axes = [tuple(int(row[k]) for k in ("offline_updates", "updates", "frames")) for row in rows]
    online = [(OFFLINE, n, WARMUP + 2 * n) for n in range(10, UPDATES + 1, 10)]
    assert axes == [(10, 0, 0), (20, 0, 0), (30, 0, 0), *online]
    assert all(row["loss_offline"] and not row["loss_online"] for row in rows[:3])
    assert all(row["loss_online"] and not row["loss_offline"] for row in rows[3:])
    evaluations = [
        (row["offline_updates"], row["updates"]) for row in rows_of(run_dir / "eval.csv")
    ]
    assert evaluations == [("0", "0"), ("20", "0"), ("30", "0"), ("30", "20"), ("30", "40")]


STOPS = [
    ("offline", 1),
    ("offline", 14),
    ("offline", OFFLINE),
    ("warm-up", 2),
    ("warm-up", 22),
    ("warm-up", WARMUP),
    ("online", 1),
    ("online", 23),
]


@pytest.mark.parametrize("stop", STOPS, ids=lambda stop: f"{stop[0]}-{stop[1]}")
def test_a_run_stopped_anywhere_goes_on_there_bit_for_bit(unbroken, stop, tmp_path):
    run_dir, warmup, history = unbroken
    phase, number = stop
    stop = (warmup if phase == "warm-up" else phase, number)
    before = train(tmp_path / "run", warmup=warmup, stop=stop)
    after = train(tmp_path / "run", warmup=warmup, resume=True)
    assert before + after == history
    assert len(before) < len(history)
    assert_same_state(run_dir, tmp_path / "run")
    for table in ("metrics.csv", "eval.csv"):
        assert without_time(run_dir / table) == without_time(tmp_path / "run" / table)


def test_many_stops_are_as_good_as_one(unbroken, tmp_path):
    run_dir, warmup, history = unbroken
    stops = [("offline", 7), ("offline", 8), (warmup, 10), (warmup, 12), ("online", 2)]
    steps = []
    for number, stop in enumerate([*stops, None]):
        steps += train(tmp_path / "run", warmup=warmup, stop=stop, resume=number > 0)
    assert steps == history
    assert_same_state(run_dir, tmp_path / "run")


def test_a_run_ended_at_once_tells_how_to_go_on(unbroken, tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    run_dir, warmup, _ = unbroken
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "kill", interrupt)  # the second Ctrl-C, instead of the first
        train(tmp_path / "run", warmup=warmup, stop=("online", 20))
    told = "stopped at once after 49 updates; go on from the newest checkpoint with: python toy.py"
    assert f"{told} resume={tmp_path / 'run'}\n" in capsys.readouterr().out
    later = tmp_path / "run" / "checkpoints" / "policy_0000000099.pt"
    later.write_bytes(b"of a branch whose checkpoints are gone")
    train(tmp_path / "run", warmup=warmup, resume=True)
    assert not later.exists()
    assert_same_state(run_dir, tmp_path / "run")
    assert without_time(run_dir / "eval.csv") == without_time(tmp_path / "run" / "eval.csv")


def test_an_error_in_the_first_evaluation_frees_the_run(tmp_path, monkeypatch):
    def fail(run):
        raise RuntimeError("no evaluation")

    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(Run, "log_evaluation", fail)
    with pytest.raises(RuntimeError, match="no evaluation"):
        train(tmp_path / "run")
    assert signal.getsignal(signal.SIGTERM) is handler
    lock(tmp_path / "run").release()  # would be refused while the run has it


def test_an_offline_phase_needs_an_agent_that_has_one(tmp_path, monkeypatch):
    agent = toy_agent()
    agent.offline_update = None
    monkeypatch.setattr("test_run_phases.toy_agent", lambda: agent)
    with pytest.raises(RunError, match="optim.offline_updates=30: expected 0.*algo=toy"):
        train(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_part_that_cannot_be_saved_is_told_before_training(tmp_path, monkeypatch):
    class Unsavable:
        def state_dict(self):
            raise TypeError("no state")

    agent = toy_agent()
    agent.state["counter"] = Unsavable()
    monkeypatch.setattr("test_run_phases.toy_agent", lambda: agent)
    with pytest.raises(RunError, match="'agent.counter' cannot be saved .TypeError: no state"):
        train(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_rows_of_a_mixture_are_never_rewritten(tmp_path, monkeypatch):
    agent = toy_agent()
    agent.rewrites = {"better": "action"}
    monkeypatch.setattr("test_run_phases.toy_agent", lambda: agent)
    with pytest.raises(RunError, match="algo=toy rewrites rows.*got a MixedReplayBuffer"):
        train(tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("writer", ["save_policy", "save_checkpoint", "write_card", "write_text"])
def test_a_full_disk_is_told_wherever_the_run_finds_it(writer, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    run_dir = tmp_path / "run"
    if writer == "write_text":  # which writes the configuration first: here, the file `done`
        real = run_module.write_text
        monkeypatch.setattr(
            run_module, writer, lambda path, text: (fail if path.name == DONE else real)(path, text)
        )
    else:
        monkeypatch.setattr(run_module, writer, fail)
    if writer == "save_policy":
        agent = dataclasses.replace(toy_agent(), policy_builder=object())  # one that has a policy
        monkeypatch.setitem(globals(), "toy_agent", lambda: agent)
    with pytest.raises(RunError, match="run cannot be written: .*No space left.*Make room") as told:
        train(run_dir)
    saved = bool(list_checkpoints(run_dir / "checkpoints"))
    assert saved == (writer in ("write_card", "write_text")) == ("resume=" in str(told.value))


def test_an_error_that_is_not_the_disks_is_not_told_as_one(tmp_path, monkeypatch):
    def fail(*args):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(run_module, "save_checkpoint", fail)
    with pytest.raises(torch.OutOfMemoryError):
        train(tmp_path / "run")
