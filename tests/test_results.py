"""Promises of results/plot.py, and of the cards that results/report.py wrote."""

from __future__ import annotations

import csv
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from omegaconf import OmegaConf

RESULTS = Path(__file__).parents[1] / "results"
CARDS = sorted(path.with_name("card.md") for path in RESULTS.glob("*/evaluations.csv"))


@pytest.fixture(scope="module")
def plot():
    spec = importlib.util.spec_from_file_location("plot", RESULTS / "plot.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look themselves up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def write_run(path: Path, returns: dict[int, float], seed: int = 0, **settings) -> Path:
    config = {"algo": {"name": "aca"}, "env": {"name": "Task-v1"}, "optim": {"utd_ratio": 1}}
    path.mkdir()
    OmegaConf.save(config | {"seed": seed, "run_dir": str(path)} | settings, path / "config.yaml")
    with open(path / "eval.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["updates", "return_mean", "return_std"])
        writer.writerows([updates, value, 1.0] for updates, value in returns.items())
    return path


def test_seeds_of_equal_settings_are_one_curve(plot, tmp_path):
    first = write_run(tmp_path / "b", {0: 1.0, 10: 30.0}, seed=2)
    second = write_run(tmp_path / "a", {0: 3.0, 10: 10.0, 20: 5.0}, seed=1)
    (curve,) = plot.make_curves([first, second])
    assert curve.label == "aca, 2 seeds"
    assert plot.table([curve]).splitlines()[2:] == ["| 0 | 2 (3, 1) |", "| 10 | 20 (10, 30) |"]


def test_other_settings_are_another_curve(plot, tmp_path):
    plain = write_run(tmp_path / "a", {0: 1.0, 1000: 4.4})
    control = write_run(tmp_path / "b", {0: 2.0}, offline_fraction=0)
    curves = plot.make_curves([control, plain])
    assert plot.table(curves).splitlines() == [
        "| updates | aca, no offline data, seed 0 | aca, seed 0 |",
        "|--:|--:|--:|",
        "| 0 | 2 | 1 |",
        "| 1,000 |  | 4 |",
    ]


def test_curves_of_one_label_are_told_apart_and_a_run_counts_once(plot, tmp_path):
    few = write_run(tmp_path / "few", {0: 1.0}, aca={"num_steps": 5})
    many = write_run(tmp_path / "many", {0: 2.0}, aca={"num_steps": 10})
    header = plot.table(plot.make_curves([few, many])).splitlines()[0]
    assert header == "| updates | aca, seed 0 (few) | aca, seed 0 (many) |"
    with pytest.raises(SystemExit, match="equal settings and seeds"):
        plot.make_curves([few, few])


def test_a_curve_is_its_mean_with_an_interval_over_seeds_or_episodes(plot, tmp_path):
    runs = [write_run(tmp_path / f"{s}", {0: 1.0, 10: 2.0 + s}, seed=s) for s in (0, 1)]
    for run_dirs, values, band in (
        (runs, [1.0, 2.5], (2.0, 3.0)),
        (runs[:1], [1.0, 2.0], (1.0, 3.0)),
    ):
        axes = Figure().subplots()
        plot.draw(axes, *plot.make_curves(run_dirs), "both", "C1")
        assert [line.get_ydata().tolist() for line in axes.lines] == [values]
        at_ten = [y for x, y in axes.collections[0].get_paths()[0].vertices if x == 10]
        assert (min(at_ten), max(at_ten)) == band


def test_what_a_longer_run_has_beyond_the_others_is_dotted(plot, tmp_path):
    longer = write_run(tmp_path / "longer", {0: 1.0, 10: 2.0, 20: 5.0, 30: 6.0}, seed=0)
    shorter = write_run(tmp_path / "shorter", {0: 3.0, 10: 4.0}, seed=1)
    axes = Figure().subplots()
    plot.draw(axes, *plot.make_curves([longer, shorter]), "both", "C1")
    mean, beyond = axes.lines
    assert (mean.get_xdata().tolist(), mean.get_ydata().tolist()) == ([0, 10], [2.0, 3.0])
    assert (list(beyond.get_xdata()), list(beyond.get_ydata())) == ([10, 20, 30], [2.0, 5.0, 6.0])
    assert beyond.get_linestyle() == ":"


def test_each_task_has_a_panel_and_frames_may_be_the_axis(plot, tmp_path, monkeypatch, capsys):
    for task, values in (("A-v1", {0: 1.0, 10: 2.0}), ("B-v1", {0: 3.0, 10: 4.0})):
        path = write_run(tmp_path / task, values, env={"name": task})
        rows = "updates,frames,return_mean,return_std\n0,0,{},0\n10,70,{},0\n"
        (path / "eval.csv").write_text(rows.format(*values.values()))
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.extend(figure.axes))
    command = ["plot.py", str(tmp_path / "out.png"), str(tmp_path), "--x", "frames"]
    monkeypatch.setattr(sys, "argv", command)
    plot.main()
    assert [axes.get_title() for axes in drawn] == ["A-v1", "B-v1"]
    assert [axes.lines[0].get_xdata().tolist() for axes in drawn] == [[0, 70], [0, 70]]
    assert "A-v1\n| updates" in capsys.readouterr().out


def test_many_curves_have_one_legend_and_a_colour_each_in_all_panels(plot, tmp_path, monkeypatch):
    methods = [f"m{number}" for number in range(6)]
    for task in ("A-v1", "B-v1"):
        for method in methods[task == "B-v1" :]:  # the second task lacks the first method
            algo, path = {"name": method}, tmp_path / f"{task}-{method}"
            write_run(path, {0: 1.0, 10: 2.0}, env={"name": task}, algo=algo)
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    for folder in (tmp_path, tmp_path / "A-v1-m0"):
        monkeypatch.setattr(sys, "argv", ["plot.py", str(tmp_path / "out.png"), str(folder)])
        plot.main()
    many, one = drawn
    assert [text.get_text()[:2] for text in many.legends[0].get_texts()] == methods
    first, second = many.axes
    assert first.get_legend() is None is second.get_legend()
    assert [line.get_color() for line in first.lines] == [f"C{number}" for number in range(6)]
    assert [line.get_color() for line in second.lines] == [f"C{number}" for number in range(1, 6)]
    assert not one.legends and one.axes[0].get_legend() is not None


def test_updates_of_an_offline_phase_come_before_zero(plot, tmp_path):
    optim = {"utd_ratio": 1, "offline_updates": 20}
    run_dir = write_run(tmp_path / "a", {0: 1.0}, optim=optim)
    rows = ["updates,offline_updates,return_mean,return_std", "0,0,1,0", "0,20,2,0", "10,20,3,0"]
    (run_dir / "eval.csv").write_text("\n".join([*rows, ""]))
    (curve,) = plot.make_curves([run_dir])
    assert plot.table([curve]).splitlines()[2:] == ["| -20 | 1 |", "| 0 | 2 |", "| 10 | 3 |"]


def test_command_writes_the_figure_and_prints_the_table(tmp_path):
    runs = [write_run(tmp_path / f"{s}", {0: 1.0, 10: 2.0 + s}, seed=s) for s in (0, 1)]
    script, figure = str(RESULTS / "plot.py"), tmp_path / "curve.svg"
    typed = [sys.executable, script, str(figure), *map(str, runs), "--line", "mean of the data=3"]
    printed = subprocess.run(typed, capture_output=True, text=True, check=True).stdout
    assert "| 10 | 2 (2, 3) |" in printed
    assert "<!-- mean of the data -->" in figure.read_text()
    wrong = subprocess.run([*typed[:-1], "foo"], capture_output=True, text=True, check=False)
    assert "expected NAME=RETURN, got 'foo'" in wrong.stderr


def test_a_folder_stands_for_the_runs_in_it_and_one_without_is_told(plot, tmp_path):
    runs = [write_run(tmp_path / f"{s}", {0: 1.0, 10: 2.0}, seed=s) for s in (0, 1)]
    assert plot.runs_in(tmp_path) == runs and plot.runs_in(runs[0]) == runs[:1]
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match="empty holds no run"):
        plot.runs_in(tmp_path / "empty")


