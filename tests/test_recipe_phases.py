"""The methods with an offline phase: what is sampled and who acts in each phase, stops, reuse."""

from __future__ import annotations

import os
import shutil
import signal
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import pytest
import torch

from agents import AGENTS
from o2o_cases import MARK, OFFLINE, WITH_OFFLINE_PHASE, record, run_o2o, settings
from recipe_cases import assert_same_state, rows_of, without_time
from torchrl_aca.errors import RunError
from torchrl_aca.replay import transitions
from torchrl_aca.training.checkpoint import read_checkpoint
from torchrl_aca.training.files import replace_file

EVERY = sorted(WITH_OFFLINE_PHASE)
WARMUP, UPDATES, BATCH = 50, 60, 16  # of the tiny runs


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("data") / "noise")


@dataclass
class Seen:
    """What happened in a run, in order."""

    steps: list[str] = field(default_factory=list)
    batches: list = field(default_factory=list)
    metrics: list = field(default_factory=list)
    actions: list = field(default_factory=list)  # of the policy when it was asked for one
    weights: list = field(default_factory=list)  # of the policy at the first online update
    stop: tuple[str, int] | None = None  # SIGTERM at the n-th step of a kind

    def step(self, kind, batch=None, metrics=None):
        self.steps.append(kind)
        if batch is not None:
            self.batches.append((kind, batch.clone()))
            self.metrics.append((kind, dict(metrics.items())))
        if self.stop == (kind, self.steps.count(kind)):
            os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture
def watch(monkeypatch):
    """Gives the record of the runs that follow, which may be stopped in their course."""
    originals = dict(AGENTS)

    def watching(stop=None):
        seen = Seen(stop=stop)

        def watched(make):
            def make_agent(cfg, env, device):
                agent = make(cfg, env, device)
                update, offline_update = agent.update, agent.offline_update
                rows_of_data = agent.rows or partial(transitions, extra_keys=agent.extra_keys)

                def note(kind, function, batch):
                    if kind == "online" and not seen.weights:
                        seen.weights += [p.detach().clone() for p in agent.policy.parameters()]
                    metrics = function(batch)
                    seen.step(kind, batch, metrics)
                    return metrics

                def rows(data):
                    seen.step("frame")
                    return rows_of_data(data)

                agent.policy.register_forward_hook(
                    lambda module, inputs, out: seen.actions.append(out["action"].clone())
                )
                agent.update = lambda batch: note("online", update, batch)
                agent.offline_update = lambda batch: note("offline", offline_update, batch)
                agent.rows = rows
                return agent

            return make_agent

        for algo in EVERY:
            method = originals[algo]
            monkeypatch.setitem(AGENTS, algo, replace(method, make=watched(method.make)))
        return seen

    return watching


