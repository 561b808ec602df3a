"""Mistakes in a configuration: told before any work, with the key, what was expected and got."""

from __future__ import annotations

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from agents import AGENTS, configured
from data.config import OfflineToOnlineConfig
from online_mujoco import train
from recipe_cases import CONFIGS, TINY, composed, run
from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Positive, RunConfig, Section, checked, override

REFUSED = [
    ("aca.guidance_weight=abc", "aca.guidance_weight='abc': expected a valid number"),
    ("aca.guidance_weight=null", "aca.guidance_weight=None: expected a valid number"),
    ("aca.guidance_weight=inf", "aca.guidance_weight=inf: expected a finite number"),
    ("aca.guidance_weight=true", "aca.guidance_weight=True: expected a valid number"),
    ("aca.guidance_weight=-1", "expected greater than or equal to 0"),
    ("aca.guidance_weight_init=0", "aca.guidance_weight_init=0: expected greater than 0"),
    ("aca.guidance_weight_init=auto", "aca.guidance_weight_init='auto': expected a valid number"),
    ("aca.guidance_weight_lr=0", "aca.guidance_weight_lr=0: expected greater than 0"),
    ("aca.target_value=mean", "aca.target_value='mean': expected 'best' or 'soft'"),
    ("aca.temperature=0", "aca.temperature=0: expected greater than 0"),
    ("aca.num_cells=5", "aca.num_cells=5: expected a valid list"),
    ("aca.num_cells=null", "aca.num_cells=None: expected a valid list"),
    ("aca.num_cells=[]", "aca.num_cells=.*at least 1 item"),
    ("aca.num_cells=[8,0]", "aca.num_cells.1=0: expected greater than or equal to 1"),
    ("aca.target_entropy_scale=abc", "aca.target_entropy_scale='abc'"),
    ("aca.target_entropy_scale=nan", "aca.target_entropy_scale=nan: expected a finite number"),
    ("aca.exploration_noise=abc", "aca.exploration_noise='abc'"),
    ("aca.exploration_noise=1e10", "expected less than or equal to 1000"),
    ("aca.exploration_noise=inf", "aca.exploration_noise=inf"),
    ("aca.alpha_init=abc", "aca.alpha_init='abc'"),
    ("aca.alpha_init=inf", "aca.alpha_init=inf: expected a finite number"),
    ("aca.alpha_init=0", "aca.alpha_init=0: expected greater than 0"),
    ("aca.reward_scale=abc", "aca.reward_scale='abc'"),
    ("aca.reward_scale=null", "aca.reward_scale=None"),
    ("aca.reward_scale=nan", "aca.reward_scale=nan"),
    ("aca.reward_scale=inf", "aca.reward_scale=inf"),
    ("aca.first_level=true", "aca.first_level=True: expected a valid integer"),
    ("aca.first_level=3", "aca.first_level=3: expected less than or equal to 1"),
    ("aca.num_steps=100000000", "aca.num_steps=100000000: expected less than or equal to 1000"),
    ("aca.num_inference_steps=30", r"num_inference_steps=30: expected at most aca.num_steps \(20"),
    ("aca.inference_levels=[1,5,3,20]", r"inference_levels=\[1, 5, 3, 20\]: expected rising"),
    ("aca.inference_levels=[1,5]", r"rising integers from 1 to aca.num_steps \(20\)"),
    ("aca.inference_levels=[1,2.5,20]", "aca.inference_levels.1=2.5: expected a valid integer"),
    ("aca.noise_level_interval=0", "noise_level_interval=0: expected greater than"),
    ("aca.num_candidates=-1", "num_candidates=-1"),
    ("aca.schedule=steep", "aca.schedule='steep': expected 'cosine', 'linear' or 'vp'"),
    ("optim.lr=0", "optim.lr=0: expected greater than 0"),
    ("optim.lr_decay_start=abc", "optim.lr_decay_start='abc'"),
    ("optim.lr_decay_start=nan", "optim.lr_decay_start=nan"),
    ("optim.lr_decay_end=10", r"lr_decay_end=10.0: expected at least optim.lr_decay_start \(25000"),
    ("optim.total_updates=abc", "optim.total_updates='abc': expected a valid integer"),
    ("optim.total_updates=null", "optim.total_updates=None: expected a valid integer"),
    ("optim.utd_ratio=1e-12", "optim.utd_ratio=1e-12: expected greater than or equal to 0.0001"),
    ("optim.utd_ratio=0", "optim.utd_ratio=0"),
    ("optim.batch_size=2.5", "optim.batch_size=2.5: expected a valid integer"),
    ("optim.gamma=1.5", "optim.gamma=1.5: expected less than or equal to 1"),
    ("optim.tau=x", "optim.tau='x'"),
    ("env.name=null", "env.name=None: expected a valid string"),
    ("env.name=5", "env.name=5: expected a valid string"),
    ("env.kwargs=5", "env.kwargs=5: expected a valid dictionary"),
    ("env.wrappers=[ClipReward]", "env.wrappers.0='ClipReward': expected a section"),
    ("env.wrappers=[{min: 0}]", "env.wrappers.0.name is missing"),
    ("algo.name=sac", "algo.name=sac: .* no section 'sac'.*algo=sac"),
    ("algo.name=dqn", "algo.name='dqn': expected one of .*'sac'"),
    ("seed=99999999999", "seed=99999999999: expected less than"),
    ("seed=-1", "seed=-1: expected greater than or equal to 0"),
    ("seed=10003", "eval.seed=10000: expected seeds apart from the training's 10003 to 10007"),
    ("num_threads=1000000000", "num_threads=1000000000: expected less than or equal to"),
    ("num_threads=0", "num_threads=0"),
    ("buffer.capacity=1000000000000000", "buffer.capacity=1000000000000000: expected less than"),
    ("buffer.capacity=8", r"buffer.capacity=8: expected at least optim.batch_size \(256\)"),
    ("device=meta", "device='meta': expected .*auto"),
    ("logger=csv", "logger='csv': expected a section with keys of its own"),
    ("logger.backend=paper", "logger.backend='paper': expected 'csv', 'wandb'"),
    ("compile=abc", "compile='abc': expected a valid boolean"),
    ("eval.random=abc", "eval.random='abc': expected a valid boolean"),
    ("eval.episodes=0", "eval.episodes=0"),
    ("eval.stop_return=high", "eval.stop_return='high'"),
    ("eval.draws=few", "eval.draws='few': expected 'fresh' or 'fixed'"),
    ("video.enabled=abc", "video.enabled='abc': expected a valid boolean"),
    ("matmul_precision=fast", "matmul_precision='fast': expected 'highest', 'high' or 'medium'"),
    ("collector.warmup=expert", "collector.warmup='expert': expected 'random' or 'policy'"),
    ("collector.warmup_frames=5", "collector.warmup_frames=5: expected at least optim.batch_size"),
    ("collector.warmup_frames=30002", "a multiple of collector.frames_per_batch"),
    ("collector.frames_per_batch=7", "a multiple of collector.num_envs"),
    ("+new.key=1", r"new=\{'key': 1\}: there is no such key"),
    ("+aca.new=1", "aca.new=1: there is no such key"),
    ("~eval", "eval is missing from the configuration"),
    ("~optim.lr", "optim.lr is missing from the configuration"),
    ("env.name=???", r"env.name=\?\?\?: expected a value"),
]


