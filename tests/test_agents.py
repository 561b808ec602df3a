"""What every algorithm of the recipes promises: one battery over `AGENTS`."""

from __future__ import annotations

import copy
import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from torchrl.objectives import SoftUpdate

from agents import AGENTS, configured, make_agent
from agents.sac import make_loss, qvalue_loss
from online_mujoco import train
from recipe_cases import (
    CONFIGS,
    TINY,
    assert_same_state,
    batch_of,
    composed,
    rows_of,
    without_time,
)
from torchrl_aca.baselines import make_gaussian_policy
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.policy import PolicyBuilder
from torchrl_aca.training.resume import resumed_config

CPU = torch.device("cpu")
EVERY = sorted(AGENTS)
VARIANTS = [
    *((algo, []) for algo in EVERY),
    ("aca", ["aca.guidance_weight=auto", "aca.target_value=soft"]),
    ("dacer", ["variant=dacer_sdac_repo"]),
    ("dipo", ["variant=dipo_sdac_repo"]),
    ("rlpd", ["variant=wsrl"]),
    ("qsm", ["variant=qsm_authors"]),
    ("qvpo", ["variant=qvpo_sdac_repo"]),
]
HUMANOID_PARAMETERS = {
    "aca": 475_746,
    "dacer": 707_909,
    "dipo": 710_419,
    "nclql": 475_746,  # not in the table, but the network of ACA
    "qsm": 702_227,
    "qvpo": 707_395,
    "sac": 702_244,
    "sdac": 707_395,
}  # of the paper's table
# What learns the bandit in seconds; the methods' own constants are slow and safe.
CQL_BANDIT = ["optim.lr=1e-2", "optim.actor_lr=1e-2", "cql.alpha_init=0.3", "cql.weight=0.1"]
BANDIT = {
    "aca": [
        "aca.num_cells=[64,64]",
        "aca.num_steps=20",
        "aca.num_candidates=32",
        "aca.reward_scale=1",
    ],
    # Little noise and a slow policy: what a wrong critic drives to the bounds stays there.
    "dacer": [
        "variant=dacer_sdac_repo",
        "optim.lr=1e-2",
        "optim.actor_lr=1e-3",
        "dacer.num_cells=[64,64]",
        "dacer.linear_scale=0.01",
        "dacer.initial_scale=0.1",
    ],
    "dipo": [  # every batch is new, so an action has one update to become the best
        "optim.lr=1e-2",
        "optim.actor_lr=1e-2",
        "dipo.num_cells=[64,64]",
        "dipo.num_steps=20",
        "dipo.num_gradient_steps=30",
        "dipo.action_lr=0.06",
    ],
    "nclql": ["optim.lr=1e-2", "nclql.num_cells=[64,64]", "nclql.num_steps=9"],
    "qsm": [
        "optim.lr=1e-2",
        "optim.actor_lr=1e-2",
        "qsm.num_cells=[64,64,64]",
        "qsm.num_steps=20",
        "qsm.num_candidates=32",
    ],
    "qvpo": ["optim.lr=1e-2", "optim.actor_lr=1e-2", "qvpo.num_candidates=32"],
    "rlpd": ["optim.lr=1e-2", "optim.actor_lr=1e-2", "rlpd.alpha_init=0.3"],
    "sac": ["optim.lr=1e-2", "sac.num_cells=[64,64]", "sac.alpha_init=0.3", "sac.reward_scale=1"],
    "sdac": ["optim.lr=1e-2", "optim.actor_lr=1e-2", "sdac.num_candidates=32"],
    "cql": [*CQL_BANDIT, "cql.gap_threshold=null"],
    "calql": CQL_BANDIT,
    "wsrl": [*CQL_BANDIT, "wsrl.actor_interval=1"],
    "iql": ["optim.lr=1e-2"],
}


def built(algo: str, *overrides: str, env: str = "inverted_pendulum", seed: int = 0, tiny=True):
    sizes = TINY[algo] if tiny else [f"algo={algo}"]
    cfg = configured(composed(*sizes, f"env={env}", *overrides))
    torch.manual_seed(seed)
    return make_agent(cfg, make_vector_env(cfg.env.name, 1, 0), CPU)


