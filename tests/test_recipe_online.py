"""The online recipe, run as users run it, with tiny sizes."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import signal
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from hydra.errors import HydraException
from omegaconf import OmegaConf

from agents import configured
from online_mujoco import train
from recipe_cases import (
    CONFIGS,
    RECIPES,
    TINY,
    assert_same_state,
    checkpoint_leaves,
    composed,
    rows_of,
    run,
    start,
    without_time,
)
from resolvers import file_name
from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import list_checkpoints
from torchrl_aca.training.due import updates_due
from torchrl_aca.training.envs import make_env
from torchrl_aca.training.resume import resumed_config
from torchrl_aca.training.signals import STOPPED

SCRIPT = RECIPES / "online_mujoco.py"
TINY_SAC = TINY["sac"]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory) -> Path:
    cwd = tmp_path_factory.mktemp("unbroken")
    code, output, errors = run(*TINY_SAC, cwd=cwd)
    assert code == 0, errors
    (run_dir,) = (cwd / "runs").iterdir()
    (cwd / "output.txt").write_text(output)
    return run_dir


def test_run_directory(unbroken):
    names = {path.name for path in unbroken.iterdir()}
    assert re.fullmatch(r"Hopper-v4-sac-s0-\d{8}-\d{6}", unbroken.name)
    assert names == {
        ".lock",
        "done",
        "config.yaml",
        "versions.json",
        "metrics.csv",
        "eval.csv",
        "checkpoints",
        "card.md",
        "curve.png",
    }
    assert [path.name for path in list_checkpoints(unbroken / "checkpoints")] == [
        "checkpoint_0000000050.pt",
        "checkpoint_0000000060.pt",
    ]
    assert OmegaConf.load(unbroken / "config.yaml").optim.lr == 3e-4
    versions = json.loads((unbroken / "versions.json").read_text())
    assert versions["torch"] == torch.__version__ and versions["threads"] == 1
    assert versions["parameters"] > 0
    assert "Hopper-v4" in (unbroken / "card.md").read_text()


def test_tables_count_updates_and_frames(unbroken):
    metrics, evaluations = rows_of(unbroken / "metrics.csv"), rows_of(unbroken / "eval.csv")
    assert [int(row["updates"]) for row in metrics] == [10, 20, 30, 40, 50, 60]
    assert [int(row["frames"]) for row in metrics] == [250, 300, 350, 400, 450, 500]
    assert {"loss_qvalue", "train_return", "frames_per_second"} <= metrics[0].keys()
    assert [int(row["updates"]) for row in evaluations] == [0, 30, 60]
    assert list(evaluations[0]) == [
        "updates",
        "frames",
        "return_mean",
        "return_std",
        "num_episodes",
        "episode_length",
    ]


def test_output_says_before_and_after_and_leaves_nothing_else(unbroken):
    output = (unbroken.parents[1] / "output.txt").read_text()
    assert re.search(r"mean evaluation return: before [\d.]+, after [\d.]+", output)
    assert "updates 10/60  frames 250" in output
    assert {path.name for path in unbroken.parents[1].iterdir()} == {"runs", "output.txt"}


def test_stop_and_resume_from_the_shell_equals_never_stopping(unbroken, tmp_path):
    code, _, errors = run(*TINY_SAC, "optim.total_updates=34", "run_dir=here", cwd=tmp_path)
    assert code == 0, errors
    code, _, errors = run("resume=here", "optim.total_updates=60", cwd=tmp_path)
    assert code == 0, errors
    assert_same_state(unbroken, tmp_path / "here")
    assert without_time(unbroken / "metrics.csv") == without_time(tmp_path / "here" / "metrics.csv")


def test_ctrl_c_leaves_a_checkpoint_that_resumes(unbroken, tmp_path):
    arguments = [
        *TINY_SAC,
        "optim.total_updates=100000",
        'run_dir="env=hopper, seed=0"',  # like a directory of --multirun
        "checkpoint.interval=100000",
    ]
    here = tmp_path / "env=hopper, seed=0"
    process = start(*arguments, cwd=tmp_path)
    deadline = time.time() + 60
    while not (here / "metrics.csv").exists() and time.time() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == STOPPED, errors
    assert "Traceback" not in errors
    assert not (here / "done").exists()
    stopped, command = re.search(
        r"by SIGINT after (\d+) updates; go on with: (.+)", output
    ).groups()
    assert OmegaConf.load(here / "config.yaml").optim.total_updates == 100000
    program, script, *typed = shlex.split(command)
    assert (program, Path(script)) == ("python", SCRIPT)
    last = int(stopped) + 5
    code, output, errors = run(*typed, f"optim.total_updates={last}", cwd=tmp_path)
    assert code == 0, errors
    assert int(rows_of(here / "eval.csv")[-1]["updates"]) == last


def test_ctrl_c_leaves_a_checkpoint_where_nobody_reads_the_output(tmp_path, monkeypatch):
    """As in `... | tee log`, which Ctrl-C ends first."""
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    settings = ["optim.total_updates=100000", "checkpoint.interval=100000", "run_dir=here"]
    process = start(*TINY_SAC, *settings, cwd=tmp_path)
    here, deadline = tmp_path / "here", time.time() + 60
    while not (here / "metrics.csv").exists() and time.time() < deadline:
        time.sleep(0.05)
    process.stdout.close()
    process.send_signal(signal.SIGINT)
    errors = process.stderr.read()
    assert (process.wait(timeout=60), errors) == (STOPPED, "")
    assert int(list_checkpoints(here / "checkpoints")[-1].stem[-10:]) > 0


def test_a_second_ctrl_c_ends_the_run_at_once(tmp_path):
    process = start(*TINY_SAC, "env=halfcheetah", "eval.episodes=20", "run_dir=here", cwd=tmp_path)
    lines = iter(process.stdout.readline, "")
    assert any("run directory: here" in line for line in lines)
    time.sleep(1)  # into the first evaluation, which takes many
    process.send_signal(signal.SIGINT)
    assert any("stopping after this evaluation; Ctrl-C again quits" in line for line in lines)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "")
    assert (
        f"stopped at once after 0 updates; go on from the newest checkpoint with: python {SCRIPT}"
        in output
    )


def test_a_variant_belongs_to_rlpd_and_stays_that_of_the_run(tmp_path):
    with pytest.raises(HydraException, match="variant"):
        composed("algo=sac", "variant=wsrl")
    run_dir = train(
        composed(*TINY["rlpd"], f"run_dir={tmp_path / 'here'}", "optim.total_updates=2")
    )
    typed = [f"resume={run_dir}", "variant=wsrl"]
    with pytest.raises(RunError, match="variant.name=wsrl.*run to resume has variant.name=rlpd"):
        resumed_config(composed("algo=rlpd", *typed), typed)


def test_the_choice_of_another_method_with_the_same_loss_is_told_on_resume(tmp_path):
    run_dir = train(
        composed(*TINY["rlpd"], f"run_dir={tmp_path / 'here'}", "optim.total_updates=2")
    )
    kept = [word for word in TINY["rlpd"] if word.startswith("rlpd.")]
    typed = [f"resume={run_dir}", "algo=rlpd_wsrl", *kept]
    with pytest.raises(RunError, match="algo=... chooses has rlpd.actor_layer_norm=True, but"):
        resumed_config(composed(*typed), typed)
    typed = [f"resume={run_dir}", "algo=rlpd", *kept]
    assert resumed_config(composed(*typed), typed)[0].rlpd == composed(*TINY["rlpd"]).rlpd


def test_a_run_of_the_other_recipe_is_told_on_resume(unbroken):
    typed = [f"resume={unbroken}"]
    with pytest.raises(RunError, match="a run of another recipe, .* has the key dataset"):
        resumed_config(composed("algo=sac", *typed, name="o2o_halfcheetah"), typed)


def test_wandb_without_login_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    cfg = composed(*TINY_SAC, f"run_dir={tmp_path / 'here'}", "logger.backend=wandb")
    with pytest.raises(RunError, match="wandb"):
        train(cfg)
    assert not (tmp_path / "here").exists()


def test_a_used_run_directory_is_refused(unbroken):
    with pytest.raises(RunError, match="already holds a run"):
        train(composed(*TINY_SAC, f"run_dir={unbroken}"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["sac.num_cells=[32]"],
            r"sac.num_cells=\[32\].*run to resume has sac.num_cells=\[16, 16\]",
        ),
        (["env=ant"], "env.name=Ant-v4.*run to resume has env.name=Hopper-v4"),
        (["seed=4"], "seed=4.*run to resume has seed=0"),
    ],
)
def test_a_resume_that_changes_the_run_is_refused(unbroken, overrides, message):
    cfg = composed("algo=sac", f"resume={unbroken}", *overrides)
    with pytest.raises(RunError, match=message):
        resumed_config(cfg, overrides)


def test_an_offline_phase_without_data_is_refused(tmp_path):
    cfg = composed("algo=cql", "optim.offline_updates=5", f"run_dir={tmp_path / 'here'}")
    with pytest.raises(RunError, match="optim.offline_updates=5: expected 0.*o2o_halfcheetah.py"):
        train(cfg)
    assert not (tmp_path / "here").exists()


@pytest.mark.parametrize(
    ("total", "message"),
    [
        ("60", "already has 60 updates"),
        ("abc", "optim.total_updates='abc': expected a valid integer"),
        ("null", "optim.total_updates=None: expected a valid integer"),
    ],
)
def test_a_resume_needs_more_updates_to_make(unbroken, total, message):
    typed = [f"resume={unbroken}", f"optim.total_updates={total}"]
    with pytest.raises(RunError, match=message):
        train(*resumed_config(composed("algo=sac", *typed), typed))


def test_a_resume_with_an_edited_config_or_from_nowhere_is_refused(unbroken, tmp_path):
    cfg = composed("algo=sac", f"resume={tmp_path}")
    with pytest.raises(RunError, match="found none"):
        resumed_config(cfg, [])
    (tmp_path / "checkpoints").symlink_to(unbroken / "checkpoints")
    stored = OmegaConf.load(unbroken / "config.yaml")
    stored.sac.num_cells = [8]
    OmegaConf.save(stored, tmp_path / "config.yaml")
    with pytest.raises(RunError, match=r"config.yaml has sac.num_cells=\[8\]"):
        resumed_config(cfg, [])


@pytest.mark.parametrize("content", [None, b"", b"\x00\xff\x80", b"!!python/object:os.system {}"])
def test_a_lost_or_damaged_config_is_read_back_from_the_checkpoint(unbroken, tmp_path, content):
    here = tmp_path / "here"
    shutil.copytree(unbroken, here)
    (here / "config.yaml").unlink()
    (here / "versions.json").unlink()
    if content is not None:
        (here / "config.yaml").write_bytes(content)
    typed = [f"resume={here}", "optim.total_updates=62"]
    train(*resumed_config(composed("algo=sac", *typed), typed))
    assert OmegaConf.load(here / "config.yaml").sac.num_cells == [16, 16]
    assert "versions.json is missing or damaged" in (here / "card.md").read_text()


def test_a_table_that_is_no_file_is_told(unbroken, tmp_path):
    here = tmp_path / "here"
    shutil.copytree(unbroken, here)
    (here / "eval.csv").unlink()
    (here / "eval.csv").mkdir()
    typed = [f"resume={here}", "optim.total_updates=62"]
    with pytest.raises(RunError, match="cannot be written.*eval.csv"):
        train(*resumed_config(composed("algo=sac", *typed), typed))


DAMAGE = {
    "config": lambda content: content.pop("config"),
    "no parts": lambda content: content.pop("parts"),
    "parts is a list": lambda content: content.update(parts=[1]),
    "counters is None": lambda content: content["parts"].update(counters=None),
    "loss is None": lambda content: content["parts"].update({"agent.loss": None}),
    "buffer is None": lambda content: content["parts"].update(buffer=None),
    "wide rows": lambda content: content["parts"]["buffer"]["rows"].update(
        observation=torch.zeros(300, 99)
    ),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_checkpoint_of_another_form_is_told_in_one_message(unbroken, tmp_path, damage):
    here = tmp_path / "here"
    shutil.copytree(unbroken, here)
    path = list_checkpoints(here / "checkpoints")[-1]
    content = torch.load(path, weights_only=True)
    damage(content)
    torch.save(content, path)
    typed = [f"resume={here}", "optim.total_updates=62"]
    with pytest.raises(RunError, match="checkpoint"):
        train(*resumed_config(composed("algo=sac", *typed), typed))


def test_a_run_killed_before_its_first_checkpoint_is_started_again_by_its_command(tmp_path):
    arguments = [*TINY_SAC, "run_dir=here", "checkpoint.interval=100000"]
    process = start(*arguments, "optim.total_updates=100000", cwd=tmp_path)
    deadline = time.time() + 60
    while not (tmp_path / "here" / "eval.csv").exists() and time.time() < deadline:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    assert (tmp_path / "here" / "config.yaml").exists()
    code, _, errors = run(*TINY_SAC, "run_dir=here", cwd=tmp_path)
    assert code == 0, errors
    assert [row["updates"] for row in rows_of(tmp_path / "here" / "eval.csv")] == ["0", "30", "60"]


def test_multirun_names_its_jobs_by_their_overrides(tmp_path):
    sweep = ["seed=0,1", "optim.total_updates=2", "hydra.sweep.dir=sweep"]
    code, _, errors = run("--multirun", *TINY_SAC, *sweep, cwd=tmp_path)
    assert code == 0, errors
    jobs = sorted(path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert len(jobs) == 2
    for seed, job in enumerate(jobs):
        assert f"seed={seed}" in job.name
        assert OmegaConf.load(job / "config.yaml").seed == seed
        assert list_checkpoints(job / "checkpoints")


def test_the_name_of_a_job_with_many_overrides_is_cut():
    short, long = "a=1,b=2", ",".join(f"aca.number_{i}=0.125" for i in range(40))
    assert file_name(short) == short
    one, two = file_name(f"{long},seed=0"), file_name(f"{long},seed=1")
    assert len(one) == len(two) < 255 and one.startswith("aca.number_0=0.125,aca.number_1=")
    assert one.endswith(",seed=0") and two.endswith(",seed=1") and one[:-7] != two[:-7]


def test_total_updates_and_logger_may_change_on_resume(unbroken):
    typed = ["optim.total_updates=99", "logger.backend=none", f"resume={unbroken}"]
    cfg, checkpoint = resumed_config(composed("algo=sac", *typed), typed)
    assert cfg.optim.total_updates == 99 and cfg.logger.backend == "none"
    assert cfg.env.name == "Hopper-v4" and checkpoint["parts"]["counters"]["updates"] == 60


class Failing(gym.Env):
    """Gives a NaN reward at its 100th step."""

    observation_space = gym.spaces.Box(-1, 1, (3,))
    action_space = gym.spaces.Box(-2, 2, (2,))
    steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.steps += 1
        reward = float("nan") if self.steps == 100 else 1.0
        return np.zeros(3, np.float32), reward, self.steps % 10 == 0, False, {}


def test_nan_rewards_stop_the_run_with_a_checkpoint_that_resumes(tmp_path):
    gym.register("Failing-v0", Failing, max_episode_steps=100)
    try:
        run_dir = tmp_path / "here"
        cfg = composed(*TINY_SAC, "env.name=Failing-v0", f"run_dir={run_dir}")
        with pytest.raises(RunError, match=r"Failing-v0.*next.reward.*after 495 frames.*0059.pt"):
            train(cfg)
        assert len(checkpoint_leaves(run_dir)) > 50
        typed = [f"resume={run_dir}"]
        train(*resumed_config(composed("algo=sac", *typed), typed))
        assert rows_of(run_dir / "eval.csv")[-1]["updates"] == "60"
    finally:
        del gym.registry["Failing-v0"]


def test_updates_per_frame_are_exact():
    for ratio, frames, expected in [
        (0.2, 1000, 0),
        (0.2, 1005, 1),
        (0.2, 1000 + 5 * 10**6, 10**6),
        (0.29, 1100, 29),  # 0.29 * 100 is 28.999... in floating point
        (1, 1005, 5),
        (0.2, 500, 0),
    ]:
        cfg = configured(composed("collector.warmup_frames=1000", f"optim.utd_ratio={ratio}"))
        assert updates_due(cfg, frames) == expected


def test_wandb_offline(tmp_path):
    overrides = ["run_dir=here", "logger.backend=wandb", "logger.wandb_mode=offline"]
    code, _, errors = run(*TINY_SAC, *overrides, cwd=tmp_path)
    assert code == 0, errors
    (path,) = (tmp_path / "here").glob("wandb/offline-run-*/*.wandb")
    assert b"metrics/loss_qvalue" in path.read_bytes()
    assert len(rows_of(tmp_path / "here" / "metrics.csv")) == 6


def test_tensorboard_and_video(tmp_path):
    run_dir = tmp_path / "here"
    overrides = [f"run_dir={run_dir}", "logger.backend=tensorboard", "video.enabled=true"]
    try:
        train(composed(*TINY_SAC, *overrides))
        assert (run_dir / "video.mp4").stat().st_size > 1000
    except RunError as error:
        if "could not be rendered" not in str(error):
            raise
        pytest.skip(f"the video needs OpenGL and imageio: {error}")
    finally:
        (path,) = (run_dir / "tensorboard").glob("events.out*")
        assert b"metrics/loss_qvalue" in path.read_bytes()


def test_every_task_is_built_and_has_the_sizes_that_its_file_says():
    tasks = sorted(path.stem for path in (CONFIGS / "env").glob("*.yaml"))
    assert len(tasks) == 10
    for task in tasks:
        cfg = composed(f"env={task}")
        observation, _ = make_env(cfg.env.name).reset(seed=0)
        assert observation.dtype == np.float32
        header = (CONFIGS / "env" / f"{task}.yaml").read_text()
        sizes = re.search(r"(\d+) observations, (\d+) action", header)
        assert observation.shape == (int(sizes[1]),)
        assert make_env(cfg.env.name).action_space.shape == (int(sizes[2]),)


def test_humanoid_settings_win_over_the_algorithm_and_quickstart_over_both():
    humanoid, other = composed("env=humanoid").aca, composed().aca
    assert (humanoid.guidance_weight, other.guidance_weight) == (60, 50)
    assert (humanoid.target_entropy_scale, other.target_entropy_scale) == (0.5, 0.9)
    assert (humanoid.exploration_noise, other.exploration_noise) == (0.15, 0.1)
    assert composed(name="quickstart").optim.total_updates < composed().optim.total_updates


class Legacy(gym.Env):
    """Draws from NumPy's old generator, whose state Gymnasium's interface does not give."""

    observation_space = gym.spaces.Box(-1, 1, (3,))
    action_space = gym.spaces.Box(-1, 1, (2,))
    np_random = np.random.RandomState(0)

    def reset(self, *, seed=None, options=None):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

    def step(self, action):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), 1.0, False, False, {}


def test_an_environment_that_cannot_be_saved_is_left_out_and_said_so(tmp_path, capsys):
    gym.register("Legacy-v0", Legacy, max_episode_steps=20)
    try:
        run_dir = tmp_path / "here"
        short = ["env.name=Legacy-v0", "optim.total_updates=20", f"run_dir={run_dir}"]
        train(composed(*TINY_SAC, *short))
        said = capsys.readouterr().out
        assert "the state of Legacy-v0 cannot be saved (AttributeError" in said
        assert "a resumed run begins new episodes" in said
        typed = [f"resume={run_dir}", "optim.total_updates=30"]
        train(*resumed_config(composed("algo=sac", *typed), typed))
        assert rows_of(run_dir / "eval.csv")[-1]["updates"] == "30"
    finally:
        del gym.registry["Legacy-v0"]


@pytest.mark.parametrize(
    ("arguments", "lines"),
    [
        (("--config-name", "fast"), ["  num_target_candidates: 4", "guidance_weight: 50.0  # w"]),
        (("algo=sac",), ["seed: 0", "algo: aca, calql", "num_cells: [256, 256, 256]"]),
    ],
)
def test_help_shows_the_files_with_their_comments(arguments, lines, tmp_path):
    code, output, errors = run(*arguments, "--help", cwd=tmp_path)
    assert code == 0, errors
    for line in ("utd_ratio: 0.2  # updates per frame", *lines):
        assert line in output
