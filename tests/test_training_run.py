"""Checkpoints, tables, signals and checks of a run."""

from __future__ import annotations

import csv
import os
import signal

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_aca.training import checkpoint as checkpoint_module
from torchrl_aca.training.checkpoint import (
    Counters,
    list_checkpoints,
    read_checkpoint,
    restore,
    save_checkpoint,
)
from torchrl_aca.training.config import validate
from torchrl_aca.errors import RunError
from torchrl_aca.training.logging import CsvTable, MetricMeans, ProgressBar
from torchrl_aca.training.randomness import RandomState, seed_everything
from torchrl_aca.training.run import Run, StopSignal, has_reached


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_checkpoints_rotate_and_restore(tmp_path):
    counters = Counters()
    for updates in (5, 10, 100):
        counters.updates = updates
        save_checkpoint(tmp_path / "checkpoints", {"counters": counters}, {}, updates, keep_last=2)
    names = [path.name for path in list_checkpoints(tmp_path / "checkpoints")]
    assert names == ["checkpoint_0000000010.pt", "checkpoint_0000000100.pt"]
    fresh = Counters()
    restore({"counters": fresh}, read_checkpoint(tmp_path)["parts"])
    assert fresh == counters


def test_a_crash_while_writing_leaves_the_previous_checkpoint(tmp_path, monkeypatch):
    directory = tmp_path / "checkpoints"
    save_checkpoint(directory, {"counters": Counters(1)}, {}, 1, keep_last=1)

    def crash(content, file):
        file.write(b"half a file")
        raise OSError("disk full")

    monkeypatch.setattr(checkpoint_module.torch, "save", crash)
    with pytest.raises(OSError, match="disk full"):
        save_checkpoint(directory, {"counters": Counters(2)}, {}, 2, keep_last=1)
    monkeypatch.undo()
    assert read_checkpoint(tmp_path)["parts"]["counters"]["updates"] == 1