@pytest.mark.parametrize(("override", "message"), REFUSED, ids=[case[0] for case in REFUSED])
def test_a_mistake_is_told_with_key_expected_and_got(override, message):
    with pytest.raises(RunError, match=message):
        configured(composed(override))


BESIDE = [
    (
        "aca.guidance_weight=auto",
        "aca.num_target_candidates=1",
        "num_target_candidates=1: expected at least 2 beside aca.guidance_weight=auto",
    ),
    (
        "aca.inference_levels=[1,5,20]",
        "aca.num_inference_steps=8",
        r"aca.num_inference_steps=8: expected aca.num_steps \(20\) or 3, the number of",
    ),
    ("algo=rlpd", "rlpd.subset_size=11", r"at most rlpd.num_qvalue_nets \(10\)"),
    ("algo=rlpd", "rlpd.init=zeros", "rlpd.init='zeros': expected 'xavier_uniform' or"),
    ("algo=rlpd", "optim.actor_lr=0", "optim.actor_lr=0: expected greater than 0"),
    ("algo=rlpd", "rlpd.actor_interval=0.5", "rlpd.actor_interval=0.5: expected a valid integer"),
    ("algo=qsm", "qsm.sampler=mala", "qsm.sampler='mala': expected 'langevin' or 'denoising'"),
    ("algo=qsm", "qsm.score_scale=0", "qsm.score_scale=0: expected greater than 0"),
    ("algo=qsm", "qsm.gradient_of=max", "qsm.gradient_of='max': expected 'min' or 'mean'"),
    ("algo=qsm", "qsm.linear_scale=2", "qsm.linear_scale=2: expected less than or equal to 1"),
    ("algo=qsm", "qsm.activation=Tanh", "qsm.activation='Tanh': expected 'Mish', 'ReLU' or 'GELU'"),
    ("algo=qvpo", "qvpo.num_candidates=1", "num_candidates=1: expected at least 2, as one has no"),
    ("algo=qvpo", "qvpo.weight=rank", "qvpo.weight='rank': expected 'advantage' or 'cutoff'"),
    (
        "algo=qvpo",
        "qvpo.num_uniform=-1",
        "qvpo.num_uniform=-1: expected greater than or equal to 0",
    ),
    ("algo=qvpo", "variant=qsm", "qvpo.weight is missing from the configuration"),
    ("algo=sdac", "sdac.num_proposals=0", "sdac.num_proposals=0: expected greater than or equal"),
    ("algo=sdac", "sdac.initial_scale=0", "sdac.initial_scale=0: expected greater than 0"),
    ("algo=sdac", "sdac.actor_interval=0", "sdac.actor_interval=0: expected greater than or equal"),
    ("algo=sdac", "optim.lr_decay_end=10", r"expected at least optim.lr_decay_start \(25000"),
    ("algo=cql", "cql.subset_size=11", r"at most cql.num_qvalue_nets \(10\)"),
    ("algo=cql", "cql.log_std_max=-20", r"expected at least cql.log_std_min"),
    ("algo=cql", "cql.weight=-1", "cql.weight=-1: expected greater than or equal to 0"),
    ("algo=cql", "cql.num_actions=0", "cql.num_actions=0: expected greater than or equal to 1"),
    ("algo=calql", "calql.tail=none", "calql.tail='none': expected 'truncate', 'mask' or"),
    ("algo=wsrl", "wsrl.actor_interval=0", "wsrl.actor_interval=0: expected greater than"),
    ("algo=iql", "iql.expectile=1", "iql.expectile=1: expected less than 1"),
    ("algo=iql", "iql.subset_size=11", r"at most iql.num_qvalue_nets \(10\)"),
    ("algo=sac", "sac.activation=Foo", "sac.activation='Foo': expected 'Mish', 'ReLU' or 'GELU'"),
    ("algo=sac", "sac.num_cells=[0]", "sac.num_cells.0=0"),
    (
        "algo=sac",
        "sac.log_std_max=-30",
        r"sac.log_std_max=-30.0: expected at least sac.log_std_min",
    ),
]


