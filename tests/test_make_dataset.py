"""The generator of data sets, run as users run it, with tiny sizes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from agents import without_methods
from data.generate import GeneratorConfig, make_dataset
from recipe_cases import CONFIGS, rows_of, run, start
from torchrl_aca.errors import DatasetError, RunError
from torchrl_aca.offline import OfflineDataset
from torchrl_aca.training import load_policy
from torchrl_aca.training.checkpoint import read_checkpoint
from torchrl_aca.training.config import checked
from torchrl_aca.training.envs import make_env

SAC = [
    "sac.num_cells=[16,16]",
    "collector.warmup_frames=100",
    "optim.batch_size=16",
    "optim.total_updates=40",
    "eval.interval=20",
    "eval.episodes=2",
    "eval.stop_return=null",
    "logger.interval=10",
]
KEYS = [
    "observation",
    "action",
    "next.observation",
    "next.reward",
    "next.done",
    "next.terminated",
]


def configured(tier: str, cwd: Path, *overrides: str, sac: list[str] = SAC) -> list[str]:
    """Overrides that keep everything below `cwd`."""
    return [
        f"tier={tier}",
        "env=hopper",
        "episodes=5",
        f"path={cwd / tier}",
        f"sac.run_dir={cwd / 'sac'}",
        f"sac.overrides=[{','.join(map(repr, sac))}]",
        *overrides,
    ]


def made(*overrides: str) -> OfflineDataset:
    """The generator without a process of its own; only a SAC run has one."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        cfg = without_methods(compose("make_dataset", overrides), GeneratorConfig.model_fields)
        return make_dataset(checked(GeneratorConfig, cfg))


def generate(tier: str, cwd: Path, *overrides: str, sac: list[str] = SAC) -> OfflineDataset:
    dataset = made(*configured(tier, cwd, *overrides, sac=sac))
    return OfflineDataset.load(dataset.path, verify=True)


