"""The 2D bandit: its reward, the counting of its modes, and what the study promises."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs.utils import check_env_specs

import bandit_2d
import bandit_beyond
import recipe_cases
from bandit import guided, rivals, tables
from bandit.config import BanditConfig, BeyondConfig, variants
from bandit.env import TwoDBandit, mode_shares, reward
from bandit.launch import begin
from recipe_cases import rows_of
from torchrl_aca.baselines import DIPOLoss
from torchrl_aca.errors import RunError
from torchrl_aca.training.config import checked

METHODS = ("aca", "diffusion_q", "langevin_q")
RIVALS = ("sdac", "qsm", "dacer", "dipo")
PAPER_SUMS = ("0.993", "0.636", "0.570", "0.927", "0.465", "1.000", "0.401")
HIGH = np.sqrt(2) * np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])  # top, right, bottom, left
SHORT = [
    "collector.frames=12000",
    "collector.warmup_frames=6000",
    "sweep.num_samples=500",
    "report.num_samples=1000",
]
TINY = [
    "seeds=[0]",
    "num_workers=1",
    "collector.frames=200",
    "collector.warmup_frames=100",
    "collector.frames_per_batch=100",
    "optim.updates_per_batch=2",
    "optim.batch_size=16",
    "critic.num_cells=[8]",
    "sweep.weights=[10,40]",
    "sweep.num_samples=50",
    "report.num_samples=50",
    *(f"rivals.{name}.updates_per_batch=2" for name in RIVALS),
    *(f"rivals.{name}.num_cells=[8]" for name in RIVALS),
]


def composed(*overrides: str, name: str = "bandit_2d") -> BanditConfig:
    return checked(BanditConfig, recipe_cases.composed(*overrides, name=name))


# --- the environment ------------------------------------------------------------------------------


def oracle_density(actions):
    """The paper's mixture as a density, mode by mode in the order of its appendix."""
    r = np.sqrt(2)
    centres = [(r, 0), (1, 1), (0, r), (-1, 1), (-r, 0), (-1, -1), (0, -r), (1, -1)]
    total = 0.0
    for index, centre in enumerate(centres):
        squares = ((actions - np.array(centre)) ** 2).sum(-1)
        weight = (2 if index % 2 == 0 else 1) / 12
        total += weight * np.exp(-squares / (2 * 0.09)) / (2 * np.pi * 0.09)
    return total


def test_reward_is_the_mixtures_density_scaled_to_one():
    actions = np.random.default_rng(0).uniform(-2.5, 2.5, (500, 2))
    line = np.linspace(-1.5, 1.5, 1501)
    highest = oracle_density(np.stack(np.meshgrid(line, line), -1)).max()
    env = TwoDBandit(500)
    data = env.reset().set("action", torch.from_numpy(actions).float())
    actual = env.step(data)["next", "reward"].squeeze(-1).numpy()
    np.testing.assert_allclose(actual, oracle_density(actions) / highest, atol=1e-5)


def test_highest_reward_is_one_and_the_low_modes_have_half():
    line = torch.linspace(-2, 2, 1001)
    assert reward(torch.cartesian_prod(line, line)).max().item() == pytest.approx(1, abs=1e-4)
    assert reward(torch.tensor([1.0, 1.0])).item() == pytest.approx(0.502, abs=1e-3)


@pytest.mark.parametrize("num_envs", [1, 7])
def test_env_keeps_its_specs_and_ends_after_one_step(num_envs):
    env = TwoDBandit(num_envs, half_width=2.5)
    check_env_specs(env)
    rollout = env.rollout(5)
    assert rollout.shape == (num_envs, 1)
    assert rollout["next", "terminated"].all()
    assert env.rand_action()["action"].abs().max() <= 2.5


def test_shares_count_what_lies_within_the_radius_in_the_papers_order():
    near = HIGH + np.array([0.29, 0.0])
    far = HIGH + np.array([0.0, 0.31])
    actions = np.concatenate([near[:1], near[:1], near[1:], far, [[1, 1]]])  # 2, 1, 1, 1 of 10
    shares = mode_shares(torch.from_numpy(actions).float())
    assert list(shares) == ["top", "right", "bottom", "left"]
    assert list(shares.values()) == pytest.approx([0.2, 0.1, 0.1, 0.1])


# --- the study ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_aca_finds_all_high_modes_with_more_samples_than_the_plain_critic():
    cfg = composed(*SHORT, "critic.num_cells=[64,64,64]", "sweep.weights=[30,40]")
    noisy, plain = (bandit_2d.run((cfg, method, 0))[0][0] for method in ("aca", "diffusion_q"))
    assert min(noisy[name] for name in ("top", "right", "bottom", "left")) > 0.15
    assert noisy["sum"] > plain["sum"] + 0.05