def update(agent, numbers) -> list[TensorDict]:
    metrics = []
    for number in numbers:
        torch.manual_seed(number)  # what the loop's checkpoint restores
        metrics.append(agent.update(agent.offline_rows_of(batch_of(number))))
    return metrics


def test_the_battery_covers_every_algorithm_and_its_configuration():
    assert EVERY == sorted(TINY) == sorted(BANDIT)
    names = {path.stem for path in (CONFIGS / "algo").glob("*.yaml")}
    assert names == {*EVERY, "rlpd_wsrl"}  # another name for a variant of RLPD


@pytest.fixture(scope="module", params=VARIANTS, ids=lambda case: "-".join([case[0], *case[1]]))
def unbroken(request, tmp_path_factory):
    """A finished tiny run of an algorithm, and the settings that made it."""
    algo, variant = request.param
    run_dir = tmp_path_factory.mktemp(algo) / "unbroken"
    settings = [*TINY[algo], *variant]
    train(composed(*settings, f"run_dir={run_dir}"))
    return run_dir, settings


def test_it_trains_and_logs_finite_losses(unbroken):
    run_dir, _ = unbroken
    rows = rows_of(run_dir / "metrics.csv")
    losses = [name for name in rows[-1] if name.startswith("loss_")]
    # A loss that is not there in every update leaves some rows empty, but never all of them.
    values = {name: [float(row[name]) for row in rows if row[name]] for name in losses}
    assert losses and all(values.values())
    assert all(math.isfinite(value) for column in values.values() for value in column)
    assert rows_of(run_dir / "eval.csv")[-1]["updates"] == "60"


def test_the_same_seed_gives_the_same_run_and_another_one_another(unbroken, tmp_path):
    run_dir, settings = unbroken
    again = train(composed(*settings, f"run_dir={tmp_path / 'again'}"))
    assert_same_state(run_dir, again)
    for table in ("metrics.csv", "eval.csv"):
        assert without_time(run_dir / table) == without_time(again / table)
    other = train(composed(*settings, "seed=1", f"run_dir={tmp_path / 'other'}"))
    assert without_time(run_dir / "metrics.csv") != without_time(other / "metrics.csv")


def test_stop_and_resume_equals_never_stopping(unbroken, tmp_path):
    run_dir, settings = unbroken
    here = tmp_path / "here"
    train(composed(*settings, f"run_dir={here}", "optim.total_updates=34"))
    typed = [f"resume={here}", "optim.total_updates=60"]
    train(*resumed_config(composed(settings[0], *typed), typed))
    assert_same_state(run_dir, here)
    assert without_time(run_dir / "metrics.csv") == without_time(here / "metrics.csv")
    # The shorter run also evaluated at its own end.
    evaluations = [row for row in rows_of(here / "eval.csv") if row["updates"] != "34"]
    assert evaluations == rows_of(run_dir / "eval.csv")


@pytest.mark.parametrize("algo", EVERY)
def test_a_restored_agent_goes_on_as_if_never_stopped(algo):
    agent, other = built(algo), built(algo, seed=1)
    update(agent, range(6))
    # A copy, as a checkpoint file is one.
    for name, part in agent.state.items():
        other.state[name].load_state_dict(copy.deepcopy(part.state_dict()))
    for one, two in zip(update(agent, range(6, 40)), update(other, range(6, 40)), strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=0)


@pytest.mark.parametrize("algo", EVERY)
def test_an_update_leaves_its_batch_as_it_is_and_gives_detached_numbers(algo):
    agent = built(algo)
    batch = agent.offline_rows_of(batch_of(0))
    before = batch.clone()
    metrics = agent.update(batch)
    assert all(value.shape == () and not value.requires_grad for value in metrics.values())
    assert set(batch.keys(True, True)) - set(before.keys(True, True)) == set(agent.rewrites)
    for key in before.keys(True, True):
        assert torch.equal(before[key], batch[key]), key


class RefuseReadingValues(TorchDispatchMode):
    """Raises where values decide what comes next or its shape, which no CUDA graph can record."""

    READ = ("_local_scalar_dense", "equal", "nonzero", "masked_select", "_unique2")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        masks = args[1] if func is torch.ops.aten.index.Tensor else []
        read = any(mask is not None and mask.dtype == torch.bool for mask in masks)
        assert not read and func._opname not in self.READ, f"{func} reads values"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "read",
    [bool, torch.nonzero, lambda x: x[x > 0], lambda x: torch.equal(x, x), torch.Tensor.unique],
)
def test_a_read_value_is_noticed(read):
    with RefuseReadingValues(), pytest.raises(AssertionError, match="reads values"):
        read(torch.ones(1))


