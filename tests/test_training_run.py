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
from torchrl_aca.training.errors import RunError
from torchrl_aca.training.logging import CsvTable, MetricMeans, ProgressBar
from torchrl_aca.training.randomness import RandomState, seed_everything
from torchrl_aca.training.run import StopSignal


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
    "eval": {"interval": 1, "episodes": 3, "seed": 10},
    "checkpoint": {"interval": 1, "keep_last": 1},
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