@pytest.mark.slow
def test_dacer_ends_in_one_mode_and_qsm_in_all_four():
    one, four = (
        bandit_2d.run((composed(*SHORT, "methods=all"), name, 0))[0][0] for name in ("dacer", "qsm")
    )
    assert max(one[name] for name in ("top", "right", "bottom", "left")) > 0.95
    assert min(four[name] for name in ("top", "right", "bottom", "left")) > 0.1


@pytest.mark.parametrize("method", RIVALS)
def test_rivals_measure_chains_without_exploration_noise(method):
    """Noise so large that none of it can be in what is measured."""
    cfg = composed(*TINY, "methods=all", f"rivals.{method}.exploration_noise=100")
    actor = rivals.train(cfg, method, 0)
    assert bandit_2d.draw(actor, 50).abs().max() <= 2
    noisy = actor.sample(torch.zeros(50, 1))
    assert noisy.abs().max() > 10


def test_a_method_and_a_seed_give_the_same_numbers_whatever_ran_before():
    cfg = composed(*TINY, "methods=all")
    (alone,), _, _ = bandit_2d.run((cfg, "qsm", 0))
    bandit_2d.run((cfg, "dacer", 1))
    (again,), _, _ = bandit_2d.run((cfg, "qsm", 0))
    assert alone == again


def test_dipo_keeps_its_best_actions_in_the_box_of_the_random_ones(monkeypatch):
    seen = []
    improve = DIPOLoss.improve
    monkeypatch.setattr(
        DIPOLoss, "improve", lambda self, data: seen.append(improve(self, data)) or seen[-1]
    )
    rivals.train(composed(*TINY, "rivals.dipo.loss.num_gradient_steps=40"), "dipo", 0)
    assert 1.2 < torch.cat(seen).abs().max() <= 2


def test_settings_of_a_rival_that_is_left_out_are_asked_for():
    settings = OmegaConf.to_container(recipe_cases.composed("methods=all", name="bandit_2d"))
    del settings["rivals"]["qsm"]
    with pytest.raises(RunError, match="expected settings of .'qsm'. as well"):
        checked(BanditConfig, settings)


def test_weight_is_chosen_by_reward_alone(monkeypatch):
    measured = iter([{"sum": 0.9, "reward_mean": 0.1}, {"sum": 0.1, "reward_mean": 0.9}])
    monkeypatch.setattr(guided, "measure", lambda actions: next(measured))
    cfg = composed(*TINY)
    actor = guided.make_actor(cfg, "aca")
    guided.sweep(cfg, actor)
    assert actor.guidance_weight == 40


@pytest.mark.parametrize("data", ["uniform", "online"])
def test_data_comes_from_the_box_or_from_the_method_as_well(data, monkeypatch):
    seen = []
    transitions = guided.transitions
    monkeypatch.setattr(
        guided, "transitions", lambda data: seen.append(data["action"]) or transitions(data)
    )
    bandit_2d.train(composed(*TINY, f"data={data}"), "langevin_q", 0)
    outside = [bool((actions.abs() > 2).any()) for actions in seen]
    assert outside == [False, data == "online"]


TABLES = {"table.csv", "seeds.csv", "sweep.csv", "config.yaml", "card.md"}
GUIDED_FIGURES = {"reward.png", "samples.png", "sensitivity.png", "value_maps.png", "steps.gif"}
RIVAL_FIGURES = {"samples_rivals.png", "steps_rivals.gif"}


@pytest.mark.parametrize(
    ("typed", "methods", "figures"),
    [
        ([], METHODS, GUIDED_FIGURES),
        (["methods=all"], (*METHODS, *RIVALS, "nclql"), GUIDED_FIGURES | RIVAL_FIGURES),
        (["methods=[qsm,dacer]"], ("qsm", "dacer"), RIVAL_FIGURES | {"reward.png"}),
    ],
    ids=["default", "all", "rivals"],
)
def test_command_writes_all_its_files(typed, methods, figures, tmp_path):
    typed = [*TINY, *typed, "run_dir=run"]
    code, output, errors = recipe_cases.run(*typed, cwd=tmp_path, recipe="bandit_2d")
    assert code == 0, errors
    steps = {f"steps_{method}.png" for method in methods}
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == figures | steps | TABLES - (set() if "aca" in methods else {"sweep.csv"})
    table = rows_of(tmp_path / "run" / "table.csv")
    sums = dict(zip(METHODS + RIVALS, PAPER_SUMS, strict=True))
    compared = [method for method in methods if method in sums]  # NC-LQL is not in the paper
    assert [row["source"] for row in table].count("here, 1 seeds") == len(methods)
    papers = [row["sum"] for row in table if row["source"] == "paper"]
    assert papers == [sums[method] for method in compared]
    if "aca" in methods:
        swept = {row["method"] for row in rows_of(tmp_path / "run" / "sweep.csv")}
        assert swept == set(methods) - set(RIVALS)
    assert table[0]["method"] in output and f"{len(methods)}/{len(methods)}" in errors