@pytest.mark.parametrize("algo", EVERY)
def test_acting_reads_no_value(algo, monkeypatch):
    capturing = f"{TanhNormal.__module__}.safe_is_current_stream_capturing"
    monkeypatch.setattr(capturing, lambda: True)  # TanhNormal reads its bounds everywhere else
    agent = built(algo)
    for how in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        states = batch_of(0).select("observation")
        with set_exploration_type(how), torch.no_grad(), RefuseReadingValues():
            agent.policy(states)
        assert states["action"].isfinite().all()


@pytest.mark.parametrize("algo", EVERY)
def test_the_best_action_of_a_bandit_is_found(algo):
    agent = built(algo, *BANDIT[algo])
    states = TensorDict(observation=torch.randn(200, 4), batch_size=[200])

    def distance():
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            return (agent.policy(states.clone())["action"] - 1.5).abs().mean()

    before = distance()
    update(agent, range(450))
    assert before > 0.7 and distance() < 0.3


@pytest.mark.parametrize("algo", sorted(HUMANOID_PARAMETERS))
def test_it_has_the_parameters_of_the_papers_table(algo):
    agent = built(algo, env="humanoid", tiny=False)
    trained = [p for p in agent.state["loss"].parameters() if p.requires_grad]
    # The table counts networks: neither log alpha, which has no dimension, nor targets.
    assert sum(p.numel() for p in trained if p.ndim) == HUMANOID_PARAMETERS[algo]


@pytest.mark.parametrize(
    ("algo", "temperatures"), [("rlpd", 1), ("cql", 1), ("calql", 1), ("wsrl", 1), ("iql", 0)]
)
def test_its_page_has_its_parameter_count(algo, temperatures):
    agent = built(algo, env="humanoid", tiny=False)
    counted = sum(p.numel() for p in agent.state["loss"].parameters() if p.requires_grad)
    page = (CONFIGS.parents[1] / "docs" / "methods" / f"{algo}.md").read_text()
    assert f"{counted - temperatures:,}" in page


@pytest.mark.parametrize("algo", ["sac", "rlpd"])
def test_the_entropy_target_is_meant_for_actions_between_minus_one_and_one(algo):
    loss = built(algo, env="humanoid", tiny=False).state["loss"]
    assert float(loss.target_entropy) == -17 * {"sac": 1.0, "rlpd": 0.5}[algo]


def test_sac_backs_up_the_entropy_of_actions_between_minus_one_and_one():
    """The value of a state does not depend on the units of the actions."""
    targets = []
    for bound in (1.0, 0.4):
        cfg = configured(composed("algo=sac", "env=humanoid"))
        torch.manual_seed(0)
        builder = PolicyBuilder.of(
            make_vector_env("Humanoid-v4", 1, 0), make_gaussian_policy, rescaled=True
        )
        builder = dataclasses.replace(builder, spec=Bounded(-bound, bound, shape=(17,)))
        loss = make_loss(cfg, builder.build(CPU), builder, CPU)
        for critic in loss.qvalue_network_params.values(True, True):
            critic.data.zero_()
        SoftUpdate(loss, tau=1.0).step()
        rows = TensorDict(observation=torch.zeros(3, 376), batch_size=[3])
        done = torch.zeros(3, 1, dtype=torch.bool)
        rows["next"] = rows.copy().update(reward=torch.zeros(3, 1), done=done, terminated=done)
        rows["action"] = torch.zeros(3, 17)
        torch.manual_seed(1)
        targets.append(qvalue_loss(loss, rows)["loss_qvalue"])  # two critics: sum of y squared
    torch.testing.assert_close(*targets)