@pytest.mark.parametrize(("setting", "override", "message"), BESIDE)
def test_a_mistake_beside_another_setting_is_told_as_well(setting, override, message):
    with pytest.raises(RunError, match=message):
        configured(composed(setting, override))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("offline_fraction=1.5", "offline_fraction=1.5: expected less than or equal to 1"),
        ("offline_fraction=half", "offline_fraction='half'"),
        ("dataset=5", "dataset=5: expected a valid string"),
        ("utd=0", "utd=0: expected greater than"),
        ("utd=abc", "utd='abc': expected a valid number"),
        ("online_frames=0", "online_frames=0: expected greater than or equal to 1"),
        ("online_frames=abc", "online_frames='abc'"),
        ("generate=yes", "generate='yes': expected a valid dictionary"),
        ("offline_updates=-1", "offline_updates=-1: expected greater than or equal to 0"),
        ("pretrained=5", "pretrained=5: expected a valid string"),
    ],
)
def test_a_mistake_in_the_recipe_with_offline_data_is_told(override, message):
    with pytest.raises(RunError, match=message):
        configured(composed(override, name="o2o_halfcheetah"), OfflineToOnlineConfig)


def test_a_value_of_several_types_is_named_by_its_key_alone():
    class Several(Section):
        choice: int | list[Positive]

    with pytest.raises(RunError) as told:
        checked(Several, {"choice": [1.0, -1.0]})
    first, second = str(told.value).split("\n")
    assert first.startswith("choice=[1.0, -1.0]: expected a valid integer")
    assert second.strip().startswith("choice.1=-1.0: expected greater than 0")


def test_all_mistakes_are_told_at_once():
    with pytest.raises(RunError) as caught:
        configured(composed("optim.lr=0", "aca.num_cells=5", "compile=abc"))
    message = str(caught.value)
    assert all(key in message for key in ("optim.lr=0", "aca.num_cells=5", "compile='abc'"))