def test_ablation_has_a_row_for_each_combination(tmp_path):
    changes = ["methods=[aca]", "ablation.training.data=[uniform,online]"]
    bandit_2d.ablate(composed(*TINY, *changes, name="bandit_2d_ablation"), tmp_path)
    table = rows_of(tmp_path / "ablation.csv")
    keys = ("chain.schedule", "data", "clip_denoised", "normalize_gradient")
    values = [("linear", "cosine"), ("uniform", "online"), ("False", "2.0"), ("True", "False")]
    expected = list(itertools.product(*values))
    assert [tuple(row[key] for key in keys) for row in table] == expected
    compact = rows_of(tmp_path / "ablation_table.csv")
    assert [tuple(row[key] for key in keys) for row in compact] == expected
    assert [float(row["ACA sum"]) for row in compact] == [
        pytest.approx(float(row["sum"]), abs=1e-3) for row in table
    ]


def test_an_ablation_is_the_same_on_several_processes(tmp_path):
    changes = ["methods=[aca]", "seeds=[0,1]", "+ablation.training={data: [uniform, online]}"]
    written = []
    for num_workers in (1, 2):
        folder = tmp_path / str(num_workers)
        folder.mkdir()
        cfg = composed(*TINY, *changes, f"num_workers={num_workers}")
        bandit_2d.ablate(cfg, folder)
        written.append(rows_of(folder / "ablation.csv"))
    assert written[0] == written[1]
    found = [(row["data"], row["seed"]) for row in written[0]]
    assert found == [("uniform", "0"), ("uniform", "1"), ("online", "0"), ("online", "1")]
    sums = [float(row["sum"]) for row in written[0]]
    (uniform, online) = rows_of(folder / "ablation_table.csv")
    assert float(uniform["ACA sum"]) == pytest.approx((sums[0] + sums[1]) / 2, abs=1e-3)
    assert float(online["ACA sum"]) == pytest.approx((sums[2] + sums[3]) / 2, abs=1e-3)


def test_a_table_has_the_means_over_seeds():
    numbers = dict.fromkeys(tables.NUMBERS, 0.5)
    runs = [
        {"method": "aca", "weight": weight, **numbers, "sum": total}
        for weight, total in ((10.0, 0.2), (40.0, 0.4))
    ]
    mean, paper = tables.summary(runs)
    assert (mean["method"], mean["source"], mean["sum"]) == ("ACA", "here, 2 seeds", "0.300")
    assert (mean["lowest_sum"], mean["highest_sum"], mean["w"]) == ("0.200", "0.400", "10 40")
    assert (paper["source"], paper["sum"]) == ("paper", "0.993")


def test_the_study_beyond_tells_the_automatic_weight_from_the_sweeps_best(tmp_path):
    composed = recipe_cases.composed(*TINY, name="bandit_beyond")
    settings = OmegaConf.to_container(composed)
    training = {"beyond.reward_scale": [1.0, 10.0], "collector.guidance_weight.aca": [5.0]}
    settings["ablation"]["training"] = training
    cfg = checked(BeyondConfig, settings)
    bandit_beyond.study(cfg, tmp_path)
    guidance = rows_of(tmp_path / "guidance.csv")
    assert [row["beyond.reward_scale"] for row in guidance] == ["1.0", "10.0"]
    for row in guidance:
        assert float(row["best w"]) in (10, 40) and float(row["auto w"]) not in (5, 10, 40)
    soft = rows_of(tmp_path / "soft.csv")  # of the first combination, where no reward exceeds 1
    assert [float(row["tau"]) for row in soft] == cfg.beyond.temperatures
    for name in ("critic", "reward", "reward, all candidates at once"):
        values = [float(row[name]) for row in soft]
        assert values == sorted(values, reverse=True)  # from the largest value to the mean
    assert all(0 <= float(row["reward"]) <= 1 for row in soft)


def test_the_ablation_has_a_configuration_for_each_training():
    cfg = composed(name="bandit_2d_ablation")
    made = variants(cfg)
    assert [(v.chain.schedule, v.data) for _, v in made] == [
        tuple(changed.values()) for changed, _ in made
    ]
    assert len({(v.chain.schedule, v.data) for _, v in made}) == 4
    actor = guided.make_actor(cfg, "aca")
    assert all(hasattr(actor, name) for name in cfg.ablation.samplings()[0])