@pytest.fixture(scope="module", params=EVERY)
def unbroken(request, data, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp(request.param) / "unbroken"
    return run_o2o(*settings(data, run_dir, request.param)), request.param


# --- the phases -----------------------------------------------------------------------------------


@pytest.mark.parametrize("algo", EVERY)
@pytest.mark.parametrize("fraction", [None, 0.0])
def test_every_minibatch_has_the_share_of_its_phase(algo, fraction, data, watch, tmp_path):
    seen = watch()
    typed = [] if fraction is None else [f"offline_fraction={fraction}"]
    run_dir = run_o2o(*settings(data, tmp_path / "here", algo), *typed)
    online = 0 if fraction == 0.0 or algo == "wsrl" else BATCH // 2
    for kind, batch in seen.batches:
        offline = int((batch["next", "reward"] > MARK).sum())
        assert (offline, len(batch)) == (BATCH if kind == "offline" else online, BATCH)
    kinds = [kind for kind, _ in seen.batches]
    assert kinds == ["offline"] * OFFLINE + ["online"] * UPDATES
    first = seen.steps.index("online")
    assert first >= OFFLINE + WARMUP and "frame" not in seen.steps[:OFFLINE]
    card = (run_dir / "card.md").read_text()
    assert f"| offline rows of a minibatch | {online} of {BATCH} |" in card


def test_each_phase_is_logged_on_its_own_axis(unbroken):
    run_dir, algo = unbroken
    rows = rows_of(run_dir / "eval.csv")
    axes = [tuple(int(row[k]) for k in ("offline_updates", "updates", "frames")) for row in rows]
    assert axes[:2] == [(0, 0, 0), (OFFLINE, 0, 0)]
    assert [row[:2] for row in axes[2:]] == [(OFFLINE, 30), (OFFLINE, 60)]
    assert axes[-1] >= (OFFLINE, UPDATES, WARMUP + UPDATES)
    rows = rows_of(run_dir / "metrics.csv")
    assert [int(row["offline_updates"]) for row in rows[:2]] == [10, 20]
    assert {row["updates"] for row in rows[:2]} == {"0"}
    if algo == "wsrl":  # conservative offline, plain SAC online
        assert all(row["cql_gap"] for row in rows[:2])
        assert not any(row["cql_gap"] for row in rows[2:])


STOPS = [
    ("offline", 7),
    ("offline", OFFLINE),
    ("frame", 20),
    ("online", 23),
]


@pytest.mark.parametrize("stop", STOPS, ids=lambda stop: f"{stop[0]}-{stop[1]}")
def test_a_run_stopped_in_any_phase_goes_on_bit_for_bit(unbroken, stop, data, watch, tmp_path):
    whole, algo = unbroken
    seen = watch(stop)
    stopped = run_o2o(*settings(data, tmp_path / "here", algo))
    assert stop[0] == seen.steps[-1] and seen.steps.count(stop[0]) == stop[1]
    watch()
    resumed = run_o2o(f"resume={stopped}")
    assert_same_state(whole, resumed)
    for table in ("metrics.csv", "eval.csv"):
        assert without_time(whole / table) == without_time(resumed / table)


# --- who acts first -------------------------------------------------------------------------------


@pytest.mark.parametrize("stop", [None, ("frame", 20)], ids=["at once", "after a resume"])
@pytest.mark.parametrize("algo", EVERY)
def test_the_first_frames_are_the_trained_policys(algo, stop, data, watch, tmp_path):
    seen = watch(stop)
    run_dir = run_o2o(*settings(data, tmp_path / "here", algo))
    actions, weights = seen.actions, seen.weights
    if stop:
        seen = watch()
        run_o2o(f"resume={run_dir}")
        actions, weights = actions + seen.actions, seen.weights
    parts = read_checkpoint(run_dir)["parts"]
    rows = parts["buffer"]["online"]["rows"]["action"][: WARMUP // 2]
    acted = torch.cat([a.reshape(-1, 3) for a in actions])
    assert len(rows) == WARMUP // 2
    assert all((acted == row).all(-1).any() for row in rows)  # a random action would not be there
    trained = torch.load(run_dir / "pretrained.pt", weights_only=True)["parts"]["agent.loss"]
    frozen = [value for name, value in trained.items() if name.startswith("actor_network")]
    assert weights  # at the first online update: still those that the offline phase ended with
    assert all(any(torch.equal(weight, value) for value in frozen) for weight in weights)


def test_wsrl_goes_online_with_an_empty_buffer_and_four_critic_steps_to_one_of_the_actor(
    data, watch, tmp_path
):
    seen = watch()
    typed = ["utd=4", "wsrl.actor_interval=null", "online_frames=5"]
    run_dir = run_o2o(*settings(data, tmp_path / "here", "wsrl"), *typed)
    online = [metrics for kind, metrics in seen.metrics if kind == "online"]
    assert ["loss_actor" in metrics for metrics in online] == [False, False, False, True] * 5
    assert all("loss_actor" in metrics for kind, metrics in seen.metrics if kind == "offline")
    rewards = read_checkpoint(run_dir)["parts"]["buffer"]["online"]["rows"]["next.reward"]
    assert len(rewards) == WARMUP + 5 and (rewards < MARK).all()


# --- Cal-QL ---------------------------------------------------------------------------------------


def test_calql_samples_finished_episodes_alone_with_their_returns(data, watch, tmp_path):
    seen = watch()
    run_dir = run_o2o(*settings(data, tmp_path / "here", "calql"), "optim.gamma=0.9")
    parts = read_checkpoint(run_dir)["parts"]
    rows, frames = parts["buffer"]["online"]["rows"], parts["collection"]["frames"]
    waiting = sum(len(v["action"]) for v in parts["agent.unfinished_episodes"]["pending"].values())
    assert len(rows["mc_return"]) + waiting == frames and rows["next.done"][-1]
    expected, following = [], 0.0
    for reward, done in reversed(list(zip(rows["next.reward"], rows["next.done"], strict=True))):
        following = reward.item() + (0.0 if done else 0.9 * following)
        expected.append([following])
    torch.testing.assert_close(rows["mc_return"], torch.tensor(expected[::-1]))
    finished = {float(r) for r in rows["mc_return"]}
    for _, batch in seen.batches:
        online = batch["next", "reward"] < MARK
        assert {float(r) for r in batch["mc_return"][online]} <= finished
        assert (batch["mc_return"][~online] > MARK).all()


def test_calql_waits_for_its_first_finished_episode(data, watch, tmp_path):
    seen = watch()
    typed = ["collector.warmup_frames=16", "optim.total_updates=4"]  # before any episode ends
    run_o2o(*settings(data, tmp_path / "here", "calql"), *typed)
    assert seen.steps[OFFLINE : seen.steps.index("online")].count("frame") > 16
    assert [kind for kind, _ in seen.batches] == ["offline"] * OFFLINE + ["online"] * (
        len(seen.batches) - OFFLINE
    )


def test_data_without_episode_ends_are_refused_for_calql_alone(tmp_path):
    path = record(tmp_path / "endless", complete=False)
    with pytest.raises(RunError, match="has no episode with an end of its own.*algo=calql needs"):
        run_o2o(*settings(path, tmp_path / "calql", "calql"))
    assert not (tmp_path / "calql").exists()
    run_o2o(*settings(path, tmp_path / "cql", "cql"), "optim.total_updates=1")


# --- from another run -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """Runs that are through with their offline phase."""
    folder = tmp_path_factory.mktemp("trained")
    typed = ["optim.total_updates=2", "seed=3"]
    return {
        algo: run_o2o(*settings(data, folder / algo, algo), *extra, *typed)
        for algo, extra in {
            "cql": ["cql.gap_threshold=null"],
            "iql": [],
            "wsrl": [],
            "calql": [],
            "aca": [],
        }.items()
    }


@pytest.mark.parametrize(
    ("algo", "source"),
    [
        ("cql", "cql"),
        ("iql", "iql"),
        ("calql", "calql"),
        ("wsrl", "wsrl"),
        ("wsrl", "cql"),
        ("cql", "wsrl"),
    ],
)
def test_a_run_goes_on_from_the_offline_phase_of_another(
    algo, source, trained, data, watch, tmp_path
):
    seen = watch()
    typed = [f"pretrained={trained[source]}"]
    if algo == "cql":
        typed.append("cql.gap_threshold=null")
    run_dir = run_o2o(*settings(data, tmp_path / "here", algo), *typed)
    assert [kind for kind, _ in seen.batches] == ["online"] * UPDATES
    for table in ("eval.csv", "metrics.csv"):
        assert {row["offline_updates"] for row in rows_of(run_dir / table)} == {str(OFFLINE)}
    end = [r for r in rows_of(trained[source] / "eval.csv") if r["offline_updates"] == "20"][0]
    start = rows_of(run_dir / "eval.csv")[0]
    assert start["frames"] == "0" and start["return_mean"] == end["return_mean"]
    there = torch.load(trained[source] / "pretrained.pt", weights_only=True)["parts"]
    moments = there["agent.optimizer"]["state"][0]["step"]
    now = read_checkpoint(run_dir)["parts"]["agent.optimizer"]["state"][0]["step"]
    assert (moments, now) == (OFFLINE, OFFLINE + UPDATES)  # Adam goes on as well


def test_such_a_run_is_resumed_without_the_other(trained, data, watch, tmp_path):
    source = shutil.copytree(trained["wsrl"], tmp_path / "source")
    typed = [*settings(data, tmp_path / "whole", "wsrl"), f"pretrained={source}"]
    whole = run_o2o(*typed)
    watch(("frame", 20))
    stopped = run_o2o(*typed[:-2], f"run_dir={tmp_path / 'here'}", typed[-1])
    shutil.rmtree(source)
    watch()
    by_command = shutil.copytree(stopped, tmp_path / "again")
    assert_same_state(whole, run_o2o(f"resume={stopped}"))
    typed = [*typed[:-2], f"run_dir={by_command}", typed[-1], "existing=resume"]
    assert_same_state(whole, run_o2o(*typed))  # whatever offline_updates is here


def test_wsrl_needs_no_data_when_it_is_pretrained(trained, tmp_path):
    typed = [s for s in settings(tmp_path, tmp_path / "here", "wsrl") if "dataset" not in s]
    run_dir = run_o2o(*typed, f"pretrained={trained['wsrl']}", "optim.total_updates=2")
    assert "| offline data | none |" in (run_dir / "card.md").read_text()


@pytest.mark.parametrize(
    ("source", "typed", "message"),
    [
        ("iql", [], "has algo=iql; expected cql"),
        ("calql", [], "has algo=calql; expected cql"),
        ("cql", ["env=walker2d"], "is of Hopper-v4; expected data of Walker2d-v4"),
        ("cql", ["cql.num_cells=[8,8]"], r"has cql.num_cells=\[16, 16\]; expected \[8, 8\]"),
        ("cql", ["env.kwargs={reset_noise_scale: 0.1}"], "has env.kwargs=None; expected {'reset"),
        ("cql", ["cql.weight=1"], "has cql.weight=5.0; expected 1.0"),
        ("cql", ["optim.lr=1e-3"], "has optim.lr=0.0003; expected 0.001"),
        ("cql", ["optim.batch_size=8"], "has optim.batch_size=16; expected 8"),
        ("aca", [], "had no offline phase, so its agent was not trained on data alone"),
        (None, [], "expected the directory of a run with an offline phase, found none"),
    ],
)
def test_what_does_not_fit_is_refused_with_a_reason(
    source, typed, message, trained, data, tmp_path
):
    other = trained.get(source, tmp_path / "nowhere")
    base = [*settings(data, tmp_path / "here", "cql"), "cql.gap_threshold=null"]
    with pytest.raises(RunError, match=message):
        run_o2o(*base, *typed, f"pretrained={other}")
    assert not (tmp_path / "here").exists()


def test_an_offline_phase_needs_data(tmp_path):
    typed = [s for s in settings(tmp_path, tmp_path / "here", "wsrl") if "dataset" not in s]
    with pytest.raises(RunError, match="dataset=null.*algo=wsrl has an offline phase"):
        run_o2o(*typed)
    assert not (tmp_path / "here").exists()


def test_an_endless_reward_that_is_not_discounted_is_told(data, tmp_path):
    typed = ["calql.tail=bootstrap_rate", "optim.gamma=1"]
    with pytest.raises(RunError, match="algo=calql cannot be built: .* needs gamma below 1, got"):
        run_o2o(*settings(data, tmp_path / "here", "calql"), *typed)
    assert not (tmp_path / "here").exists()


def test_another_environment_is_refused_where_no_data_tell(trained, tmp_path):
    typed = [s for s in settings(tmp_path, tmp_path / "here", "wsrl") if "dataset" not in s]
    with pytest.raises(RunError, match="has env.name=Hopper-v4; expected Walker2d-v4"):
        run_o2o(*typed, f"pretrained={trained['wsrl']}", "env=walker2d")


def test_another_data_set_is_refused(trained, tmp_path):
    other = record(tmp_path / "other", seed=1)
    with pytest.raises(RunError, match="has dataset=[0-9a-f]{64}; expected [0-9a-f]{64}"):
        run_o2o(*settings(other, tmp_path / "here", "iql"), f"pretrained={trained['iql']}")


def test_an_unfinished_offline_phase_is_refused(data, watch, tmp_path):
    watch(("offline", 7))
    stopped = run_o2o(*settings(data, tmp_path / "there", "iql"))
    watch()
    with pytest.raises(RunError, match=r"has made 7 of 20 updates; expected all.*resume="):
        run_o2o(*settings(data, tmp_path / "here", "iql"), f"pretrained={stopped}")


def test_a_damaged_file_is_refused(trained, data, tmp_path):
    source = shutil.copytree(trained["iql"], tmp_path / "source")
    content = bytearray((source / "pretrained.pt").read_bytes())
    content[len(content) // 2] ^= 255
    replace_file(source / "pretrained.pt", lambda file: file.write(content))
    with pytest.raises(RunError, match="pretrained.pt (is damaged|cannot be read).*Train it again"):
        run_o2o(*settings(data, tmp_path / "here", "iql"), f"pretrained={source}")


@pytest.mark.parametrize("algo", EVERY)
def test_untrained_weights_do_not_go_online(algo, data, tmp_path):
    with pytest.raises(RunError, match=f"offline_updates=0: algo={algo} goes online with what"):
        run_o2o(*settings(data, tmp_path / "here", algo), "offline_updates=0")
    assert not (tmp_path / "here").exists()


def test_a_method_without_an_offline_phase_takes_none_over(trained, data, tmp_path):
    with pytest.raises(RunError, match="expected null, because algo=aca has no offline phase"):
        run_o2o(*settings(data, tmp_path / "here", "aca"), f"pretrained={trained['cql']}")
