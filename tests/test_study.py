"""Promises of `recipes/study.py`: what runs, what is left alone, what is told."""

from __future__ import annotations

import os
import re
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
from hydra import initialize_config_dir

from recipe_cases import CONFIGS, ROOT, TINY, composed, rows_of, run, start
from studies.jobs import Job, StudyConfig, make_jobs, write_study
from studies.status import State, last_line, left_seconds, state_of, summary
from torchrl_aca.errors import RunError
from torchrl_aca.training.config import checked
from torchrl_aca.training.run_dir import lock
from torchrl_aca.training.signals import STOPPED


@pytest.fixture
def study():
    """Makes the jobs of a study as `study.py` does, inside Hydra."""

    def jobs(*overrides: str) -> list[Job]:
        cfg = checked(StudyConfig, composed(*overrides, name="study"))
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return make_jobs(cfg)

    return jobs


def test_jobs_are_named_by_task_method_and_seed_and_are_commands(study):
    jobs = study("study=tiny", "dir=/s")
    names = [f"InvertedPendulum-v4-{m}-s{s}" for m in ("aca", "sac") for s in (0, 1)]
    assert [job.dir.name for job in jobs] == names
    typed = ["env=inverted_pendulum", "algo=sac", "seed=1", f"run_dir=/s/{names[3]}"]
    assert {*typed, "existing=resume", "num_threads=1"} < set(jobs[3].command)
    assert jobs[3].config.optim.total_updates == 3000


def test_the_directory_may_have_any_name(study):
    job = study("study=tiny", "dir='/s = 1,(2)'")[0]
    (word,) = (word for word in job.command if word.startswith("run_dir="))
    assert composed(word).run_dir == str(job.dir) == "/s = 1,(2)/InvertedPendulum-v4-aca-s0"


def test_a_launcher_takes_settings_as_the_page_has_them():
    typed = ["study=tiny", "launcher=submitit", "launcher.parameters={slurm_partition:cpu}"]
    cfg = checked(StudyConfig, composed(*typed, name="study"))
    assert cfg.launcher.parameters == {"slurm_partition": "cpu"}


def test_a_study_of_the_other_recipe_has_its_keys(study):
    job = study("study=offline_to_online", "dir=/s")[-1]
    assert job.command[1].endswith("o2o_halfcheetah.py")
    assert job.dir.name == "HalfCheetah-v4-random-calql-s1"
    assert (job.config.offline_updates, job.updates) == (5000, 10000)
    with pytest.raises(RunError, match="recipe='bandit_2d': expected"):
        study("study=tiny", "+study.recipe=bandit_2d")


NUM_JOBS = {
    "tiny": 1 * 2 * 2,  # tasks, methods, seeds
    "table2": 6 * 7 * 5,
    "short_chains": 2 * 9 * 2,
    "rivals_short": 2 * 7 * 2,
    "guidance_weight": 2 * 10 * 2,
    "num_steps": 2 * 5 * 2,
    "beyond": 2 * 3 * 2,
    "offline_to_online": 2 * 7 * 2,
}


@pytest.mark.parametrize("path", sorted((CONFIGS / "study").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_study_of_the_package_is_a_valid_one(study, path):
    jobs = study(f"study={path.stem}")
    assert len(jobs) == NUM_JOBS[path.stem]
    # No two methods are the same but for their names.
    settings = {(job.config.model_dump_json(), job.command[-3]) for job in jobs}
    assert len(settings) == len(jobs)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("study.settings=['optim.lr=0']", "aca on InvertedPendulum-v4: optim.lr=0.*expected"),
        ("study.settings=['optim.lrr=1']", "aca on InvertedPendulum-v4: .*lrr"),
        ("study.name=a/b", "study.name='a/b': expected"),
        ("study.seeds=[]", r"study.seeds=\[\]: expected"),
        ("launcher.jobs=0", "launcher.jobs=0: expected greater than"),
    ],
)
def test_a_mistake_in_any_job_is_told_before_the_first_one_starts(study, override, message):
    with pytest.raises(RunError, match=message):
        study("study=tiny", override)


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        (["study.seeds=[0,0]"], "aca-s0"),
        (
            [
                '+study.tasks.InvertedPendulum-v4-x=["env=inverted_pendulum"]',
                '+study.methods.x-sac=["algo=sac"]',
            ],
            "InvertedPendulum-v4-x-sac-s0",
        ),
    ],
)
def test_two_jobs_of_one_directory_are_told(study, overrides, name):
    with pytest.raises(RunError, match=f"2 jobs are named .*{name}; expected a directory for each"):
        study("study=tiny", *overrides)