def test_every_configuration_is_a_valid_one():
    names = sorted(path.stem for path in (CONFIGS / "env").glob("*.yaml"))
    assert len(names) == 10
    for env in names:
        for algo in AGENTS:
            cfg = configured(composed(f"env={env}", f"algo={algo}"))
            assert cfg.algo.name == algo and isinstance(cfg, RunConfig)
    configured(composed(name="dataset_sac"))
    assert configured(composed(name="fast")).aca.num_inference_steps == 10
    for algo in AGENTS:
        assert configured(composed(f"algo={algo}", name="quickstart")).optim.total_updates == 3000
    for variant in ("qsm_authors", "qvpo_sdac_repo"):
        algo = variant.partition("_")[0]
        cfg = configured(composed(f"algo={algo}", f"variant={variant}"))
        assert cfg.variant.name == variant
    for algo in ("aca", "rlpd"):
        cfg = composed(f"algo={algo}", name="o2o_quickstart")
        assert configured(cfg, OfflineToOnlineConfig).optim.total_updates == 3000


def test_the_quickstart_of_a_method_has_what_its_file_says():
    files = sorted((CONFIGS / "quickstart").glob("*.yaml"))
    assert {"aca", "qsm", "qvpo", "sdac"} <= {file.stem for file in files} <= set(AGENTS)
    for file in files:
        cfg = composed(f"algo={file.stem}", name="quickstart")
        assert OmegaConf.merge(cfg, OmegaConf.load(file)) == cfg
    chosen = composed("algo=qsm", "qsm.score_scale=3", name="quickstart")
    assert chosen.qsm.score_scale == 3


def test_updates_follow_from_the_online_frames_unless_they_are_given():
    for overrides, updates in (
        (["utd=4", "online_frames=1000"], 4000),
        (["utd=0.29", "online_frames=100"], 29),  # 0.29 * 100 is 28.999... in floating point
        (["utd=4", "optim.total_updates=7"], 7),
    ):
        cfg = configured(composed(*overrides, name="o2o_halfcheetah"), OfflineToOnlineConfig)
        assert cfg.optim.total_updates == updates


@pytest.mark.parametrize("override", ["optim.batch_sise=3", "env=typo", "algo=typo", "envv=hopper"])
def test_hydra_refuses_names_that_do_not_exist(override):
    with pytest.raises(HydraException):
        composed(override)


@pytest.mark.parametrize(
    "override", ["aca.guidance_weight=abc", "optim.batch_sise=3", "env=typo", "~eval", "+new.key=1"]
)
def test_from_the_shell_a_mistake_is_one_message(override, tmp_path):
    code, output, errors = run(override, cwd=tmp_path)
    assert code == 1 and "Traceback" not in errors + output
    assert override.split("=")[0].lstrip("+~").split(".")[0] in errors
    assert not list(tmp_path.iterdir())


def test_a_renderer_that_is_not_there_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    code, _, errors = run(*TINY["sac"], "optim.total_updates=1", cwd=tmp_path)
    if code == 0:
        pytest.skip("this machine has OSMesa")
    assert "Traceback" not in errors and "MUJOCO_GL='osmesa'" in errors


def test_a_value_that_only_a_part_can_refuse_is_told_before_a_directory_is_made(tmp_path):
    for overrides, message in (
        (["env.name=Nowhere-v0"], "Nowhere-v0.*cannot be made"),
        (["env.name=CartPole-v1"], r"CartPole-v1 has the action space Discrete\(2\)"),
        (["env=hopper", "device=cuda:99"], "device=cuda:99"),
        (["env=hopper", "cudagraphs=true"], "cudagraphs=true: expected device=cuda, got cpu"),
    ):
        cfg = composed("algo=sac", f"run_dir={tmp_path / 'here'}", *overrides)
        with pytest.raises(RunError, match=message):
            train(cfg)
        assert not (tmp_path / "here").exists()


@pytest.mark.parametrize(
    "value",
    [
        "runs/a-b.c",
        "here",
        "null",
        "2024",
        "1e3",
        ".5",
        "/a/env=hopper,seed=0",
        "/a b/(x)",
        "ü#&~",
        "it's",
        'a"b',
        "a\\",
        'a\\"b',
        "a\\b",
    ],
)
def test_an_override_has_its_value_whatever_the_characters(value):
    typed = override("run_dir", value)
    assert composed(typed).run_dir == value
    assert typed == f"run_dir={value}" or typed[8] == typed[-1] == '"'
