"""The recipe that mixes offline data in, run as users run it, with tiny sizes."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from agents import AGENTS
from o2o_cases import ALGORITHMS, MARK, TINY, record, run_o2o, settings
from recipe_cases import assert_same_state, composed, rows_of, run, without_time
from torchrl_aca.errors import RunError
from torchrl_aca.offline import DatasetError
from torchrl_aca.offline.layout import sha256


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("data") / "noise")


@pytest.fixture
def train():
    """The recipe without a process of its own."""
    return run_o2o


# --- a run ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("algo", ["aca", "rlpd", "rlpd_wsrl"])
def test_the_command_trains_and_its_card_names_the_data(algo, data, tmp_path):
    code, output, errors = run(
        *settings(data, tmp_path / "here", algo), cwd=tmp_path, recipe="o2o_halfcheetah"
    )
    assert code == 0, errors
    assert "mean evaluation return: before" in output
    metrics = rows_of(tmp_path / "here" / "metrics.csv")
    assert [int(row["updates"]) for row in metrics] == [10, 20, 30, 40, 50, 60]
    assert [int(row["frames"]) for row in metrics] == [60, 70, 80, 90, 100, 110]
    evaluations = rows_of(tmp_path / "here" / "eval.csv")
    assert [int(row["updates"]) for row in evaluations] == [0, 30, 60]
    assert [int(row["frames"]) for row in evaluations] == [0, 80, 110]
    card = (tmp_path / "here" / "card.md").read_text()
    assert re.search(r"\| offline data \| noise, 120 transitions, mean return 4\d{4}\.\d \|", card)
    assert sha256(data / "metadata.json") in card
    assert "| offline rows of a minibatch | 8 of 16 |" in card
    assert "| updates per online frame | 1 |" in card
    assert OmegaConf.load(tmp_path / "here" / "config.yaml").optim.total_updates == 60


@pytest.mark.parametrize("algo", ["aca", "rlpd", "rlpd_wsrl"])
def test_stop_and_resume_equals_never_stopping(algo, data, train, tmp_path):
    unbroken = train(*settings(data, tmp_path / "unbroken", algo))
    stopped = train(*settings(data, tmp_path / "here", algo), "optim.total_updates=34")
    resumed = train(f"resume={stopped}", "optim.total_updates=60")
    assert_same_state(unbroken, resumed)
    assert without_time(unbroken / "metrics.csv") == without_time(resumed / "metrics.csv")


def test_a_resume_with_other_data_is_refused(data, train, tmp_path):
    path = shutil.copytree(data, tmp_path / "noise")
    run_dir = train(*settings(path, tmp_path / "here"), "optim.total_updates=5")
    shutil.rmtree(path)
    record(path, seed=1)
    with pytest.raises(RunError, match="offline fingerprint"):
        train(f"resume={run_dir}", "optim.total_updates=9")
    with pytest.raises(RunError, match="offline_fraction=0.2, but the run"):
        train(f"resume={run_dir}", "offline_fraction=0.2")


# --- minibatches ----------------------------------------------------------------------------------


@pytest.fixture
def seen(monkeypatch) -> list[torch.Tensor]:
    """The rewards of every batch that an agent is given, once a run has been made."""
    batches = []

    def watched(make):
        def make_agent(cfg, env, device):
            agent = make(cfg, env, device)
            update = agent.update

            def update_and_note(batch):
                batches.append(batch["next", "reward"].flatten().clone())
                return update(batch)

            agent.update = update_and_note
            return agent

        return make_agent

    for algo in ("aca", "rlpd"):
        method = AGENTS[algo]
        monkeypatch.setitem(AGENTS, algo, replace(method, make=watched(method.make)))
    return batches


@pytest.mark.parametrize("algo", ["aca", "rlpd"])
@pytest.mark.parametrize(
    ("fraction", "offline"), [("0.5", 8), ("0.25", 4), ("0", 0), ("1", 16), ("0.3", 5)]
)
def test_every_batch_has_its_share_of_offline_rows(
    fraction, offline, algo, data, train, seen, tmp_path
):
    typed = [f"offline_fraction={fraction}", "optim.total_updates=6"]
    train(*settings(data, tmp_path / "here", algo), *typed)
    assert [int((rewards > MARK).sum()) for rewards in seen] == [offline] * 6
    assert {len(rewards) for rewards in seen} == {16}


@pytest.mark.parametrize(("fraction", "offline"), [("0.25", 4), ("0", 0)])
def test_an_offline_phase_has_offline_rows_alone(
    fraction, offline, data, train, seen, tmp_path, monkeypatch
):
    """With an agent whose update of the offline phase is the usual one."""
    method = AGENTS["aca"]

    def with_offline_phase(cfg, env, device):
        agent = method.make(cfg, env, device)
        agent.offline_update = agent.update
        return agent

    monkeypatch.setitem(AGENTS, "aca", replace(method, make=with_offline_phase))
    typed = [f"offline_fraction={fraction}", "optim.offline_updates=4", "optim.total_updates=3"]
    run_dir = train(*settings(data, tmp_path / "here"), *typed)
    assert [int((rewards > MARK).sum()) for rewards in seen] == [16] * 4 + [offline] * 3
    facts = f"| offline rows of a minibatch | {offline} of 16 |"
    assert facts in (run_dir / "card.md").read_text()


def test_without_offline_rows_no_data_set_is_needed(train, seen, tmp_path):
    typed = ["dataset=null", "offline_fraction=0", "optim.total_updates=3"]
    run_dir = train(*settings(tmp_path, tmp_path / "here"), *typed)
    assert len(seen) == 3
    assert "| offline data | none |" in (run_dir / "card.md").read_text()


@pytest.mark.parametrize(
    ("algo", "utd", "updates"), [("aca", 2, 40), ("aca", 0.5, 10), ("rlpd", 2, 40)]
)
def test_updates_per_frame(algo, utd, updates, data, train, seen, tmp_path):
    typed = [f"utd={utd}", "online_frames=20", "logger.interval=10"]
    run_dir = train(*settings(data, tmp_path / "here", algo), *typed)
    assert len(seen) == updates
    assert not torch.equal(seen[0], seen[1])  # each update has a batch of its own
    last = rows_of(run_dir / "metrics.csv")[-1]
    assert (int(last["updates"]), int(last["frames"])) == (updates, 50 + 20)
    assert f"| updates per online frame | {utd} |" in (run_dir / "card.md").read_text()


# --- where the data are ---------------------------------------------------------------------------


def test_a_name_stands_for_a_directory_below_datasets(data, train, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(data, "datasets/noise")
    by_path = train(*settings(data, tmp_path / "path"), "optim.total_updates=3")
    typed = ["optim.total_updates=3", "dataset=aca:noise"]
    assert_same_state(by_path, train(*settings(data, tmp_path / "name"), *typed))


def test_missing_data_are_generated_once(train, tmp_path):
    path = tmp_path / "made"
    typed = ["generate={tier: random, episodes: 4}", "optim.total_updates=3"]
    first = train(*settings(path, tmp_path / "first"), *typed)
    written = (path / "metadata.json").stat().st_mtime_ns
    second = train(*settings(path, tmp_path / "second"), *typed)
    assert (path / "metadata.json").stat().st_mtime_ns == written
    shutil.rmtree(path)
    third = train(*settings(path, tmp_path / "third"), *typed)
    assert path.is_dir()
    assert_same_state(first, second)
    assert_same_state(first, third)
    shutil.rmtree(path)
    train(f"resume={third}", "optim.total_updates=5")
    assert path.is_dir()


def test_the_quickstart_makes_its_data_and_scores_are_normalised(train, tmp_path):
    tiny = [*ALGORITHMS["aca"], *TINY[1:], "eval.episodes=1", "optim.total_updates=2"]
    typed = [
        "env=halfcheetah",
        f"dataset={tmp_path / 'made'}",
        "generate.episodes=1",
        "+generate.check=false",
    ]
    run_dir = train(*tiny, *typed, f"run_dir={tmp_path / 'here'}", name="o2o_quickstart")
    rows = rows_of(run_dir / "eval.csv")
    for row in rows:  # D4RL's random and expert policies are at 0 and 100
        expected = 100 * (float(row["return_mean"]) + 280.178953) / (12135 + 280.178953)
        assert float(row["normalized_score"]) == pytest.approx(expected)
    score = float(rows[-1]["normalized_score"])
    assert f"| normalised score | {score:.1f} |" in (run_dir / "card.md").read_text()


def test_scores_are_those_of_the_data_set(train, tmp_path):
    path = record(tmp_path / "noise", reference_scores=(-50.0, 150.0))
    for fraction in (0.5, 0):  # with its rows, and a control without them
        typed = ["optim.total_updates=2", f"offline_fraction={fraction}"]
        run_dir = train(*settings(path, tmp_path / f"{fraction}"), *typed)
        for row in rows_of(run_dir / "eval.csv"):
            expected = (float(row["return_mean"]) + 50) / 2
            assert float(row["normalized_score"]) == pytest.approx(expected)


def test_the_quickstart_makes_its_data_and_is_short():
    quick, usual = composed(name="o2o_quickstart"), composed(name="o2o_halfcheetah")
    assert quick.algo.name == usual.algo.name == "aca"
    assert 0 < quick.offline_fraction <= usual.offline_fraction == 0.5
    assert quick.generate.tier == "random" and usual.generate is None
    assert quick.online_frames < usual.online_frames


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["dataset=null"], "dataset=null: expected the directory.*or learn without"),
        (["dataset=d4rl:halfcheetah-medium-v2"], "import_dataset.py first.*wrong rows"),
        (["env=walker2d"], "is of Hopper-v4; expected data of Walker2d-v4"),
        (["offline_fraction=1.5"], "offline_fraction=1.5: expected less than or equal to 1"),
        (["offline_fraction=-0.1"], "offline_fraction=-0.1: expected greater than or equal to 0"),
        (["offline_fraction=true"], "offline_fraction=True: expected a valid number"),
        (["dataset=123"], "dataset=123: expected a valid string"),
        (["collector.warmup_frames=some"], "warmup_frames='some': expected a valid integer"),
        (["optim.utd_ratio=null"], "optim.utd_ratio=None: expected a valid number"),
        (["utd=true"], "utd=True: expected a valid number"),
        (["utd=inf"], "utd=inf: expected a finite number"),
        (["offline_fraction=half"], "offline_fraction='half': expected a valid number"),
        (["utd=0"], "utd=0: expected greater than"),
        (["utd=-1"], "utd=-1: expected greater than"),
        (["utd=fast"], "utd='fast': expected a valid number"),
        (["online_frames=0"], "online_frames=0: expected greater than"),
        (["utd=0.01"], "optim.total_updates=0: expected greater than"),
        (["dataset=none", "generate={tiers: random}"], "generate: Key 'tiers'.*make_dataset.yaml"),
        (["dataset=none", "generate=random"], "generate='random': expected a valid dictionary"),
        (
            ["dataset=none", "generate={tier: random, path: x}"],
            "expected keys of make_dataset.yaml but .*path",
        ),
        (["dataset=none", "generate={episodes: 5}"], r"tier=\?\?\?: expected a value"),
        (
            ["dataset=none", "generate={tier: expert}"],
            "tier='expert': expected 'random', 'medium' or",
        ),
    ],
)
def test_mistakes_are_told_before_any_work(overrides, message, data, train, tmp_path):
    typed = [*TINY, f"dataset={data}", f"run_dir={tmp_path / 'here'}", *overrides]
    with pytest.raises(RunError, match=message):
        train(*typed)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"env_id": None, "sizes": {"observation_dim": 17, "action_dim": 6}},
            "other sizes.*expected {'observation': 11, 'action': 3}, got {'observation': 17",
        ),
        ({"bound": 2.0}, r"action_bounds \[-2.0.*within \[-1.0"),
    ],
)
def test_data_that_do_not_fit_the_environment_are_refused(options, message, train, tmp_path):
    path = record(tmp_path / "other", **options)
    with pytest.raises(RunError, match=message):
        train(*settings(path, tmp_path / "here"))
    assert not (tmp_path / "here").exists()


def test_data_that_were_changed_on_disk_are_refused(data, train, tmp_path):
    path = shutil.copytree(data, tmp_path / "noise")
    file = path / "next" / "reward.memmap"
    content = bytearray(file.read_bytes())
    content[:4] = np.float32(np.nan).tobytes()
    file.write_bytes(content)
    with pytest.raises(DatasetError, match="reward.memmap has SHA-256 .*was changed"):
        train(*settings(path, tmp_path / "here"))


def test_a_missing_data_set_is_told_in_one_message(train, tmp_path):
    with pytest.raises(DatasetError, match="expected the directory of a data set, found nothing"):
        train(*settings(tmp_path / "nowhere", tmp_path / "here"))
    typed = settings(tmp_path / "nowhere", tmp_path / "here")
    code, _, errors = run(*typed, cwd=tmp_path, recipe="o2o_halfcheetah")
    assert code == 1 and errors.startswith("error: ") and "Traceback" not in errors