def test_the_line_that_is_told_of_a_job_is_the_one_that_says_why(study, tmp_path):
    job = study("study=tiny", f"dir={tmp_path}")[0]
    job.dir.mkdir(parents=True)
    hint = "Set the environment variable HYDRA_FULL_ERROR=1 for a complete stack trace."
    job.output.write_text(f"  warnings.warn('x')\nValueError: it exploded\n\n{hint}\n  source\n")
    assert last_line(job) == "ValueError: it exploded"


def test_a_part_of_a_study_leaves_the_names_of_the_rest(tmp_path):
    whole, part = (
        checked(StudyConfig, composed(*words, f"dir={tmp_path}", name="study"))
        for words in (["study=tiny"], ["study=tiny", "~study.methods.sac", "study.seeds=[7]"])
    )
    for cfg in (whole, part):
        write_study(cfg)
    written = yaml.safe_load((tmp_path / "study.yaml").read_text())
    assert list(written["methods"]) == ["aca", "sac"] and written["seeds"] == [7]
    other = checked(StudyConfig, composed("study=table2", f"dir={tmp_path}", name="study"))
    with pytest.raises(RunError, match="holds the study tiny"):
        write_study(other)


@pytest.mark.parametrize("content", ["a: [", "", "name: tiny"])
def test_a_directory_that_cannot_be_used_is_told(tmp_path, content):
    cfg = checked(StudyConfig, composed("study=tiny", f"dir={tmp_path}", name="study"))
    (tmp_path / "study.yaml").write_text(content)
    with pytest.raises(RunError, match="study.yaml is damaged; expected name, tasks and methods"):
        write_study(cfg)
    cfg.dir = str(tmp_path / "study.yaml")
    with pytest.raises(RunError, match="study.yaml cannot be used: .*exists"):
        write_study(cfg)


def test_parts_that_begin_at_the_same_time_lose_no_name(tmp_path):
    parts = [
        checked(
            StudyConfig,
            composed("study=tiny", f"~study.methods.{m}", f"dir={tmp_path}", name="study"),
        )
        for m in ("aca", "sac")
    ]
    for _ in range(20):
        (tmp_path / "study.yaml").unlink(missing_ok=True)
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(write_study, parts))
        assert set(yaml.safe_load((tmp_path / "study.yaml").read_text())["methods"]) == {
            "aca",
            "sac",
        }


def write_progress(run_dir: Path, updates: int, seconds: float, done: bool = False) -> None:
    run_dir.mkdir(parents=True)
    (run_dir / "metrics.csv").write_text(
        f"updates,seconds,updates_per_second\n{updates},{seconds},1\n"
    )
    (run_dir / "eval.csv").write_text(f"updates,return_mean\n{updates},7.5\n")
    if done:
        (run_dir / "done").write_text(f"{updates}\n")


def test_states_and_expected_time_are_read_from_the_directories(study, tmp_path):
    jobs = study("study=tiny", f"dir={tmp_path}")
    assert [state_of(job) for job in jobs] == [State("left", 0, 0.0, None)] * 4
    assert "is unknown" in summary(jobs, [state_of(job) for job in jobs])
    write_progress(jobs[0].dir, 3000, 600.0, done=True)  # 0.2 s an update
    write_progress(jobs[1].dir, 1000, 200.0)
    write_progress(jobs[2].dir, 1000, 100.0)  # 0.1 s an update
    held = lock(jobs[1].dir)
    states = [state_of(job) for job in jobs]
    held.release()
    assert [state.name for state in states] == ["done", "running", "stopped", "left"]
    assert states[0].latest == 7.5
    # 2000 updates of the second job, 2000 of the third, 3000 of the fourth
    assert left_seconds(jobs, states) == pytest.approx(2000 * 0.2 + 2000 * 0.1 + 3000 * 0.1)
    text = "work left: 0:15:00; 0:15:00 at 1 at once"
    assert summary(jobs, states) == f"1 done, 1 running, 1 stopped, 0 failed, 1 left; {text}"
    for code, name in ((-9, "failed"), (1, "failed"), (STOPPED, "stopped")):
        jobs[2].exit_status.write_text(f"{code}\n")
        assert state_of(jobs[2]).name == name