def test_rescaled_scores_are_densities_of_actions_between_minus_one_and_one():
    spec = Bounded(-3.0, 4.0, shape=(2,))
    rows = TensorDict(observation=torch.randn(5, 3).double(), batch_size=[5])
    dist = make_gaussian_policy(3, spec, rescaled=True).double().get_dist(rows)
    unit = TanhNormal(dist.loc, dist.scale, event_dims=1)
    for draw in (dist.rsample_and_log_prob, dist.sample_and_log_prob):
        action, score = draw()
        expected = unit.log_prob((action - 0.5) / 3.5)
        for found in (score, dist.log_prob(action)):
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_without_the_squash_correction_sac_scores_what_is_squashed():
    loss = built("sac", "sac.squash_correction=false", env="humanoid", tiny=False).state["loss"]
    assert float(loss.target_entropy) == -17  # of a Gaussian without units
    spec = Bounded(-0.5, 0.5, shape=(2,))
    policy = make_gaussian_policy(3, spec, squash_correction=False).double()
    dist = policy.get_dist(TensorDict(observation=torch.randn(5, 3).double(), batch_size=[5]))
    gaussian = torch.distributions.Normal(dist.loc, dist.scale)
    for draw in (dist.rsample_and_log_prob, dist.sample_and_log_prob):
        action, score = draw()
        assert action.requires_grad == (draw == dist.rsample_and_log_prob)
        expected = gaussian.log_prob((2 * action).atanh()).sum(-1)
        for found in (score, dist.log_prob(action)):
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_sacs_policy_learns_from_the_critics_of_the_same_update(monkeypatch):
    agent = built("sac")
    loss, seen = agent.state["loss"], []
    original, critics = loss.actor_loss, loss.qvalue_network_params

    def watched(data):
        seen.append(critics.detach().clone())
        return original(data)

    monkeypatch.setattr(loss, "actor_loss", watched)
    before = critics.detach().clone()
    agent.update(batch_of(0))
    assert (seen[0] == critics).all() and not (seen[0] == before).all()


def test_sac_begins_with_the_weights_of_the_other_methods():
    loss = built("sac", env="humanoid", tiny=False).state["loss"]
    values = dict(loss.named_parameters())
    weights = [p for name, p in values.items() if name.endswith("weight")]
    biases = [p for name, p in values.items() if name.endswith("bias")]
    assert len(weights) == len(biases) == 2 * 4  # actor and stacked critics
    for weight in weights:
        share = weight.std() * weight.shape[-1] ** 0.5
        assert 0.8 < share < 0.95  # 0.88, of a normal that is cut at two deviations
    assert not any(bias.any() for bias in biases)
    critics = next(weight for weight in weights if weight.ndim == 3)
    assert not torch.equal(critics[0], critics[1])


@pytest.mark.parametrize(
    ("algo", "variant", "last"),
    [
        ("qsm", [], 3e-5),
        ("sdac", [], 3e-5),
        ("qvpo", [], 3e-5),
        ("qvpo", ["variant=qvpo_sdac_repo"], 5e-5),
    ],
)
def test_the_learning_rate_of_a_diffusion_policy_decays_in_its_own_steps(algo, variant, last):
    agent = built(algo, *variant)
    scheduler, optimizer = agent.state["scheduler"], agent.state["actor_optimizer"]
    factor = scheduler.lr_lambdas[0]
    rates = [3e-4 * factor(step) for step in (0, 25_000, 50_000, 75_000, 10**6)]
    assert rates == pytest.approx([3e-4, 3e-4, (3e-4 + last) / 2, last, last])
    update(agent, range(4))
    steps = 4 if algo == "qsm" else 2  # at every update, at every second
    assert scheduler.last_epoch == steps
    assert optimizer.state[optimizer.param_groups[0]["params"][0]]["step"] == steps


@pytest.mark.parametrize(("variant", "first"), [("qvpo", 0.02), ("qvpo_sdac_repo", 1.6094379)])
def test_the_weight_of_qvpos_uniform_actions_follows_its_updates(variant, first):
    settings = configured(composed("algo=qvpo", f"variant={variant}")).qvpo
    updates = (0, 1, 50_000, 100_000, 180_000)
    expected = [first, 0.02, 0.015, 0.01, 0.002]
    assert [settings.coefficient(update) for update in updates] == pytest.approx(expected, abs=2e-7)
    agent = built("qvpo", f"variant={variant}", "qvpo.entropy_updates=4")
    seen = []
    for number in range(5):
        update(agent, [number])
        seen.append(agent.state["loss"].entropy_coefficient.item())
    # The policy learns at even updates, with the coefficient of its update.
    assert seen == pytest.approx([first, first, 0.01, 0.01, 0.002])
