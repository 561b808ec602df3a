"""The command that evaluates and films the policies of finished runs."""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from evaluate import EvaluateConfig, evaluate_runs, summary
from film import animate
from online_mujoco import train
from recipe_cases import TINY_SIZES, composed, rows_of, run
from test_policy import RUN
from torchrl_aca.errors import RunError
from torchrl_aca.training.config import checked


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> list[Path]:
    """A run of ACA on Reacher, and one of SAC on HalfCheetah with short evaluations."""
    folder = tmp_path_factory.mktemp("runs")
    aca = composed("algo=aca", *RUN, *TINY_SIZES["aca"], f"run_dir={folder / 'aca'}")
    cheetah = ["env=halfcheetah", "eval.max_steps=5"]
    sac = composed("algo=sac", *RUN, *cheetah, *TINY_SIZES["sac"], f"run_dir={folder / 'sac'}")
    return [train(aca), train(sac)]


def evaluated(*overrides: str) -> list[dict[str, object]]:
    return evaluate_runs(checked(EvaluateConfig, composed(*overrides, name="evaluate")))


def test_the_summary_by_hand():
    result = {"return_mean": 1.0, "return_std": 2.0, "num_episodes": 5.0, "episode_length": 7.0}
    row = summary(result, (-1.0, 3.0), seed=5)
    assert row["standard_error"] == 1.0  # 2 / sqrt(5 - 1)
    assert (row["interval_low"], row["interval_high"]) == pytest.approx((-0.96, 2.96))
    assert row["normalized_score"] == 50.0  # half-way from -1 to 3
    assert (row["episodes"], row["seed"], row["episode_length"]) == (5, 5, 7.0)
    assert summary(result, None, seed=5)["normalized_score"] == ""


def test_many_runs_get_a_row_each_and_later_rows_follow(runs, capsys):
    aca, sac = runs
    both = f"run=[{aca},{sac}]"
    rows = evaluated(both, "episodes=3", "random=true")
    assert [row["checkpoint"] for row in rows] == ["9", "random"] * 2
    assert rows[3]["episode_length"] == 5  # the run's own cut
    # D4RL's reference returns, -280.178953 and 12135, are known for HalfCheetah alone.
    assert rows[0]["normalized_score"] == ""
    score = 100 * (rows[2]["return_mean"] + 280.178953) / (12135.0 + 280.178953)
    assert rows[2]["normalized_score"] == pytest.approx(score)
    printed = capsys.readouterr().out
    assert f"{aca}, 9 updates: return {rows[0]['return_mean']:.1f} ± " in printed
    assert f"{sac}, random actions: return " in printed
    evaluated(f"run={aca}", "episodes=2", "checkpoint=6", "max_steps=4")
    evaluated(f"run={aca}", "episodes=2", "checkpoint=best")
    table = rows_of(aca / "evaluations.csv")
    assert [row["checkpoint"] for row in table] == ["9", "random", "6", "best"]
    assert [row["episodes"] for row in table] == ["3", "3", "2", "2"]
    assert table[2]["updates"] == "6" and table[2]["episode_length"] == "4.0"
    assert float(table[0]["return_mean"]) == rows[0]["return_mean"]


def test_the_seeds_of_the_run_give_its_own_evaluation_again(runs):
    (row,) = evaluated(f"run={runs[0]}", "episodes=2", "seed=10000")
    assert row["return_mean"] == float(rows_of(runs[0] / "eval.csv")[-1]["return_mean"])


def test_a_finished_run_is_filmed_after_rendering_has_failed_once(runs, monkeypatch, capsys):
    made = []

    class Writer:
        @staticmethod
        def mimwrite(path, images, **how):
            made.append((path.name, len(images)))

    monkeypatch.setattr("gymnasium.envs.mujoco.MujocoEnv.render", lambda self: torch.zeros(2, 2, 3))
    monkeypatch.setitem(sys.modules, "imageio", None)
    with pytest.raises(RunError, match="video could not be rendered .* recipes/evaluate.py"):
        evaluated(f"run={runs[0]}", "episodes=2", "video=true")
    rows = len(rows_of(runs[0] / "evaluations.csv"))  # the numbers are not lost with the film
    monkeypatch.setitem(sys.modules, "imageio", Writer)
    evaluated(f"run={runs[0]}", "episodes=2", "video=true", "checkpoint=best")
    assert made == [("video_best.mp4", 51)]  # an episode of Reacher has 50 steps
    assert len(rows_of(runs[0] / "evaluations.csv")) == rows + 1
    assert "video: " in capsys.readouterr().out
    evaluated(f"run={runs[0]}", "episodes=2", "video=true", "max_steps=4")
    assert made[1:] == [("video_9.mp4", 5)]


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("seed=1", r"seed=1: expected 2 seeds apart from the training's 0 to 4"),
        ("checkpoint=7", r"expected checkpoint to be one of \[6, 9, 'best'\], got 7"),
        ("checkpoint=newest", r"one of \[6, 9, 'best'\], got 'newest'"),
        ("episodes=1", "episodes=1: expected greater than or equal to 2"),
        ("device=gpu", "device='gpu': expected"),
    ],
)
def test_a_mistake_is_told(override, told, runs):
    with pytest.raises(RunError, match=told):
        evaluated(f"run={runs[0]}", "episodes=2", override)


def test_the_command_says_what_is_missing(tmp_path):
    code, _, errors = run(f"run={tmp_path}", cwd=tmp_path, recipe="evaluate")
    assert code == 1 and "Traceback" not in errors
    assert "error: " in errors and "checkpoints/policy_*.pt, found none" in errors
    code, _, errors = run(cwd=tmp_path, recipe="evaluate")
    assert code == 1 and "error: run=???: expected a value" in errors


def test_an_animation_is_the_beginning_of_a_film_made_small(tmp_path):
    film, output = tmp_path / "film.mp4", tmp_path / "pages" / "film.gif"
    images = np.zeros((40, 64, 96, 3), dtype=np.uint8)
    images[:, :, :, 0] = 6 * np.arange(40)[:, None, None]  # it grows red
    imageio.imwrite(film, images, fps=20, macro_block_size=1)
    animate(film, output, seconds=1.0, width=48)
    with Image.open(output) as gif:
        assert gif.size == (48, 32) and gif.n_frames == 10 and gif.info["duration"] == 100
        gif.seek(9)
        red = np.asarray(gif.convert("RGB"))[..., 0].mean()
    assert abs(red - 6 * 18) < 12
