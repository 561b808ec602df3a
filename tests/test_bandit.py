"""The 2D bandit: its reward, the counting of its modes, and what the study promises."""

from __future__ import annotations

import csv
import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torchrl.envs.utils import check_env_specs

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"
METHODS = ("aca", "diffusion_q", "langevin_q")
HIGH = np.sqrt(2) * np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])  # top, right, bottom, left
SMALL = [
    "critic.num_cells=[64,64,64]",
    "collector.frames=20000",
    "collector.init_random_frames=10000",
    "sweep.weights=[30,40]",
    "sweep.num_samples=500",
    "report.num_samples=1000",
]
TINY = [
    "seeds=[0]",
    "num_workers=1",
    "collector.frames=200",
    "collector.init_random_frames=100",
    "collector.frames_per_batch=100",
    "optim.updates_per_batch=2",
    "optim.batch_size=16",
    "critic.num_cells=[8]",
    "sweep.weights=[10,40]",
    "sweep.num_samples=50",
    "report.num_samples=50",
]


@pytest.fixture(scope="module", autouse=True)
def import_recipes():
    sys.path.insert(0, str(RECIPES))
    yield
    sys.path.remove(str(RECIPES))


def composed(*overrides: str, name: str = "bandit_2d"):
    with initialize_config_dir(str(RECIPES / "configs"), version_base="1.3"):
        return compose(name, overrides=list(overrides))


def start(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(RECIPES / "bandit_2d.py"), *arguments]
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120
    )


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


# --- the environment ------------------------------------------------------------------------------


def oracle_density(actions):
    """The paper's mixture as a density, mode by mode in the order of its appendix."""
    r = np.sqrt(2)
    centres = [(r, 0), (1, 1), (0, r), (-1, 1), (-r, 0), (-1, -1), (0, -r), (1, -1)]
    total = 0.0
    for index, centre in enumerate(centres):
        squares = ((actions - np.array(centre)) ** 2).sum(-1)
        weight = (2 if index % 2 == 0 else 1) / 12
        total += weight * np.exp(-squares / (2 * 0.09)) / (2 * np.pi * 0.09)
    return total


def test_reward_is_the_mixtures_density_scaled_to_one():
    from bandit.env import TwoDBandit

    actions = np.random.default_rng(0).uniform(-2.5, 2.5, (500, 2))
    line = np.linspace(-1.5, 1.5, 1501)
    highest = oracle_density(np.stack(np.meshgrid(line, line), -1)).max()
    env = TwoDBandit(500)
    data = env.reset().set("action", torch.from_numpy(actions).float())
    actual = env.step(data)["next", "reward"].squeeze(-1).numpy()
    np.testing.assert_allclose(actual, oracle_density(actions) / highest, atol=1e-5)


def test_highest_reward_is_one_and_the_low_modes_have_half():
    from bandit.env import reward

    line = torch.linspace(-2, 2, 1001)
    assert reward(torch.cartesian_prod(line, line)).max().item() == pytest.approx(1, abs=1e-4)
    assert reward(torch.tensor([1.0, 1.0])).item() == pytest.approx(0.502, abs=1e-3)


@pytest.mark.parametrize("num_envs", [1, 7])
def test_env_keeps_its_specs_and_ends_after_one_step(num_envs):
    from bandit.env import TwoDBandit

    env = TwoDBandit(num_envs, half_width=2.5)
    check_env_specs(env)
    rollout = env.rollout(5)
    assert rollout.shape == (num_envs, 1)
    assert rollout["next", "terminated"].all()
    assert env.rand_action()["action"].abs().max() <= 2.5


def test_shares_count_what_lies_within_the_radius_in_the_papers_order():
    from bandit.env import mode_shares

    near = HIGH + np.array([0.29, 0.0])
    far = HIGH + np.array([0.0, 0.31])
    actions = np.concatenate([near[:1], near[:1], near[1:], far, [[1, 1]]])  # 2, 1, 1, 1 of 10
    shares = mode_shares(torch.from_numpy(actions).float())
    assert list(shares) == ["top", "right", "bottom", "left"]
    assert list(shares.values()) == pytest.approx([0.2, 0.1, 0.1, 0.1])