def test_there_are_cards():
    assert {"campaign", "o2o_halfcheetah", "offline_to_online"} < {c.parent.name for c in CARDS}


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.parent.name)
def test_cards_are_what_their_command_prints(card, tmp_path):
    text = card.read_text()
    again = re.search(r"again: `python results/report\.py (.+)`", text)
    source, out, *options = shlex.split(again[1])
    shutil.copytree(card.parent, copy := tmp_path / card.parent.name)
    command = [sys.executable, str(RESULTS / "report.py"), str(RESULTS.parent / source), str(copy)]
    subprocess.run([*command, *options], check=True, capture_output=True)
    written = (copy / "card.md").read_text().replace(str(copy), out)
    assert written == text
    assert (copy / "evaluations.csv").read_text() == (card.parent / "evaluations.csv").read_text()
    assert "## Notes" in text


# --- figures of studies ---------------------------------------------------------------------------


def test_the_figures_of_the_ablations(tmp_path, monkeypatch):
    import ablations

    for study, methods in (("guidance_weight", ("w5", "w50", "auto5")), ("num_steps", ("T5",))):
        (tmp_path / study).mkdir()
        lines = [f"{method},Task-v1,0,10,{place}" for place, method in enumerate(methods)]
        text = "\n".join(["method,task,seed,updates,return_mean", *lines])
        (tmp_path / study / "evaluations.csv").write_text(text)
    runs = tmp_path / "runs"
    runs.mkdir()
    for seed in (0, 1):
        run_dir = write_run(runs / f"Task-v1-auto5-s{seed}", {0: 1.0}, seed=seed)
        metrics = "updates,guidance_weight,candidate_spread,guidance_gain,other\n10,{},0.1,0.2,7\n"
        (run_dir / "metrics.csv").write_text(metrics.format(20 + seed))
    study = {"tasks": {"Task-v1": []}, "methods": {"auto5": []}}
    OmegaConf.save(study, runs / "study.yaml")
    drawn = {}

    def save(figure, path, **_):
        drawn[str(path.relative_to(tmp_path))] = figure.axes[0]

    monkeypatch.setattr(Figure, "savefig", save)
    monkeypatch.setattr(ablations, "HERE", tmp_path)
    monkeypatch.setattr(sys, "argv", ["ablations.py", str(runs)])
    ablations.main()
    weights = (tmp_path / "guidance_weight/weights.csv").read_text()
    monkeypatch.setattr(sys, "argv", ["ablations.py", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match="nowhere: expected runs of methods named auto"):
        ablations.main()
    assert (tmp_path / "guidance_weight/weights.csv").read_text() == weights
    rows = weights.splitlines()
    assert rows[1:] == ["Task-v1,auto5,0,10.0,20.0,0.1,0.2", "Task-v1,auto5,1,10.0,21.0,0.1,0.2"]
    weights = drawn.pop("guidance_weight/weights.png")
    assert [line.get_ydata() for line in weights.lines] == [[20.0], [21.0]]
    assert set(drawn) == {"guidance_weight/ablation.png", "num_steps/ablation.png"}
    fixed = [label.get_text() for label in drawn["guidance_weight/ablation.png"].get_legend().texts]
    assert fixed == ["w", "auto"]


def test_the_three_sources_of_the_figure_of_short_chains(tmp_path):
    import short_chains
    from evaluations import by_setting

    case = (
        "| HalfCheetah: update, {} target candidates, chain of {} levels | compiled | {} ms |  | |"
    )
    measured = ((1, 20, 90.5), (1, 6, 31.0), (4, 20, 300.0))
    table = "\n".join(case.format(*numbers) for numbers in measured)
    assert short_chains.costs(table) == {"N = 1": {20: [90.5], 6: [31.0]}, "N = 4": {20: [300.0]}}

    header = "task,updates,schedule,num_steps,normalized,spacing,gradients,std_ratio\n"
    rows = (
        "Hopper-v4,2000,cosine,20,True,all,19,0.99\nHopper-v4,2000,cosine,20,True,quartic,9,1.01\n"
        "Hopper-v4,2000,cosine,20,True,even,9,2.0\nHopper-v4,2000,cosine,20,False,quartic,9,3.0\n"
        "Hopper-v4,2000,vp,20,True,quartic,9,4.0\nHopper-v4,2000,cosine,50,True,quartic,9,5.0\n"
    )
    (tmp_path / "hopper").mkdir()
    (tmp_path / "hopper/fidelity.csv").write_text(header + rows)
    assert short_chains.spreads(tmp_path) == {"Hopper-v4, 2,000 updates": {20: [0.99], 10: [1.01]}}

    runs = [
        {"task": "T", "method": f"levels{levels}_n1", "seed": seed, "updates": u, "return_mean": r}
        for levels, seed, u, r in ((20, 0, 0, 1), (20, 0, 9, 5), (20, 1, 9, 7), (6, 0, 9, 4))
    ]
    found = by_setting(runs, "T", short_chains.METHOD)
    assert found == {"n1": {20: [5.0, 7.0], 6: [4.0]}}
    with pytest.raises(SystemExit, match="nothing to draw for 'cost'"):
        short_chains.draw(Figure().subplots(), "cost", "ms", {})
