"""Checkpoints, tables, signals and checks of a run."""

from __future__ import annotations

import csv
import io
import os
import signal
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch
from filelock import FileLock
from tensordict import TensorDict

from torchrl_aca.errors import RunError
from torchrl_aca.training import checkpoint as checkpoint_module
from torchrl_aca.training.checkpoint import (
    Counters,
    list_checkpoints,
    read_checkpoint,
    restore,
    save_checkpoint,
)
from torchrl_aca.training.due import has_reached, passed
from torchrl_aca.training.files import replace_file, write_text
from torchrl_aca.training.logging import CsvTable, MetricMeans, _wandb_id
from torchrl_aca.training.randomness import RandomState, seed_everything
from torchrl_aca.training.resume import is_finished, read_evaluations
from torchrl_aca.training.run_dir import is_locked, lock, make_run_dir, require_newest
from torchrl_aca.training.signals import STOPPED, StopSignal, run_command


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
    CsvTable(tmp_path / "t.csv", {"updates": 2}).append({"updates": 7, "a": 1})
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


@pytest.mark.parametrize("ignored", [False, True])  # ignored: in what a script runs with `&`
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_asks_to_stop_the_second_stops_and_handlers_are_put_back(number, ignored):
    found = signal.getsignal(number)
    before = signal.SIG_IGN if ignored else found
    signal.signal(number, before)
    try:
        with StopSignal() as stop:
            assert stop.received is None
            os.kill(os.getpid(), number)
            assert (stop.received, stop.at_once) == (number.name, False)
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL  # which ends the process
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
            assert stop.at_once
        assert signal.getsignal(number) is before
    finally:
        signal.signal(number, found)


def test_an_interval_has_passed_when_a_multiple_lies_between():
    assert passed(5, 9, 10) and passed(10, 9, 10)
    assert not passed(5, 10, 10) and not passed(11, 0, 10)
    assert passed(4, 7, 10)  # 8 lies in between


def test_one_evaluation_or_no_return_to_reach_never_stops_a_run():
    rows = [{"return_mean": "100"}, {"return_mean": "100"}]
    assert has_reached(rows, 100)
    assert not has_reached(rows, 100.1)
    assert not has_reached(rows[:1], 1)
    assert not has_reached(rows, None)