# --- the study ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_aca_finds_all_high_modes_with_more_samples_than_the_plain_critic():
    from bandit_2d import run

    cfg = composed(*SMALL)
    noisy, plain = (run((cfg, method, 0))[0][0] for method in ("aca", "diffusion_q"))
    assert min(noisy[name] for name in ("top", "right", "bottom", "left")) > 0.15
    assert noisy["sum"] > plain["sum"] + 0.05


def test_weight_is_chosen_by_reward_alone(monkeypatch):
    import bandit_2d

    measured = iter([{"sum": 0.9, "reward_mean": 0.1}, {"sum": 0.1, "reward_mean": 0.9}])
    monkeypatch.setattr(bandit_2d, "measure", lambda actions: next(measured))
    cfg = composed(*TINY)
    actor = bandit_2d.make_actor(cfg, "aca")
    bandit_2d.sweep(cfg, actor)
    assert actor.guidance_weight == 40


@pytest.mark.parametrize("data", ["uniform", "online"])
def test_data_comes_from_the_box_or_from_the_method_as_well(data, monkeypatch):
    import bandit_2d

    seen = []
    transitions = bandit_2d.transitions
    monkeypatch.setattr(
        bandit_2d, "transitions", lambda data: seen.append(data["action"]) or transitions(data)
    )
    bandit_2d.train(composed(*TINY, f"data={data}"), "langevin_q", 0)
    outside = [bool((actions.abs() > 2).any()) for actions in seen]
    assert outside == [False, data == "online"]


def test_command_writes_all_its_files(tmp_path):
    result = start(*TINY, "run_dir=run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    figures = {"reward.png", "samples.png", "sensitivity.png", "value_maps.png", "steps.gif"}
    figures |= {f"steps_{method}.png" for method in METHODS}
    tables = {"table.csv", "seeds.csv", "sweep.csv", "config.yaml", "card.md"}
    assert {path.name for path in (tmp_path / "run").iterdir()} == figures | tables
    table = rows(tmp_path / "run" / "table.csv")
    assert [row["source"] for row in table] == ["here, 1 seeds", "paper"] * 3
    assert [row["sum"] for row in table[1::2]] == ["0.993", "0.636", "0.570"]
    assert len(rows(tmp_path / "run" / "sweep.csv")) == 2 * len(METHODS)
    assert "ACA" in result.stdout and "3/3" in result.stderr


def test_ablation_has_a_row_for_each_combination(tmp_path):
    import bandit_2d

    changes = ["methods=[aca]", "ablation.training.data=[uniform,online]"]
    bandit_2d.ablate(composed(*TINY, *changes, name="bandit_2d_ablation"), tmp_path)
    table = rows(tmp_path / "ablation.csv")
    keys = ("chain.schedule", "data", "clip_denoised", "normalize_gradient")
    values = [("linear", "cosine"), ("uniform", "online"), ("False", "2.0"), ("True", "False")]
    expected = list(itertools.product(*values))
    assert [tuple(row[key] for key in keys) for row in table] == expected
    compact = rows(tmp_path / "ablation_table.csv")
    assert [tuple(row[key] for key in keys) for row in compact] == expected
    assert [float(row["ACA sum"]) for row in compact] == [
        pytest.approx(float(row["sum"]), abs=1e-3) for row in table
    ]


def test_ablation_config_composes_and_its_values_are_valid():
    import bandit_2d

    cfg = composed(name="bandit_2d_ablation")
    for changed in bandit_2d.combinations(cfg.ablation.training):
        for key, value in changed.items():
            OmegaConf.update(cfg, key, value)
        bandit_2d.validate(cfg)
        actor = bandit_2d.make_actor(cfg, "aca")
    assert all(hasattr(actor, name) for name in cfg.ablation.sampling)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data=offline", "data=offline: expected uniform or online"),
        ("chain.schedule=quadratic", "chain.schedule=quadratic: expected one of"),
        ("methods=[sac]", "expected some of"),
        ("seeds=[]", "expected at least one seed"),
        ("collector.frames=30001", "expected a multiple of frames_per_batch, 500"),
    ],
)
def test_wrong_settings_are_told_before_any_work(override, message):
    import bandit_2d

    with pytest.raises(bandit_2d.RunError, match=message.replace("[", r"\[")):
        bandit_2d.validate(composed(override))
