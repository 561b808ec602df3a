"""Promises of results/report.py: statistics by hand, the same report from runs and from its CSV."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

np = pytest.importorskip("numpy")
pytest.importorskip("scipy")

import evaluations  # noqa: E402
import intervals  # noqa: E402
from torchrl_aca.training.files import write_csv  # noqa: E402

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
    metrics = "updates,seconds,updates_per_second\n1,60,2.0\n50000,120,4.0\n60000,180,3.0\n"
    (run_dir / "metrics.csv").write_text(metrics)
    versions = {"parameters": 475746, "commit": "0123456789abcdef"}
    (run_dir / "versions.json").write_text(json.dumps(versions))


def test_values_by_setting_are_of_the_last_evaluation_that_all_runs_have():
    runs = [
        ("Hopper-v4", "w5", 0, {0: 0, 10: 1, 20: 7}),
        ("Hopper-v4", "w5", 1, {0: 0, 10: 2}),
        ("Hopper-v4", "w50", 0, {0: 0, 10: 3}),
        ("Hopper-v4", "auto5", 0, {0: 0, 10: 4}),
        ("Hopper-v4", "soft", 0, {0: 0, 10: 5}),  # has no setting
        ("Reacher-v4", "w5", 0, {0: 0, 20: 9}),
    ]
    rows = [
        {"task": task, "method": method, "seed": seed, "updates": place, "return_mean": value}
        for task, method, seed, returns in runs
        for place, value in returns.items()
    ]
    found = evaluations.by_setting(rows, "Hopper-v4", r"(?P<line>w|auto)(?P<setting>\d+)")
    assert found == {"w": {5: [1, 2], 50: [3]}, "auto": {5: [4]}}


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
        assert "| aca | 1.00 [0.95, 1.05] | 1.00 [0.95, 1.05] | 3.00 | 475,746 |" in printed
        assert "| Hopper-v4 | aca | 1 | 100,000 | 500,000 | 2200 ± 1 | 3 | 0123456 |" in printed
    found = {path.name for path in (tmp_path / "a").iterdir()}
    names = {"evaluations.csv", "card.md", "curves.png", "aggregate.png", "profiles.png"}
    assert found == {*names, "improvement.png"}
    first, second = ((tmp_path / out / "evaluations.csv").read_text() for out in "ab")
    assert [line.split(",")[:2] for line in first.splitlines()] == [
        line.split(",")[:2] for line in second.splitlines()
    ]
    assert len(first.splitlines()) == 1 + 2 * 2 + 2 * 3


def test_runs_join_a_table_whose_own_are_gone(study, tmp_path):
    evaluations_csv = tmp_path / "out" / "evaluations.csv"
    call = [sys.executable, str(SCRIPT), str(study), str(evaluations_csv.parent)]
    subprocess.run(call, capture_output=True, check=True)
    new = tmp_path / "new"
    write_run(new, "aca", 1, {0: 10, 100000: 4000})  # instead of the old one
    write_run(new, "aca", 2, {0: 10, 100000: 3000})
    OmegaConf.save(OmegaConf.load(study / "study.yaml"), new / "study.yaml")
    rows = evaluations.read_studies([evaluations_csv, new])
    last = {key: run[-1]["return_mean"] for key, run in evaluations.by_run(rows).items()}
    old = evaluations.by_run(evaluations.read_study(study))
    assert last == {key: run[-1]["return_mean"] for key, run in old.items()} | {
        ("Hopper-v4", "aca", 1): 4000,
        ("Hopper-v4", "aca", 2): 3000,
    }
    call = [sys.executable, str(SCRIPT), str(evaluations_csv), str(new), str(tmp_path / "both")]
    printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert "| Hopper-v4, 100,000 updates | 3000 [2000, 4000] (n=3) |" in printed


def rows_of(study: Path) -> list[dict]:
    return evaluations.viewed(evaluations.read_study(study), "updates", "return_mean")


def test_an_offline_phase_is_below_zero_and_at_no_frame(tmp_path):
    study = tmp_path / "data"
    write_run(study, "iql", 0, {0: 0})
    spec = {"name": "data", "tasks": {"Hopper-v4": []}, "methods": {"iql": []}}
    OmegaConf.save(spec, study / "study.yaml")
    run_dir = study / "Hopper-v4-iql-s0"
    config = OmegaConf.load(run_dir / "config.yaml")
    config.optim = {"offline_updates": 40}
    OmegaConf.save(config, run_dir / "config.yaml")
    (run_dir / "eval.csv").write_text(
        "updates,frames,offline_updates,return_mean,return_std,num_episodes,normalized_score\n"
        "0,0,0,5,1,10,0.5\n0,0,40,50,1,10,5\n20,60,40,100,1,10,10\n"
    )
    (run_dir / "metrics.csv").write_text(
        "updates,offline_updates,seconds,updates_per_second\n0,40,8,5\n20,40,30,1\n"
    )
    rows = evaluations.read_study(study)
    assert [(row["updates"], row["seconds"]) for row in rows] == [(-40, 0.0), (0, 8.0), (20, 30.0)]
    with_own_phase = (run_dir / "eval.csv").read_text()
    (run_dir / "eval.csv").write_text(with_own_phase.replace("0,0,0,5,1,10,0.5\n", ""))
    rows = evaluations.read_study(study)  # as of a run that began with another one's phase
    assert [(row["updates"], row["seconds"]) for row in rows] == [(0, 8.0), (20, 30.0)]
    (run_dir / "eval.csv").write_text(with_own_phase.partition("0,0,40")[0] + "0,0,20,9,1,10,1\n")
    rows = evaluations.read_study(study)  # as of a run that is in the middle of the phase
    assert [row["updates"] for row in rows] == [-40, -20]
    (run_dir / "eval.csv").write_text(with_own_phase)
    options = ["--x", "frames", "--value", "normalized_score", "--at", "0", "60"]
    line = ["--line", "Hopper-v4:data=7.5"]
    call = [sys.executable, str(SCRIPT), str(study), str(tmp_path / "out"), *options, *line]
    printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert "Normalised score and 95 %" in printed
    assert "| Hopper-v4, 0 frames | 5.0 (n=1) |\n| Hopper-v4, 60 frames | 10.0 (n=1) |" in printed
    assert "| Hopper-v4 | iql | 0 | 40 + 20 | 60 | 100 ± 1 | 0 | 0123456 |" in printed


def test_places_stand_in_order_and_scores_are_of_the_one_given_last(study, tmp_path):
    args = [str(study), str(tmp_path / "out"), "--at", "100000", "0"]
    call = [sys.executable, str(SCRIPT), *args]
    printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert printed.index("| Hopper-v4, 0 updates") < printed.index("| Hopper-v4, 100,000 updates")
    assert evaluations.scores(rows_of(study), 0)[0] == [] and "interquartile" not in printed


def test_small_returns_have_a_decimal_in_the_list_of_runs(tmp_path):
    write_run(tmp_path / "runs", "aca", 0, {0: -11.34, 100: -9.96})
    call = [sys.executable, str(SCRIPT), str(tmp_path / "runs"), str(tmp_path / "out")]
    printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert "| Hopper-v4 | aca | 0 | 100 | 500 | -10.0 ± 1.0 | " in printed


def test_a_table_without_frames_or_spread_is_reported_without(tmp_path):
    table = tmp_path / "mine.csv"
    table.write_text("method,task,seed,updates,return_mean\naca,Ant-v4,0,0,1\naca,Ant-v4,0,5,900\n")
    call = [sys.executable, str(SCRIPT), str(table), str(tmp_path / "out")]
    printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert "| Ant-v4 | aca | 0 | 5 |  | 900 |  |  |" in printed


def test_scores_are_on_the_scale_of_their_task(study):
    tasks, found = evaluations.scores(rows_of(study), None)
    assert tasks == ["Hopper-v4"]
    assert np.allclose(found["aca"][0], [1990 / 2090, 2190 / 2090])
    assert np.allclose(found["narrow"][0], [990 / 2090, 1010 / 2090])


def test_a_task_on_which_nothing_was_learned_has_no_scale(study):
    for method in ("aca", "narrow"):
        write_run(study, method, 0, {0: 5, 100000: 4}, task="Ant-v4")
    spec = OmegaConf.load(study / "study.yaml")
    OmegaConf.save({**spec, "tasks": {"Hopper-v4": [], "Ant-v4": []}}, study / "study.yaml")
    tasks, _ = evaluations.scores(rows_of(study), None)
    assert tasks == ["Hopper-v4"]


def test_a_folder_without_runs_is_told(tmp_path):
    with pytest.raises(SystemExit, match="expected directories of runs that have begun"):
        evaluations.read_study(tmp_path)


def test_two_runs_of_one_name_are_told_and_not_joined(tmp_path):
    for folder, last in (("a", 2000), ("b", 5000)):
        write_run(tmp_path / folder, "aca", 0, {0: 10, 100: last})
    told = r"a/Hopper-v4-aca-s0 and .*b/Hopper-v4-aca-s0 are both aca on Hopper-v4 with seed 0"
    with pytest.raises(SystemExit, match=told):
        evaluations.read_study(tmp_path)


def test_half_a_row_of_a_run_at_work_is_none(tmp_path):
    write_run(tmp_path, "aca", 0, {0: 10, 100: 2000})
    path = tmp_path / "Hopper-v4-aca-s0" / "eval.csv"
    whole = evaluations.read_study(tmp_path)
    path.write_bytes(path.read_bytes() + b"200,1000,7")
    assert evaluations.read_study(tmp_path) == whole


@pytest.mark.parametrize(
    ("source", "options", "told"),
    [
        ("apart", [], "the runs of Hopper-v4 have no evaluation at the same place"),
        ("study", ["--value", "normalized_score"], "no evaluation has a normalized_score"),
        ("study", ["--at", "7"], "no run was evaluated at [7.0] updates"),
        ("study", ["--line", "foo"], "--line 'foo': expected TASK:NAME=VALUE"),
        ("text.csv", [], "expected a number in column note, got 'good'"),
        ("policy.csv", [], "expected the evaluations.csv of a study, found one without method,"),
        ("missing.csv", [], "expected the evaluations.csv of a study, found no file"),
    ],
)
def test_what_cannot_be_reported_is_told_and_nothing_is_written(
    study, tmp_path, source, options, told
):
    write_run(tmp_path / "apart", "aca", 0, {0: 10, 100: 20})
    write_run(tmp_path / "apart", "aca", 1, {50: 10, 150: 20})
    (tmp_path / "text.csv").write_text(
        "method,task,seed,updates,return_mean,note\naca,Hopper-v4,0,0,1,good\n"
    )
    (tmp_path / "policy.csv").write_text("checkpoint,return_mean\n3000,3\n")
    call = [sys.executable, str(SCRIPT), str(tmp_path / source), str(tmp_path / "out"), *options]
    done = subprocess.run(call, capture_output=True, text=True)
    assert done.returncode == 1 and told in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_column_of_ones_own_is_left_out_and_no_row_is_lost(study, tmp_path):
    out = tmp_path / "out"
    call = [sys.executable, str(SCRIPT), str(study), str(out)]
    subprocess.run(call, capture_output=True, check=True)
    path = out / "evaluations.csv"
    call[2] = str(path)
    subprocess.run(call, capture_output=True, check=True)
    before = path.read_bytes()
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([f"{header},mine", *(f"{line},7" for line in lines), ""]))
    subprocess.run(call, capture_output=True, check=True)
    assert path.read_bytes() == before


def test_scores_have_no_returns_of_the_paper_below_them(study, tmp_path):
    rows = [row | {"normalized_score": 9.0} for row in evaluations.read_study(study)]
    write_csv(tmp_path / "scores.csv", evaluations.COLUMNS, rows)
    call = [sys.executable, str(SCRIPT), str(tmp_path / "scores.csv"), str(tmp_path / "out")]
    call += ["--value", "normalized_score"]
    printed = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert "| Hopper-v4, 100,000 updates | 9.0 [9.0, 9.0] (n=2) |" in printed
    assert "*paper*" not in printed
