"""Trained policies in use: of runs that the real recipe wrote, in a process without a recipe."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

import online_mujoco
from agents import AGENTS
from recipe_cases import ROOT, TINY_SIZES, composed, rows_of
from torchrl_aca import make_aca_actor
from torchrl_aca.errors import RunError
from torchrl_aca.training import load_policy
from torchrl_aca.training.evaluation import evaluate, make_eval_env
from torchrl_aca.training.policy import PolicyBuilder, read_policy, save_policy
from torchrl_aca.training.resume import resumed_config

RUN = [
    "env=reacher",
    "num_threads=1",
    "collector.warmup_frames=250",
    "optim.batch_size=8",
    "optim.total_updates=9",
    "checkpoint.interval=3",
    "eval.interval=3",
    "eval.episodes=2",
]
# Settings that no state holds: a policy without them acts otherwise.
SETTINGS = {
    "aca": ["aca.schedule=linear", "aca.inference_levels=[1,3]", "aca.first_level=0"],
    "qsm_authors": ["variant=qsm_authors"],
    "rlpd_wsrl": ["variant=wsrl"],
}
METHODS = {**{name: name for name in AGENTS}, "qsm_authors": "qsm", "rlpd_wsrl": "rlpd"}
MODES = {"deterministic": ExplorationType.DETERMINISTIC, "random": ExplorationType.RANDOM}
OBSERVATIONS = torch.randn(5, 11, generator=torch.Generator().manual_seed(3))

# Hides the extras from the import system, as if they had never been installed.
FRESH = f"""
import sys
from importlib.machinery import PathFinder

EXTRAS = ("gymnasium", "mujoco", "hydra", "omegaconf", "pydantic", "filelock", "tqdm", "agents")
find_spec = PathFinder.find_spec
def find_installed(name, path=None, target=None):
    return None if name.partition(".")[0] in EXTRAS else find_spec(name, path, target)
PathFinder.find_spec = find_installed

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl_aca.training import load_policy

observations, found = torch.load("observations.pt"), {{}}
for name in {sorted(METHODS)}:
    policy = load_policy(name)
    for mode in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        torch.manual_seed(0)
        with torch.no_grad(), set_exploration_type(mode):
            found[name, mode.name.lower()] = policy(observations)
torch.save(found, "found.pt")
"""


def actions(policy, mode: str) -> torch.Tensor:
    torch.manual_seed(0)
    data = TensorDict(observation=OBSERVATIONS, batch_size=[5])
    with torch.no_grad(), set_exploration_type(MODES[mode]):
        return policy(data)["action"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder of tiny runs, and the actions of each agent when its training had ended."""
    folder, expected, agents = tmp_path_factory.mktemp("runs"), {}, []
    make_agent = online_mujoco.make_agent
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            online_mujoco, "make_agent", lambda *args: agents.append(make_agent(*args)) or agents[0]
        )
        for name, algo in METHODS.items():
            agents.clear()
            sizes = [*TINY_SIZES[algo], *SETTINGS.get(name, [])]
            online_mujoco.train(composed(f"algo={algo}", *RUN, *sizes, f"run_dir={folder / name}"))
            for mode in MODES:
                expected[name, mode] = actions(agents[0].policy, mode)
    return folder, expected


@pytest.fixture(scope="module")
def elsewhere(runs):
    """The actions of the loaded policies in a process with no simulator and no recipe."""
    folder, _ = runs
    torch.save(OBSERVATIONS, folder / "observations.pt")
    call = [sys.executable, "-c", FRESH]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return torch.load(folder / "found.pt")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", METHODS)
def test_its_actions_are_those_of_the_agent_that_was_trained(name, mode, runs, elsewhere):
    assert torch.equal(elsewhere[name, mode], runs[1][name, mode])


@pytest.mark.parametrize("name", METHODS)
def test_its_deterministic_acting_can_be_exported(name, runs):
    policy = load_policy(runs[0] / name)
    policy.deterministic_draws = "fixed"  # of the chains; a Gaussian has none
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        exported = torch.export.export(policy, (OBSERVATIONS,)).module()
        torch.testing.assert_close(exported(OBSERVATIONS), policy(OBSERVATIONS))


def test_its_evaluation_is_that_of_the_run(runs):
    run_dir = runs[0] / "aca"
    cfg = composed("algo=aca", *RUN)
    env = make_eval_env("Reacher-v4", online_mujoco.configured(cfg).eval)
    got = evaluate(load_policy(run_dir), env, cfg.eval.seed, torch.device("cpu"))
    assert got["return_mean"] == float(rows_of(run_dir / "eval.csv")[-1]["return_mean"])