def test_two_runs_of_the_same_second_have_two_directories(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torchrl_aca.training.run_dir.time.strftime", lambda _: "now")
    names = [make_run_dir(None, "Hopper-v4-sac-s0").name for _ in range(3)]
    assert names == ["Hopper-v4-sac-s0-now", "Hopper-v4-sac-s0-now-2", "Hopper-v4-sac-s0-now-3"]


def test_a_run_directory_belongs_to_one_process_until_it_ends(tmp_path):
    first = lock(tmp_path)
    with pytest.raises(RunError, match="another process is at work on this run"):
        lock(tmp_path)
    first.release()
    lock(tmp_path).release()


def test_a_checkpoint_that_has_come_meanwhile_is_told(tmp_path):
    save_checkpoint(tmp_path / "checkpoints", {"counters": Counters(5)}, {}, 5, keep_last=1)
    require_newest(tmp_path, 5)
    with pytest.raises(RunError, match=r"went on to .*0005.pt while its checkpoint of 0 updates"):
        require_newest(tmp_path, 0)


@pytest.mark.parametrize("place", [0.3, 0.5, 0.9])
def test_one_flipped_bit_is_found_and_the_checkpoint_before_offered(tmp_path, place):
    parts = {"counters": Counters(1), "net": torch.nn.Linear(200, 200)}
    for updates in (1, 2):
        save_checkpoint(tmp_path / "checkpoints", parts, {}, updates, keep_last=2)
    newest = list_checkpoints(tmp_path / "checkpoints")[-1]
    content = bytearray(newest.read_bytes())
    content[int(place * len(content))] ^= 1
    newest.write_bytes(content)
    with pytest.raises(RunError, match=r"0002.pt (is damaged|cannot be read).*0001.pt is intact"):
        read_checkpoint(tmp_path)
    newest.unlink()
    assert read_checkpoint(tmp_path)["parts"]["counters"]["updates"] == 1


def test_a_full_disk_leaves_the_file_that_was_there(tmp_path):
    path = tmp_path / "eval.csv"
    write_text(path, "old")

    def crash(file):
        file.write(b"half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        replace_file(path, crash)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]  # and the room is free again


def test_a_signal_that_comes_twice_at_once_is_one_wish(monkeypatch):
    """As `timeout` sends it, to the process and to its group; a later one ends the run."""
    twice = []

    def arrives_again(seconds):
        twice.append(seconds)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("torchrl_aca.training.signals.time.sleep", arrives_again)
    said = []
    with StopSignal(said.append) as stop:
        signal.raise_signal(signal.SIGINT)
        assert (stop.received, len(said), len(twice)) == ("SIGINT", 1, 1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("fault", [BrokenPipeError(), OSError(28, "full"), RuntimeError("again")])
def test_a_line_that_nobody_can_read_is_lost_alone(fault, monkeypatch):
    class Reader(io.TextIOWrapper):
        def write(self, text):
            raise fault

    with open(os.devnull, "wb") as stream:
        monkeypatch.setattr(sys, "stdout", Reader(stream))
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGTERM)
        assert stop.received == "SIGTERM"
        monkeypatch.undo()


def test_a_directory_for_reading_alone_is_told_and_its_run_is_not_at_work(tmp_path, monkeypatch):
    lock(tmp_path).release()
    (tmp_path / ".lock").touch()

    def refuse(*args, **kwargs):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(FileLock, "acquire", refuse)
    with pytest.raises(RunError, match="cannot be written: .*Read-only file system. Mend that."):
        lock(tmp_path)
    assert not is_locked(tmp_path)


def test_a_second_wish_to_stop_ends_a_command_that_still_saves():
    """It needs SIGTERM twice, as a run in the middle of an evaluation does."""
    stop = StopSignal()
    script = "import signal, time; signal.signal(15, lambda *a: signal.signal(15, signal.SIG_DFL))"
    command = [sys.executable, "-c", f"{script}; print('ready', flush=True); time.sleep(60)"]
    with tempfile.TemporaryFile() as output, ThreadPoolExecutor(1) as pool:
        code = pool.submit(run_command, command, stop, stdout=output)
        deadline = time.time() + 60
        while not os.fstat(output.fileno()).st_size and time.time() < deadline:
            time.sleep(0.02)
        stop.received = "SIGINT"
        time.sleep(1)
        assert not code.done()
        stop.at_once = True
        assert code.result(timeout=30) == STOPPED


def test_a_kill_while_a_table_is_rewritten_loses_no_row(tmp_path, monkeypatch):
    table = CsvTable(tmp_path / "t.csv")
    for updates in (1, 2, 3):
        table.append({"updates": updates, "a": 0.5})
    before = (tmp_path / "t.csv").read_text()

    def kill(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_aca.training.files.os.replace", kill)
    with pytest.raises(KeyboardInterrupt):
        CsvTable(tmp_path / "t.csv", {"updates": 2})
    assert (tmp_path / "t.csv").read_text() == before


@pytest.mark.parametrize("half", ["x", "1", "2,10,0.2"])
def test_half_a_row_of_a_killed_process_is_dropped_on_resume(tmp_path, half):
    (tmp_path / "t.csv").write_text(f"updates,frames,a\n1,5,0.5\n{half}")
    table = CsvTable(tmp_path / "t.csv", {"updates": 9, "frames": 99})
    assert [row["updates"] for row in table.rows] == ["1"]


def test_a_run_whose_tables_are_half_written_is_not_finished(tmp_path):
    limits = SimpleNamespace(
        optim=SimpleNamespace(total_updates=5), eval=SimpleNamespace(stop_return=None)
    )
    (tmp_path / "done").write_text("5\n")
    for text, finished in (("", False), ("updates,a\n", False), ("updates,a\n5,", False)):
        (tmp_path / "eval.csv").write_text(text)
        assert is_finished(tmp_path, limits) is finished
    (tmp_path / "eval.csv").write_text("updates,a\n5,1\n10")
    assert is_finished(tmp_path, limits)
    assert read_evaluations(tmp_path) == [{"updates": 5.0, "a": 1.0}]


def test_a_command_that_is_told_to_stop_before_it_can_listen_has_stopped():
    with StopSignal() as stop:
        stop.received = "SIGTERM"
        assert run_command(["sleep", "60"], stop) == STOPPED
        stop.received = None
        assert run_command(["sh", "-c", "kill -TERM $$"], stop) == -signal.SIGTERM


def test_a_wandb_id_is_of_one_run_for_as_long_as_it_goes_on(tmp_path):
    runs = [tmp_path / folder / "Hopper-v4-sac-s0" for folder in ("a", "b")]
    for run_dir in runs:
        run_dir.mkdir(parents=True)
    first, other = (_wandb_id(run_dir, new=True) for run_dir in runs)
    assert first != other
    assert _wandb_id(runs[0], new=False) == first
    assert _wandb_id(runs[0], new=True) not in (first, other)
    for folder, name in (("begun without", None), ("of an earlier version", "Hopper-v4-sac-s0")):
        run_dir = tmp_path / folder / "Hopper-v4-sac-s0"
        (run_dir / "wandb" if name else run_dir).mkdir(parents=True)
        found = _wandb_id(run_dir, new=False)
        assert found == _wandb_id(run_dir, new=False)
        assert (found == name) if name else len(found) == 32


def test_the_first_signal_is_answered_at_once():
    said = []
    with StopSignal(said.append) as stop:
        stop.activity = "evaluation"
        os.kill(os.getpid(), signal.SIGTERM)
        assert said == ["SIGTERM: stopping after this evaluation; Ctrl-C again quits"]