def columns(dataset: OfflineDataset) -> dict[str, torch.Tensor]:
    return dict(dataset.data.flatten_keys(".").items())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where both tiers of one SAC run were generated."""
    cwd = tmp_path_factory.mktemp("generated")
    generate("medium_replay", cwd)
    generate("medium", cwd)
    return cwd


# --- random ---------------------------------------------------------------------------------------


def test_random_halfcheetah_has_the_returns_that_d4rl_found(tmp_path):
    code, output, errors = run(
        "tier=random", "env=halfcheetah", "episodes=6", "check=false",
        cwd=tmp_path, recipe="make_dataset",
    )  # fmt: skip
    assert code == 0, errors
    dataset = OfflineDataset.load(tmp_path / "datasets" / "halfcheetah-random", verify=True)
    assert "6000 transitions in 6 episodes" in output
    # D4RL's random episodes have a mean of -280.2, and the mean of six of them varies by 30.
    assert -450 < dataset.episode_returns().mean() < -120
    action = dataset.data["action"].double()
    assert torch.allclose(action.mean(0), torch.zeros(6).double(), atol=0.05)
    assert torch.allclose(action.std(0), torch.full((6,), 3**-0.5).double(), atol=0.02)
    env = make_env("HalfCheetah-v4")
    for episode in range(6):
        expected, _ = env.reset(seed=1_000_000 + episode)
        np.testing.assert_array_equal(dataset.data["observation"][1000 * episode], expected)
    assert dataset.data["next", "truncated"].sum() == 6
    assert not dataset.data["next", "terminated"].any()


def test_metadata_say_where_the_data_come_from(tmp_path):
    metadata = generate("random", tmp_path).metadata
    assert metadata["name"] == "hopper random (D4RL-style, locally generated)"
    assert (metadata["env_id"], metadata["episodes"]) == ("Hopper-v4", 5)
    provenance = metadata["provenance"]
    assert provenance["command"].startswith("python ")
    assert provenance["versions"]["torch"] == torch.__version__
    assert provenance["config"]["seed"] == 1_000_000 and "sac" not in provenance
    assert (tmp_path / "random" / "returns.png").stat().st_size > 1000


def test_the_same_seed_gives_the_same_data(tmp_path):
    sums = [
        generate("random", tmp_path / name, f"seed={seed}").metadata["sha256"]
        for name, seed in (("first", 3), ("second", 3), ("third", 4))
    ]
    assert sums[0] == sums[1] != sums[2]


# --- a SAC run's data -----------------------------------------------------------------------------


def test_medium_replay_is_the_buffer_of_the_run_row_by_row(folder):
    dataset = OfflineDataset.load(folder / "medium_replay")
    parts = read_checkpoint(folder / "sac")["parts"]
    rows = parts["buffer"]["rows"]
    assert len(dataset.data) == parts["collection"]["frames"] == 140
    done = rows["next.done"].flatten()
    for key in KEYS:
        expected = rows[key].clone()
        if key == "next.done":
            expected[-1] = True  # where the run stopped
        assert torch.equal(columns(dataset)[key], expected), key
    assert dataset.metadata["episodes"] == int(done[:-1].sum()) + 1
    cut = [] if done[-1] else [int(done.sum())]
    assert dataset.metadata["incomplete_episodes"] == cut
    history = dataset.metadata["provenance"]["sac"]["evaluations"]
    assert [row["updates"] for row in history] == [0, 20, 40]


def test_medium_samples_the_policy_that_the_run_ended_with(folder):
    dataset = OfflineDataset.load(folder / "medium")
    run_dir = folder / "sac"
    policy = load_policy(run_dir)
    with torch.no_grad():
        dist = policy.get_dist(dataset.data.select("observation"))
    loc, scale = dist.base_dist.base_dist.loc, dist.base_dist.base_dist.scale
    action = dataset.data["action"]
    inside = action.abs() < 0.9999  # further out, float32 forgets how far it was
    noise = ((torch.atanh(action) - loc) / scale)[inside].double()
    assert inside.double().mean() > 0.95
    assert abs(noise.mean()) < 0.2 and 0.8 < noise.std() < 1.2
    assert dataset.metadata["episodes"] == 5
    env = make_env("Hopper-v4")
    starts = torch.unique_consecutive(dataset.data["episode"], return_counts=True)[1].cumsum(0)
    for episode, row in enumerate([0, *starts[:-1].tolist()]):
        expected, _ = env.reset(seed=1_000_000 + episode)
        np.testing.assert_array_equal(dataset.data["observation"][row], expected)


def test_a_finished_run_is_used_again_and_one_of_another_seed_is_refused(folder):
    trained = (folder / "sac" / "metrics.csv").stat().st_mtime_ns
    again = generate("medium", folder, f"path={folder / 'again'}")
    assert (folder / "sac" / "metrics.csv").stat().st_mtime_ns == trained
    assert again.metadata["sha256"] == OfflineDataset.load(folder / "medium").metadata["sha256"]
    with pytest.raises(RunError, match="seed=7, but the run to resume has seed=100"):
        generate("medium", folder, f"path={folder / 'other'}", "sac.seed=7")
    fewer = [override for override in SAC if not override.startswith("sac.num_cells")]
    with pytest.raises(RunError, match="num_cells=.*but the run to resume has"):
        generate("medium", folder, f"path={folder / 'other'}", sac=fewer)


def test_a_mistyped_override_of_the_run_is_told_in_one_message(tmp_path):
    with pytest.raises(RunError, match="^sac.overrides: .*optim.update"):
        generate("medium", tmp_path, sac=[*SAC, "optim.updates=5"])


def test_the_run_stops_when_two_evaluations_have_averaged_the_return(tmp_path):
    dataset = generate("medium_replay", tmp_path, sac=[*SAC, "eval.stop_return=-1000"])
    evaluated = rows_of(tmp_path / "sac" / "eval.csv")
    assert [row["updates"] for row in evaluated] == ["0", "20"]
    assert len(dataset.data) == 100 + 20
    generate("medium", tmp_path)  # asks for the whole run, so it goes on
    evaluated = rows_of(tmp_path / "sac" / "eval.csv")
    assert [row["updates"] for row in evaluated] == ["0", "20", "40"]


def test_an_interrupted_run_goes_on_with_the_same_command(tmp_path):
    typed = configured("medium_replay", tmp_path, sac=[*SAC, "optim.total_updates=200000"])
    process = start(*typed, cwd=tmp_path, recipe="make_dataset")
    deadline = time.monotonic() + 100
    while not table_has_rows(tmp_path / "sac" / "metrics.csv"):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.endswith("stopped before its end, so no data set was made. The same command "
                           "goes on with it.\n")  # fmt: skip
    assert not (tmp_path / "medium_replay").exists()
    stopped = read_checkpoint(tmp_path / "sac")["parts"]["counters"]["updates"]
    assert 10 <= stopped < 200_000
    shorter = [*SAC, f"optim.total_updates={stopped + 5}"]
    resumed = generate("medium_replay", tmp_path, sac=shorter)
    assert len(resumed.data) == 100 + stopped + 5


def table_has_rows(path: Path) -> bool:
    return path.is_file() and len(rows_of(path)) > 0


def test_a_run_that_was_killed_after_its_last_evaluation_goes_on(folder, tmp_path):
    shutil.copytree(folder / "sac", tmp_path / "sac")
    generate("medium_replay", tmp_path, sac=[*SAC, "optim.total_updates=60"])
    (newest,) = (tmp_path / "sac" / "checkpoints").glob("checkpoint_*60.pt")
    newest.unlink()  # the table still says that 60 updates were made
    (tmp_path / "sac" / "done").unlink()
    (old,) = (folder / "sac" / "checkpoints").glob("checkpoint_*")
    shutil.copy(old, newest.parent)
    again = generate("medium", tmp_path, sac=[*SAC, "optim.total_updates=60"])
    assert newest.exists() and again.metadata["episodes"] == 5


def test_a_run_that_was_killed_before_its_first_checkpoint_starts_anew(folder, tmp_path):
    shutil.copytree(folder / "sac", tmp_path / "sac")
    shutil.rmtree(tmp_path / "sac" / "checkpoints")
    dataset = generate("medium_replay", tmp_path)
    whole = OfflineDataset.load(folder / "medium_replay")
    assert dataset.metadata["sha256"] == whole.metadata["sha256"]


def test_a_run_that_fails_is_told_and_leaves_no_data(tmp_path, capfd):
    with pytest.raises(RunError, match="the SAC run ended with status 1; see its message above"):
        generate("medium", tmp_path, sac=[*SAC, "optim.lr=abc"])
    assert "error: optim.lr='abc': expected a valid number" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_buffer_that_forgets_is_refused(tmp_path):
    with pytest.raises(RunError, match="120 of its 140 frames"):
        generate("medium_replay", tmp_path, sac=[*SAC, "buffer.capacity=120"])
    assert {path.name for path in tmp_path.iterdir()} == {"sac"}


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        (["tier=expert"], RunError, "tier='expert': expected 'random', 'medium' or 'medium_rep"),
        ([], RunError, "tier=.*: expected a value. Set it with tier="),
        (
            ["tier=random", "episodes=0"],
            RunError,
            "episodes=0: expected greater than or",
        ),
        (["tier=random", "episodes=abc"], RunError, "episodes='abc': expected a valid integer"),
        (["tier=random", "seed=-1"], RunError, "seed=-1: expected greater than or equal to 0"),
        (["tier=random", "seed=1.5"], RunError, "seed=1.5: expected a valid integer"),
        (["tier=random", "check=abc"], RunError, "check='abc': expected a valid boolean"),
        (["tier=random", "sac=null"], RunError, "sac=None: expected a section"),
        (["tier=random", "sac.overrides=x"], RunError, "sac.overrides='x': expected a valid list"),
        (["tier=random", "+speed=3"], RunError, "speed=3: there is no such key"),
        (
            ["tier=random", "+bands={{Hopper-v4:{{random:{{men:[1,2]}}}}}}"],
            RunError,
            "bands.Hopper-v4.random.men='men': expected 'mean', 'std', 'min' or 'max'",
        ),
        (["tier=random", "env.name=Nowhere-v0"], RunError, "Nowhere-v0.*cannot be made"),
        (["tier=random", "path={0}"], DatasetError, "exists already"),
        (
            ["tier=random", "+bands={{Hopper-v4:{{random:{{mean:[1000,null]}}}}}}"],
            DatasetError,
            r"the mean of the 5 returns is .*; expected 1000.0 to None",
        ),
    ],
)
def test_mistakes_leave_nothing(tmp_path, overrides, error, message):
    tiny = ["env=hopper", "episodes=5", f"path={tmp_path / 'here'}"]
    overrides = [override.format(tmp_path) for override in overrides]
    with pytest.raises(error, match=message):
        made(*tiny, *overrides)
    assert not list(tmp_path.iterdir())


def test_a_task_without_a_time_limit_is_refused(tmp_path, monkeypatch):
    entry = "gymnasium.envs.mujoco.hopper_v4:HopperEnv"
    monkeypatch.setitem(gym.registry, "Endless-v0", EnvSpec("Endless-v0", entry))
    with pytest.raises(DatasetError, match="Endless-v0 has no time limit"):
        generate("random", tmp_path, "env.name=Endless-v0")
    assert not list(tmp_path.iterdir())


def test_check_false_takes_what_the_bands_refuse(tmp_path):
    bands = "+bands={Hopper-v4:{random:{mean:[1000,null]}}}"
    tiny = ["tier=random", "env=hopper", "episodes=2", f"path={tmp_path / 'here'}", "check=false"]
    dataset = made(*tiny, bands)
    assert dataset.metadata["returns"]["mean"] < 1000


def test_bands_contain_what_d4rl_published():
    """The mean and spread of its HalfCheetah data, as its authors' files have them."""
    bands = OmegaConf.load(CONFIGS / "make_dataset.yaml").bands["HalfCheetah-v4"]
    published = {
        "random": {"mean": -288.8, "std": 80.4},
        "medium": {"mean": 4770.3, "std": 355.8},
        "medium_replay": {"min": -638, "max": 4985},
    }
    assert bands.keys() == published.keys()
    for tier, values in published.items():
        for name, (low, high) in bands[tier].items():
            assert low is None or low <= values[name]
            assert high is None or values[name] <= high


def test_a_mistake_ends_the_command_in_one_message(tmp_path):
    code, _, errors = run("tier=expert", cwd=tmp_path, recipe="make_dataset")
    assert code == 1 and errors.startswith("error: tier='expert'") and errors.count("\n") == 1


def test_metadata_are_json_that_others_can_read(folder):
    text = (folder / "medium" / "metadata.json").read_text()
    provenance = json.loads(text)["provenance"]
    assert provenance["sac"]["config"]["algo"]["name"] == "sac"
