"""What a run shows: durations, the pace of the updates, plain lines, and a bar on a terminal."""

from __future__ import annotations

import io
import sys

import pytest

from torchrl_aca.training import progress
from torchrl_aca.training.progress import Pace, ProgressBar, duration


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets: clock[0] is the time in seconds."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min"),
        (3560.0, "59 min"),
        (3599.0, "1 h 0 min"),
        (12_000.0, "3 h 20 min"),
        (86_399.0, "1 d 0 h"),
        (964_800.0, "11 d 4 h"),
    ],
)
def test_a_duration_has_its_two_largest_units(seconds, text):
    assert duration(seconds) == text


def test_the_pace_leaves_out_the_first_update_which_may_compile(clock):
    pace = Pace(updates=7)
    clock[0] += 100  # warm-up
    pace.advance(7)
    assert pace.left(107) is None
    clock[0] += 60  # compiles
    pace.advance(8)
    assert pace.left(107) is None
    clock[0] += 4
    pace.advance(9)
    assert pace.left(109) == 400.0
    assert pace.first_estimate(109) is None  # four seconds are too few to tell
    clock[0] += 8
    pace.advance(12)
    assert pace.left(112) == 300.0
    assert pace.first_estimate(112) == "about 5 min left at this speed: 3 s for each of 100 updates"
    assert pace.first_estimate(112) is None  # it is told once


def test_nothing_is_estimated_when_all_is_done(clock):
    pace = Pace(updates=0)
    for updates in (1, 2, 3):
        pace.advance(updates)
        clock[0] += 20
    assert pace.left(3) == 0.0
    assert pace.first_estimate(3) is None


def test_plain_lines_where_there_is_no_terminal(clock, capsys):
    bar = ProgressBar(total=10, initial=0)
    for updates in range(1, 6):
        bar.advance(updates, "train")
        clock[0] += 1
    values = {"loss": 0.5, "alpha": 3.0, "return_mean": 7.25, "updates_per_second": 1.0}
    bar.show_metrics(5, 25, values)
    bar.show_evaluation(5, 25, {"return_mean": 7.25}, 9.0)
    assert capsys.readouterr().out.splitlines() == [
        "updates 5/10  frames 25  1 updates/s, 6 s left  return_mean 7.25  loss 0.5",
        "updates 5/10  frames 25  return_mean 7.25  best 9",
    ]


def test_a_terminal_sees_the_warm_up_and_the_evaluation_move(clock, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    shown = Terminal()
    monkeypatch.setattr(sys, "stdout", shown)
    monkeypatch.setattr(sys, "stderr", shown)  # where the bar is drawn
    bar = ProgressBar(total=10, initial=0)
    for activity in ("warm-up 50/100 frames", "evaluation, step 3"):
        clock[0] += 1
        bar.advance(0, activity)
    bar.close()
    assert "warm-up 50/100 frames" in shown.getvalue()
    assert "evaluation, step 3" in shown.getvalue()


def test_a_terminal_that_has_gone_ends_the_bar_and_not_the_run(monkeypatch):
    class Gone(io.StringIO):
        def isatty(self):
            return True

        def write(self, text):
            raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", Gone())
        bar = ProgressBar(10, 0)
        assert not bar.bar.disable
        bar.write("a line")
        assert bar.bar.disable
        bar.advance(5, "train")
        bar.write("another line")
        bar.close()