def test_the_policies_are_kept_with_their_checkpoints_and_the_best_one_by_evaluation(runs):
    run_dir = runs[0] / "sac"
    names = sorted(path.name for path in (run_dir / "checkpoints").iterdir())
    numbered = [f"{kind}_000000000{n}.pt" for kind in ("checkpoint", "policy") for n in (6, 9)]
    assert names == [*numbered, "policy_best.pt"]
    best = max(rows_of(run_dir / "eval.csv"), key=lambda row: float(row["return_mean"]))
    told = read_policy(run_dir, "best")
    assert told["updates"] == int(best["updates"])
    assert told["evaluation"]["return_mean"] == float(best["return_mean"])
    assert read_policy(run_dir, 6)["updates"] == 6 and read_policy(run_dir)["updates"] == 9
    earlier, newest = (actions(load_policy(run_dir, n), "deterministic") for n in (6, None))
    assert not torch.equal(earlier, newest)


def test_a_resumed_run_keeps_a_best_policy_that_is_not_beaten(tmp_path):
    settings = ["algo=sac", *RUN, *TINY_SIZES["sac"]]
    run_dir = online_mujoco.train(composed(*settings, f"run_dir={tmp_path / 'run'}"))
    path = run_dir / "checkpoints" / "policy_best.pt"
    content = torch.load(path, weights_only=True)
    for value, kept in ((0.0, True), (-1e9, False)):  # Reacher's returns are below 0
        content["evaluation"]["return_mean"] = value
        torch.save(content, path)
        total = 12 if kept else 15
        typed = [f"resume={run_dir}", f"optim.total_updates={total}"]
        online_mujoco.train(*resumed_config(composed("algo=sac", *typed), typed))
        assert (read_policy(run_dir, "best")["evaluation"]["return_mean"] == value) is kept


def test_keep_best_can_be_left_out(tmp_path):
    settings = [*RUN, *TINY_SIZES["sac"], "checkpoint.keep_best=false"]
    run_dir = online_mujoco.train(composed("algo=sac", *settings, f"run_dir={tmp_path / 'run'}"))
    with pytest.raises(RunError, match=r"one of \[6, 9\], got 'best'"):
        load_policy(run_dir, "best")


# --- bad input ------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path):
    """Changes what stands in the file of a small policy, and loads it."""
    spec = Bounded(-2.0, 2.0, shape=(2,))
    builder = PolicyBuilder(make_aca_actor, 3, spec, {"num_cells": [8], "num_steps": 3})
    path = tmp_path / "checkpoints" / "policy_0000000007.pt"
    save_policy(path, builder, builder.build(), {"seed": 0}, 7)

    def load(**changes):
        content = {**torch.load(path, weights_only=True), **changes}
        torch.save(content, path)
        return load_policy(tmp_path)

    return load


def test_a_file_names_public_factories_of_the_package_alone(saved):
    assert saved().num_candidates == 32
    for name in ("os.system", "builtins.eval", "torchrl_aca.training.files.replace_file"):
        with pytest.raises(RunError, match=f"built by {name!r}; expected a public factory"):
            saved(factory=name)
    with pytest.raises(ValueError, match="Leave policy_builder out"):
        PolicyBuilder(torch.nn.Linear, 3, Bounded(-1, 1, shape=(2,)), {})


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"format": "torchrl-aca policy 0"},
            "expected 'torchrl-aca policy 1', got",
        ),
        ({"settings": None}, "has no settings: expected a dict, got NoneType"),
        ({"settings": {"num_cells": [9], "num_steps": 3}}, "cannot be built with .*size mismatch"),
        ({"settings": {"wrong": 1}}, "cannot be built with .*unexpected keyword argument 'wrong'"),
        ({"weights": {}}, "cannot be built with .*Missing key"),
    ],
)
def test_a_file_that_does_not_fit_is_told(changes, told, saved):
    with pytest.raises(RunError, match=f"(?s){told}"):
        saved(**changes)


def test_a_policy_that_is_not_there_or_damaged_is_told(tmp_path, saved):
    saved()
    with pytest.raises(RunError, match=r"expected checkpoint to be one of \[7\], got 8"):
        load_policy(tmp_path, 8)
    with pytest.raises(RunError, match="expected a run directory with checkpoints/policy"):
        load_policy(tmp_path / "nowhere")
    path = tmp_path / "checkpoints" / "policy_0000000007.pt"
    path.write_bytes(path.read_bytes()[:-900])
    with pytest.raises(RunError, match="cannot be read .*damaged or foreign"):
        load_policy(tmp_path)