def test_studies_of_the_same_second_never_share_a_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda form: "now")
    made = [begin(composed(), "bandit_2d") for _ in range(3)]
    assert [path.name for path in made] == ["bandit_2d-now", "bandit_2d-now-2", "bandit_2d-now-3"]
    with pytest.raises(RunError, match="bandit_2d-now-2 already holds a study"):
        begin(composed(f"run_dir={made[1]}"), "bandit_2d")


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data=offline", "data='offline': expected 'online' or 'uniform'"),
        ("chain.schedule=quadratic", "chain.schedule='quadratic': expected 'linear', 'cosine' or"),
        ("methods=[sac]", "methods.0='sac': expected 'aca', 'diffusion_q', 'langevin_q', 'sdac'"),
        ("methods=every", "methods='every': expected a valid list"),
        ("rivals.qsm.lr=0", "rivals.qsm.lr=0: expected greater than 0"),
        ("rivals.qsm.schedule=steep", "rivals.qsm.schedule='steep': expected 'linear', 'cosine'"),
        ("+rivals.sdac.chosen.num_proposals=9", "rivals.sdac.chosen={'inverse_temperature': "),
        ("methods=[]", "methods=[]: expected"),
        ("seeds=[]", "seeds=[]: expected"),
        ("seeds=[0,1,0]", "seeds=[0, 1, 0]: expected each of them once"),
        ("methods=[aca,aca]", "methods=['aca', 'aca']: expected each of them once"),
        ("seeds=0", "seeds=0: expected a valid list"),
        ("collector.frames=30001", "collector.frames=30001: expected a multiple of"),
        ("collector.frames_per_batch=0", "collector.frames_per_batch=0: expected greater than"),
        ("collector.guidance_weight=5", "collector.guidance_weight=5: expected"),
        ("~collector.guidance_weight.aca", "expected a weight for ['aca'] as well"),
        ("chain.num_steps=abc", "chain.num_steps='abc': expected a valid integer"),
        ("chain.clip_denoised=true", "chain.clip_denoised=True: expected false, or a number above"),
        ("chain.clip_denoised=-1", "chain.clip_denoised=-1: expected false, or a number above 0"),
        ("chain.linear=5", "chain.linear=5: expected a section"),
        ("optim.lr=abc", "optim.lr='abc': expected a valid number"),
        ("optim.lr=nan", "optim.lr=nan: expected a finite number"),
        ("critic.num_cells=5", "critic.num_cells=5: expected a valid list"),
        ("sweep.weights=[10,-1]", "sweep.weights.1=-1: expected greater than or equal to 0"),
        ("run_dir=5", "run_dir=5: expected a valid string"),
        ("+speed=3", "speed=3: there is no such key"),
        ("+ablation.sampling.speed=[3]", "ablation.sampling.speed=[3]: there is no such key"),
        ("+ablation.sampling.clip_denoised=[x]", "clip_denoised.0='x': expected false, or"),
        ("+ablation.training={optim.lr: 3}", "ablation.training.optim.lr=3: expected a valid list"),
        ("+ablation.training={optim.lr: [x]}", "optim.lr='x': expected a valid number"),
        ("+ablation.training={optim.rate: [3]}", "optim.rate=3: there is no such key"),
    ],
)
def test_wrong_settings_are_told_before_any_work(override, message):
    with pytest.raises(RunError, match=re.escape(message)):
        variants(composed(override))


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("bandit_2d_ablation", "methods=[aca,dacer]", "guided samplers alone, without .'dacer'"),
        ("bandit_2d_ablation", "methods=[aca,nclql]", "no 'nclql', which does not see the chain"),
        ("bandit_beyond", "methods=[langevin_q]", "methods.0='langevin_q': expected 'aca'"),
    ],
)
def test_methods_that_a_study_cannot_compare_are_refused(name, override, message):
    schema = BeyondConfig if name == "bandit_beyond" else BanditConfig
    with pytest.raises(RunError, match=message):
        checked(schema, recipe_cases.composed(override, name=name))


def test_samplings_alone_are_an_ablation(tmp_path):
    typed = [*TINY, "methods=[aca]", "+ablation.sampling.normalize_gradient=[true,false]"]
    code, _, errors = recipe_cases.run(*typed, "run_dir=run", cwd=tmp_path, recipe="bandit_2d")
    assert code == 0, errors
    rows = rows_of(tmp_path / "run" / "ablation.csv")
    assert [row["normalize_gradient"] for row in rows] == ["True", "False"]


def test_a_mistake_ends_in_one_message_and_leaves_nothing(tmp_path):
    code, _, errors = recipe_cases.run("optim.lr=abc", cwd=tmp_path, recipe="bandit_2d")
    assert code == 1 and not list(tmp_path.iterdir())
    assert errors == "error: optim.lr='abc': expected a valid number. Set it with optim.lr=... .\n"