@pytest.mark.parametrize("content", [b"not a checkpoint", b"", None])
def test_foreign_checkpoints_are_refused(tmp_path, content):
    path = tmp_path / "checkpoints" / "checkpoint_0000000001.pt"
    path.parent.mkdir()
    if content is None:
        torch.save({"model": torch.zeros(2)}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(RunError, match="checkpoint"):
        read_checkpoint(tmp_path)


def test_a_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(RunError, match="found none"):
        read_checkpoint(tmp_path)


def test_restore_names_the_part_that_does_not_fit():
    states = {"net": torch.nn.Linear(2, 2).state_dict()}
    with pytest.raises(RunError, match="'net' does not fit"):
        restore({"net": torch.nn.Linear(3, 2)}, states)
    with pytest.raises(RunError, match="no \\['other'\\]"):
        restore({"other": torch.nn.Linear(2, 2)}, states)
    restore({"other": torch.nn.Linear(2, 2)}, states, optional=("other",))


def test_random_streams_are_restored(tmp_path):
    import random

    import numpy as np

    def draw():
        return random.random(), np.random.rand(), np.random.randn(), torch.rand(2).tolist()

    seed_everything(3)
    draw()
    torch.save(RandomState().state_dict(), tmp_path / "random.pt")
    expected = draw()
    seed_everything(4)
    RandomState().load_state_dict(torch.load(tmp_path / "random.pt", weights_only=True))
    assert draw() == expected


def test_csv_table_takes_late_columns_and_forgets_rows_after_a_checkpoint(tmp_path):
    table = CsvTable(tmp_path / "t.csv")
    table.append({"updates": 1, "a": 0.5})
    table.append({"updates": 2, "a": 0.25, "b": 3})
    table.append({"updates": 3, "b": 4})
    assert rows_of(tmp_path / "t.csv") == [
        {"updates": "1", "a": "0.5", "b": ""},
        {"updates": "2", "a": "0.25", "b": "3"},
        {"updates": "3", "a": "", "b": "4"},
    ]
    CsvTable(tmp_path / "t.csv", last_update=2).append({"updates": 7, "a": 1})
    assert [row["updates"] for row in rows_of(tmp_path / "t.csv")] == ["1", "2", "7"]


def test_metric_means_average_over_the_updates_that_report():
    means, other = MetricMeans(), MetricMeans()
    means.add(TensorDict({"a": torch.tensor(1.0), "b": torch.tensor(4.0)}))
    other.load_state_dict(means.state_dict())
    for each in (means, other):
        each.add(TensorDict({"a": torch.tensor(2.0)}))
        assert each.pop() == {"a": 1.5, "b": 4.0}
        assert each.pop() == {}
    means.add(TensorDict({"a": torch.tensor(float("nan"))}))
    with pytest.raises(RunError, match="'a' became nan"):
        means.pop()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_asks_to_stop_and_handlers_are_put_back(number):
    before = signal.getsignal(number)
    with StopSignal() as stop:
        assert stop.received is None
        os.kill(os.getpid(), number)
        assert stop.received == number.name
        assert signal.getsignal(number) is before
    assert signal.getsignal(number) is before


def test_counters_tell_when_an_interval_has_passed():
    counters = Counters(updates=10)
    assert counters.passed(5, since=9) and counters.passed(10, since=9)
    assert not counters.passed(5, since=10) and not counters.passed(11, since=0)
    assert counters.passed(4, since=7)  # 8 lies in between


def test_plain_lines_where_there_is_no_terminal(capsys):
    bar = ProgressBar(total=10, initial=0)
    bar.show_metrics(5, 25, {"loss": 0.5, "alpha": 3.0})
    assert capsys.readouterr().out == "updates 5/10  frames 25  loss 0.5\n"


def settings(tmp_path, **changes):
    sections = {
        "optim": {"total_updates": 100},
        "collector": {"init_random_frames": 0},
        "eval": {"interval": 10, "stop_return": None},
        "checkpoint": {"interval": 20, "keep_last": 9},
        "logger": {"interval": 5, "backend": "csv"},
    }
    for key, value in changes.items():
        section, name = key.split("__")
        sections[section][name] = value
    named = {"algo": {"name": "a"}, "env": {"name": "Toy-v0"}, "seed": 0, "resume": None}
    return OmegaConf.create({**named, **sections, "run_dir": str(tmp_path / "run")})


def iterate(cfg, returns, updates_per_iteration=5):
    """Ends iterations until a run is over: its updates, and the rows of its two tables."""
    counters, returns = Counters(frames=1), iter(returns)

    def evaluation():
        zeros = {"return_std": 0.0, "num_episodes": 1.0, "episode_length": 1.0}
        return {"return_mean": float(next(returns)), **zeros}

    with Run(cfg, {"counters": counters}, counters, False, "recipe.py") as run:
        last = False
        while not last:
            start = counters.updates
            counters.updates += updates_per_iteration
            counters.frames += 1
            last = run.end_iteration(start, lambda: {"loss": 0.5}, evaluation)
        run.finish(completed=True)
    return counters.updates, rows_of(run.dir / "metrics.csv"), rows_of(run.dir / "eval.csv")


def test_an_iteration_logs_evaluates_and_saves_what_is_due(tmp_path):
    cfg = settings(tmp_path, optim__total_updates=45)
    updates, metrics, evaluations = iterate(cfg, range(10))
    assert updates == 45
    assert [row["updates"] for row in metrics] == [str(5 * n) for n in range(1, 10)]
    # Every tenth update, and the last one.
    assert [row["updates"] for row in evaluations] == ["10", "20", "30", "40", "45"]
    saved = [path.stem[-2:] for path in list_checkpoints(tmp_path / "run" / "checkpoints")]
    assert saved == ["20", "40", "45"]


def test_a_run_stops_when_two_evaluations_have_averaged_the_return(tmp_path):
    cfg = settings(tmp_path, eval__stop_return=50)
    # 90 alone is luck; (90 + 5) / 2 and (5 + 94) / 2 are too little; (94 + 6) / 2 is enough.
    updates, _, evaluations = iterate(cfg, [0, 90, 5, 94, 6, 1000])
    assert updates == 50
    assert [float(row["return_mean"]) for row in evaluations] == [0, 90, 5, 94, 6]


def test_one_evaluation_or_no_return_to_reach_never_stops_a_run():
    rows = [{"return_mean": "100"}, {"return_mean": "100"}]
    assert has_reached(rows, 100)
    assert not has_reached(rows, 100.1)
    assert not has_reached(rows[:1], 1)
    assert not has_reached(rows, None)


def test_a_run_belongs_to_one_process_until_it_ends(tmp_path):
    cfg, counters = settings(tmp_path), Counters(frames=1)
    cfg.resume = str(tmp_path / "run")
    with Run(settings(tmp_path), {"counters": counters}, counters, False, "recipe.py") as first:
        first.save()
        with pytest.raises(RunError, match="run: another process is at work on this run"):
            Run(cfg, {"counters": counters}, counters, True, "recipe.py")
    with Run(cfg, {"counters": counters}, counters, True, "recipe.py") as run:
        assert run.dir == tmp_path / "run"
        counters.updates = 5
        run.save()
    with pytest.raises(RunError, match=r"went on to .*0005.pt while its checkpoint of 0 updates"):
        Run(cfg, {}, Counters(), True, "recipe.py")
    with Run(cfg, {}, counters, True, "recipe.py"):
        pass  # the refusal has let go of the directory


def test_a_stopped_run_names_the_recipe_that_goes_on_with_it(tmp_path, capsys):
    counters = Counters(updates=3, frames=3)
    with Run(settings(tmp_path), {"counters": counters}, counters, False, "recipe.py") as run:
        os.kill(os.getpid(), signal.SIGTERM)
        assert run.stopping
        run.log_evaluation({"return_mean": 0.0, "return_std": 0.0, "num_episodes": 1.0})
        run.finish(completed=False)
    expected = f"stopped by SIGTERM after 3 updates; go on with: python recipe.py resume={run.dir}"
    assert expected in capsys.readouterr().out


VALID = {
    "algo": {"name": "a"},
    "logger": {"backend": "csv", "interval": 1},
    "collector": {"num_envs": 5, "frames_per_batch": 5, "init_random_frames": 100},
    "buffer": {"capacity": 1000},
    "optim": {
        "total_updates": 10,
        "batch_size": 10,
        "utd_ratio": 0.2,
        "lr": 0.1,
        "gamma": 0.99,
        "tau": 0.01,
    },
    "seed": 0,
    "eval": {"interval": 1, "episodes": 3, "seed": 10, "stop_return": None},
    "checkpoint": {"interval": 1, "keep_last": 1},
    "matmul_precision": "highest",
    "num_threads": None,
    "a": {"num_cells": [8, 8]},
}


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("algo.name", "b", "one of \\['a'\\]"),
        ("logger.backend", "paper", "one of"),
        ("collector.num_envs", 0, "a positive integer"),
        ("buffer.capacity", -1, "a positive integer"),
        ("buffer.capacity", 5, "at least optim.batch_size \\(10\\)"),
        ("collector.init_random_frames", 5, "at least optim.batch_size"),
        ("collector.init_random_frames", 102, "a multiple of collector.frames_per_batch"),
        ("collector.frames_per_batch", 7, "a multiple of collector.num_envs"),
        ("optim.batch_size", 2.5, "a positive integer"),
        ("optim.batch_size", "many", "a positive integer"),
        ("optim.utd_ratio", 0, "a number above 0"),
        ("optim.gamma", 1.5, "at most 1"),
        ("optim.tau", "x", "a number above 0"),
        ("eval.episodes", 0, "a positive integer"),
        ("eval.stop_return", "high", "a number"),
        ("eval.seed", 4, "apart from the training's 0 to 4"),
        ("seed", -1, "an integer of at least 0"),
        ("num_threads", 0, "a positive integer or null"),
        ("a.num_cells", [8, 0], "positive integers"),
    ],
)
def test_validate_names_the_key_the_value_and_what_was_expected(key, value, expected):
    cfg = OmegaConf.create(VALID)
    validate(cfg, {"a": None})
    OmegaConf.update(cfg, key, value)
    with pytest.raises(RunError, match=f"{key}=.*{expected}"):
        validate(cfg, {"a": None})
