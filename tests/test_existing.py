"""Promises of `existing=resume`: the same command again goes on, or has nothing to do."""

from __future__ import annotations

import time

from recipe_cases import TINY, assert_same_state, rows_of, run, start, without_time

HERE = [*TINY["sac"], "run_dir=here", "existing=resume"]


def test_the_same_command_goes_on_after_a_kill_and_then_has_nothing_to_do(tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    code, _, errors = run(*HERE, cwd=other)
    assert code == 0, errors

    process = start(*HERE, "checkpoint.interval=1", cwd=tmp_path)
    deadline = time.time() + 60
    while not list((tmp_path / "here" / "checkpoints").glob("*.pt")) and time.time() < deadline:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    assert not (tmp_path / "here" / "done").exists()
    code, output, errors = run(*HERE, cwd=tmp_path)
    assert code == 0, errors
    assert_same_state(other / "here", tmp_path / "here")
    assert without_time(other / "here" / "eval.csv") == without_time(tmp_path / "here" / "eval.csv")

    code, output, errors = run(*HERE, cwd=tmp_path)
    assert (code, errors, output) == (0, "", "here is finished: nothing to do\n")
    (tmp_path / "here" / "done").unlink()  # killed between its last checkpoint and its end
    for command in (HERE, ["resume=here"]):
        code, output, errors = run(*command, cwd=tmp_path)
        assert (code, errors) == (0, "")
        assert output == "here has all its 60 updates: nothing to do\n"
        assert (tmp_path / "here" / "done").read_text() == "60\n"
        (tmp_path / "here" / "done").unlink()
    run(*HERE, cwd=tmp_path)
    code, output, errors = run(*HERE, cwd=tmp_path)
    assert output == "here is finished: nothing to do\n"
    config = tmp_path / "here" / "config.yaml"
    settings = config.read_bytes()
    config.write_text("")  # lost: the checkpoint has them too
    assert run(*HERE, cwd=tmp_path)[1] == output
    config.write_bytes(settings)
    for path in (tmp_path / "here" / "checkpoints").iterdir():
        path.unlink()  # room on the disk: a finished run is not begun anew for that
    assert run(*HERE, cwd=tmp_path)[1] == output


def test_another_command_does_not_go_on_and_a_longer_one_does(tmp_path):
    assert run(*HERE, cwd=tmp_path)[0] == 0
    code, _, errors = run(*HERE[:-1], cwd=tmp_path)
    assert code == 1 and "go on with resume=here or existing=resume" in errors
    code, _, errors = run(*HERE, "optim.gamma=0.9", cwd=tmp_path)
    assert code == 1 and "run_dir=here has optim.gamma=0.9, but the run to resume has" in errors
    code, _, errors = run(*HERE, "optim.total_updates=65", cwd=tmp_path)
    assert code == 0, errors
    assert rows_of(tmp_path / "here" / "eval.csv")[-1]["updates"] == "65"
    assert (tmp_path / "here" / "done").read_text() == "65\n"


def test_a_job_of_a_sweep_that_fails_is_told_and_the_others_go_on(tmp_path):
    jobs = ["optim.gamma=0.9,7,0.8", "hydra.sweep.dir=jobs", "hydra.sweep.subdir=${optim.gamma}"]
    code, _, errors = run("--multirun", *TINY["sac"], *jobs, cwd=tmp_path)
    assert code == 1 and "error: optim.gamma=7: expected less than or equal to 1" in errors
    assert [path.parent.name for path in sorted(tmp_path.glob("jobs/*/done"))] == ["0.8", "0.9"]


def test_a_run_that_was_killed_at_its_end_goes_on_where_more_or_less_is_asked(tmp_path):
    assert run(*HERE, cwd=tmp_path)[0] == 0
    for asked, status, told in (
        ("optim.total_updates=abc", 1, "optim.total_updates='abc': expected a valid integer"),
        ("optim.total_updates=30", 1, "already has 60 updates; expected"),
        ("optim.total_updates=65", 0, ""),
    ):
        (tmp_path / "here" / "done").unlink(missing_ok=True)
        code, _, errors = run("resume=here", asked, cwd=tmp_path)
        assert (code, told in errors, "Traceback" in errors) == (status, True, False)
        assert (tmp_path / "here" / "done").exists() == (status == 0)
    assert rows_of(tmp_path / "here" / "eval.csv")[-1]["updates"] == "65"


def test_a_run_that_its_return_has_ended_and_a_kill_is_finished(tmp_path):
    typed = [*HERE, "eval.stop_return=-1000"]  # which any policy has reached
    assert run(*typed, cwd=tmp_path)[0] == 0
    updates = rows_of(tmp_path / "here" / "eval.csv")[-1]["updates"]
    assert int(updates) < 60
    (tmp_path / "here" / "done").unlink()
    code, output, errors = run(*typed, cwd=tmp_path)
    assert (code, errors) == (0, "")
    assert output == f"here has all its {updates} updates: nothing to do\n"