def write_mine(folder: Path) -> None:
    methods = {name: [o for o in TINY["sac"] if o != "env=hopper"] for name in ("one", "two")}
    methods["bad"] = ["algo=sac", "env.name=Nowhere-v0"]
    text = f"""name: mine
config: online_mujoco
tasks: {{Reacher-v4: [env=reacher]}}
methods: {methods}
seeds: [0]
settings: [checkpoint.interval=1, optim.total_updates=400]
"""
    (folder / "study").mkdir()
    (folder / "study" / "mine.yaml").write_text(text)


def pid_of(words: str) -> int | None:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if words in path.read_text():
                return int(path.parent.name)
        except OSError:
            continue
    return None


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="finds a job by /proc")
def test_killed_and_bad_jobs_are_told_the_others_go_on_and_the_same_command_goes_on(tmp_path):
    write_mine(tmp_path)
    command = ["--config-dir", str(tmp_path), "study=mine", "launcher.jobs=2"]
    process = start(*command, cwd=tmp_path, recipe="study")
    one, two, bad = (
        tmp_path / f"runs/studies/mine/Reacher-v4-{m}-s0" for m in ("one", "two", "bad")
    )
    deadline = time.time() + 60
    while not list(one.glob("checkpoints/*.pt")) and time.time() < deadline:
        time.sleep(0.02)
    os.kill(pid_of(f"run_dir={one}"), signal.SIGKILL)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and "Traceback" not in errors
    assert "Reacher-v4-one-s0 failed with status -9" in output
    assert "Reacher-v4-two-s0 done" in output
    assert "Reacher-v4-bad-s0 failed with status 1: error: env.name='Nowhere-v0'" in output
    assert "1 done, 0 running, 0 stopped, 2 failed, 0 left" in output

    evaluated = (two / "eval.csv").stat().st_mtime
    _, output, _ = run(*command, cwd=tmp_path, recipe="study")
    assert "2 of 3 jobs to do" in output and "Reacher-v4-one-s0 done" in output
    assert (two / "eval.csv").stat().st_mtime == evaluated
    updates = [int(row["updates"]) for row in rows_of(one / "eval.csv")]
    assert updates == [0, *range(30, 400, 30), 400]  # each once


@pytest.mark.slow
def test_data_are_made_once_before_the_jobs_and_missing_ones_are_told(tmp_path):
    lengths = ["offline_updates=20", "online_frames=60", "collector.warmup_frames=300"]
    study = {
        "name": "mine",
        "recipe": "o2o_halfcheetah",
        "config": "o2o_quickstart",
        "tasks": {"pendulum": ["env=mine", "dataset=mine", "generate.episodes=20"]},
        "methods": {"rlpd": ["algo=rlpd"], "iql": ["algo=iql"]},
        "seeds": [0],
        "settings": [*lengths, "eval.episodes=1", "checkpoint.interval=25"],
    }
    task = "# @package _global_\nenv: {name: InvertedPendulum-v4}\n"
    for folder, text in (("study", yaml.safe_dump(study)), ("env", task)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.yaml").write_text(text)
    command = ["--config-dir", str(tmp_path), "study=mine", "launcher.jobs=2"]

    missing = 'study.tasks.pendulum=["env=mine","dataset=mine","generate=null"]'
    code, output, errors = run(*command, missing, cwd=tmp_path, recipe="study")
    assert (code, output) == (1, "")
    assert errors.startswith("error: mine: expected the directory of a data set, found nothing")
    made = {path.name for path in (tmp_path / "runs/studies/mine").iterdir()}
    assert made == {"study.yaml", ".study.lock"}

    code, output, errors = run(*command, cwd=tmp_path, recipe="study")
    assert code == 0, errors
    assert output.count("generating mine") == 1
    assert "2 done, 0 running, 0 stopped, 0 failed, 0 left" in output


def test_the_page_has_every_key_with_its_default():
    rows = dict(
        re.findall(r"^\| `(\w+)` \| `(.+?)` \|", (ROOT / "docs/howto/study.md").read_text(), re.M)
    )
    config = yaml.safe_load((CONFIGS / "study.yaml").read_text())
    chosen = {k: v for item in config["defaults"][1:] for k, v in item.items()}
    expected = {**chosen, **config}
    kept = [k for k in expected if k not in ("defaults", "hydra") and not k.startswith("override")]
    assert {k: yaml.safe_load(v) for k, v in rows.items()} == {k: expected[k] for k in kept}
