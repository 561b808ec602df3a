"""Promises of results/report.py: statistics by hand, the same report from runs and from its CSV."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

np = pytest.importorskip("numpy")
pytest.importorskip("scipy")

import evaluations  # noqa: E402
import intervals  # noqa: E402

SCRIPT = Path(evaluations.__file__).with_name("report.py")


def test_statistics_by_hand():
    one, two = np.array([1.0, 9.0]), np.array([3.0, 4.0, 100.0, -100.0, 5.0, 0.0])
    # in order: -100 0 | 1 3 4 5 | 9 100
    assert intervals.interquartile_mean(one, two) == (1 + 3 + 4 + 5) / 4
    assert intervals.mean(one, two) == 22 / 8
    assert intervals.share_above(4.0)(one, two) == 3 / 8  # 9, 100, 5
    # first task: of the pairs (1, 1) (1, 2) (3, 1) (3, 2) one is equal, two are better: 2.5 / 4
    x, y = [np.array([1.0, 3.0]), np.array([5.0])], [np.array([1.0, 2.0]), np.array([6.0])]
    assert intervals.probability_of_improvement(*x, *y) == (2.5 / 4 + 0) / 2
    assert intervals.probability_of_improvement(*y, *x) == (1.5 / 4 + 1) / 2


def test_statistics_take_resamples_along_other_axes():
    rng = np.random.default_rng(0)
    tasks = [rng.normal(size=(7, 3)), rng.normal(size=(7, 5))]
    for statistic in (intervals.mean, intervals.interquartile_mean, intervals.share_above(0.1)):
        rows = [statistic(*(task[i] for task in tasks)) for i in range(7)]
        assert np.allclose(statistic(*tasks), rows)
    pairs = [rng.normal(size=(7, n)) for n in (3, 4, 2, 5)]
    improvement = intervals.probability_of_improvement
    assert np.allclose(improvement(*pairs), [improvement(*(p[i] for p in pairs)) for i in range(7)])


def test_intervals_are_stratified_and_need_two_runs():
    far = [np.array([0.0, 1.0]), np.array([1000.0, 1001.0])]
    # each task keeps its two runs, so the mean stays within half of [500, 501]
    assert intervals.interval(intervals.mean, far) == (500.0, 501.0)
    same = [np.full(5, 3.0)]
    assert intervals.interval(intervals.share_above(2.0), same) == (1.0, 1.0)
    assert intervals.interval(intervals.mean, [np.array([1.0]), np.array([1.0, 2.0])]) is None


def write_run(folder: Path, method: str, seed: int, returns: dict[int, float], task="Hopper-v4"):
    run_dir = folder / f"{task}-{method}-s{seed}"
    run_dir.mkdir(parents=True)
    config = {"env": {"name": task}, "algo": {"name": "aca"}, "seed": seed}
    OmegaConf.save(config, run_dir / "config.yaml")
    with open(run_dir / "eval.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["updates", "frames", "return_mean", "return_std", "num_episodes"])
        writer.writerows([u, 5 * u, value, 1.0, 10] for u, value in returns.items())
    (run_dir / "metrics.csv").write_text("updates,updates_per_second\n1,2.0\n2,4.0\n3,3.0\n")


@pytest.fixture
def study(tmp_path) -> Path:
    folder = tmp_path / "study"
    for seed in (0, 1):
        write_run(folder, "aca", seed, {0: 10, 100000: 2000 + 200 * seed})
        write_run(folder, "narrow", seed, {0: 10, 50000: 400, 100000: 1000 + 20 * seed})
    write_run(folder, "narrow", 2, {0: 10})  # has not begun
    spec = {"name": "study", "tasks": {"Hopper-v4": []}, "methods": {"aca": [], "narrow": []}}
    OmegaConf.save(spec, folder / "study.yaml")
    return folder


def test_a_report_has_the_paper_beside_and_its_csv_makes_it_again(study, tmp_path):
    for source, out in ((study, "a"), (tmp_path / "a" / "evaluations.csv", "b")):
        call = [sys.executable, str(SCRIPT), str(source), str(tmp_path / out)]
        printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
        assert "| Hopper-v4, 100,000 updates | 2100 [2000, 2200] (n=2) | 1010 [" in printed
        assert "| *paper* | 2960 ± 312 |  |" in printed
        assert "| aca | 1.00 [0.95, 1.05] | 1.00 [0.95, 1.05] | 3.00 |" in printed
    names = {"evaluations.csv", "card.md", "curves.png", "aggregate.png", "profiles.png"}
    assert {path.name for path in (tmp_path / "a").iterdir()} == {*names, "improvement.png"}
    first, second = ((tmp_path / out / "evaluations.csv").read_text() for out in "ab")
    assert [line.split(",")[:2] for line in first.splitlines()] == [
        line.split(",")[:2] for line in second.splitlines()
    ]
    assert len(first.splitlines()) == 1 + 2 * 2 + 2 * 3


def test_scores_are_on_the_scale_of_their_task(study):
    tasks, found = evaluations.scores(evaluations.read_runs(study), None)
    assert tasks == ["Hopper-v4"]
    assert np.allclose(found["aca"][0], [1990 / 2090, 2190 / 2090])
    assert np.allclose(found["narrow"][0], [990 / 2090, 1010 / 2090])


def test_a_task_on_which_nothing_was_learned_has_no_scale(study):
    for method in ("aca", "narrow"):
        write_run(study, method, 0, {0: 5, 100000: 4}, task="Ant-v4")
    tasks, _ = evaluations.scores(evaluations.read_runs(study), None)
    assert tasks == ["Hopper-v4"]


def test_a_folder_without_runs_is_told(tmp_path):
    with pytest.raises(SystemExit, match="expected directories of runs that have begun"):
        evaluations.read_runs(tmp_path)
