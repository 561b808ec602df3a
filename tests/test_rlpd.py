"""RLPD's loss against a float64 restatement in NumPy, and its ensemble of critics."""

from __future__ import annotations

from itertools import combinations, combinations_with_replacement

import numpy as np
import pytest
import torch
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import ValueEstimators

from ensemble_oracle import (
    ACT,
    BATCH,
    EXACT,
    GAMMA,
    MEMBERS,
    Oracle,
    assert_slope,
    noise_of,
    seeded,
)
from loss_cases import OBSERVATION_DIM, make_policy, make_rlpd, make_rlpd_data
from torchrl_aca.baselines import EnsembleMLP, EnsembleSACLoss

WSRL = {
    "subset_with_replacement": True,
    "actor_value": "min",
    "entropy_backup": False,
    "target_entropy_scale": 1.0,
    "temperature": "softplus",
}
VARIANTS = {"rlpd": {}, "wsrl": WSRL}


@pytest.mark.parametrize("variant", VARIANTS)
def test_qvalue_loss_and_gradient_equal_the_oracle(variant):
    loss, data = make_rlpd(**VARIANTS[variant]), make_rlpd_data(BATCH)
    oracle, noise = Oracle(loss, data, variant), noise_of(5)
    value = seeded(loss.qvalue_loss, data)["loss_qvalue"]
    subsets = combinations_with_replacement(range(MEMBERS), 2)
    (subset,) = [s for s in subsets if np.isclose(oracle.qvalue_loss(noise, s), value.item())]
    assert value.item() == pytest.approx(oracle.qvalue_loss(noise, subset), **EXACT)
    function = lambda: oracle.qvalue_loss(noise, subset)  # noqa: E731
    assert_slope(loss, value, oracle, function, "qvalue_network_params")


@pytest.mark.parametrize("variant", VARIANTS)
def test_actor_loss_and_gradient_equal_the_oracle(variant):
    loss, data = make_rlpd(**VARIANTS[variant]), make_rlpd_data(BATCH)
    oracle, noise = Oracle(loss, data, variant), noise_of(5)
    value = seeded(loss.actor_loss, data)["loss_actor"]
    assert value.item() == pytest.approx(oracle.actor_loss(noise), **EXACT)
    assert_slope(loss, value, oracle, lambda: oracle.actor_loss(noise), "actor_network")


@pytest.mark.parametrize("after_actor", [True, False])
@pytest.mark.parametrize("variant", VARIANTS)
def test_alpha_loss_and_gradient_equal_the_oracle(variant, after_actor):
    loss, data = make_rlpd(**VARIANTS[variant]), make_rlpd_data(BATCH)
    oracle, noise = Oracle(loss, data, variant), noise_of(5)
    if after_actor:  # whose draws are used again, whatever the generator would give now
        seeded(loss.actor_loss, data)
        torch.manual_seed(6)
    else:
        torch.manual_seed(5)
    out = loss.alpha_loss(data)
    assert out["loss_alpha"].item() == pytest.approx(oracle.alpha_loss(noise), **EXACT)
    assert out["alpha"].item() == pytest.approx(oracle.alpha())
    assert_slope(loss, out["loss_alpha"], oracle, lambda: oracle.alpha_loss(noise), "raw_alpha")


@pytest.mark.parametrize(
    ("variant", "allowed"),
    [("rlpd", combinations), ("wsrl", combinations_with_replacement)],
)
def test_every_subset_is_drawn_and_only_with_replacement_a_member_twice(variant, allowed):
    loss, data = make_rlpd(**VARIANTS[variant]), make_rlpd_data(BATCH)
    oracle, drawn = Oracle(loss, data, variant), set()
    subsets = list(combinations_with_replacement(range(MEMBERS), 2))
    for seed in range(60):
        value, noise = seeded(loss.qvalue_loss, data, seed=seed)["loss_qvalue"], noise_of(seed)
        fitting = [s for s in subsets if np.isclose(oracle.qvalue_loss(noise, s), value.item())]
        if len(fitting) == 1:  # more, where one member is below the other in every row
            drawn.add(fitting[0])
    assert drawn == set(allowed(range(MEMBERS), 2))


def test_what_follows_a_terminal_state_counts_for_nothing():
    loss, data = make_rlpd(), make_rlpd_data(BATCH)
    expected = seeded(loss.qvalue_loss, data)
    data["next", "observation"][data["next", "terminated"][:, 0]] = float("nan")
    torch.testing.assert_close(seeded(loss.qvalue_loss, data), expected)


def test_returns_over_several_steps_are_discounted_over_these():
    loss, data = make_rlpd(), make_rlpd_data(BATCH)
    data["next", "reward"].zero_()
    one = seeded(loss.qvalue_loss, data)["target_value"]
    data["steps_to_next_obs"] = torch.full((BATCH, 1), 3)
    three = seeded(loss.qvalue_loss, data)["target_value"]
    assert three == pytest.approx(GAMMA**2 * one.item(), **EXACT)


def test_metrics_are_those_of_the_losses():
    loss, data = make_rlpd(), make_rlpd_data(BATCH)
    out = seeded(loss.actor_loss, data)
    assert out["entropy"] == pytest.approx(-data["policy_log_prob"].mean().item())
    assert data["policy_log_prob"].shape == (BATCH,) and not data["policy_log_prob"].requires_grad
    values = loss.qvalue_network(data.clone())["state_action_value"]
    assert loss.qvalue_loss(data)["pred_value"] == pytest.approx(values.mean().item())


def test_alpha_starts_where_it_was_told():
    for kind in ("exp", "softplus"):
        loss = EnsembleSACLoss(
            make_policy(), make_rlpd().qvalue_network, temperature=kind, alpha_init=0.7
        )
        assert loss.alpha.item() == pytest.approx(0.7)


def test_target_entropy_is_a_number_or_a_share_of_the_action_size():
    assert make_rlpd().target_entropy.item() == -0.5 * ACT
    assert make_rlpd(target_entropy_scale=1.0).target_entropy.item() == -ACT
    assert make_rlpd(target_entropy=-0.3).target_entropy.item() == pytest.approx(-0.3)
    assert make_rlpd(policy=make_policy(spec=False), target_entropy=-0.3).target_entropy < 0
    with pytest.raises(ValueError, match='target_entropy="auto" needs the size of the action'):
        make_rlpd(policy=make_policy(spec=False))


# --- the ensemble ---------------------------------------------------------------------------------


def test_members_start_apart_within_the_bounds_of_xavier():
    network = EnsembleMLP(30, 10, num_cells=(50, 40))
    for weight, (num_in, num_out) in zip(
        network.weights, [(30, 50), (50, 40), (40, 1)], strict=True
    ):
        bound = (6 / (num_in + num_out)) ** 0.5
        assert weight.shape == (10, num_in, num_out)
        assert 0.8 * bound < weight.abs().max() <= bound
        assert not any(torch.equal(a, b) for a, b in combinations(weight, 2))


def test_sliced_parameters_are_an_ensemble_of_those_members():
    network, x = EnsembleMLP(3, 5, num_cells=(8,)), torch.randn(2, 4, 3)
    params = {name: param[[3, 1]] for name, param in network.named_parameters()}
    some = torch.func.functional_call(network, params, (x,))
    torch.testing.assert_close(some, network(x)[..., [3, 1]])
    assert some.shape == (2, 4, 2)


def test_the_paper_s_critics_have_732170_parameters():
    # Ten times: 23 -> 256 -> 256 -> 1 with biases, and two layer normalisations.
    member = (23 * 256 + 256) + 2 * 256 + (256 * 256 + 256) + 2 * 256 + (256 + 1)
    critics = EnsembleMLP(17 + 6)
    assert sum(param.numel() for param in critics.parameters()) == 10 * member == 732170


@pytest.mark.parametrize("sizes", [(0, 10, (8,)), (3, 0, (8,)), (3, 10, (0,)), (3, 10, ())])
def test_empty_ensembles_are_refused(sizes):
    num_in, members, num_cells = sizes
    with pytest.raises(ValueError, match="expects positive sizes"):
        EnsembleMLP(num_in, members, num_cells=num_cells)


# --- arguments ------------------------------------------------------------------------------------


def test_only_one_step_returns_are_offered():
    with pytest.raises(NotImplementedError, match="TDLambda|TD_LAMBDA|not supported"):
        make_rlpd().make_value_estimator(ValueEstimators.TDLambda)


def test_bad_options_are_refused():
    for kwargs, message in (
        ({"actor_value": "max"}, r"actor_value to be one of \('mean', 'min'\), got 'max'"),
        ({"temperature": "log"}, "temperature to be one of"),
        ({"subset_size": 0}, r"subset_size must be from 1 to the number of critics \(4\), got 0"),
        ({"subset_size": 5}, r"subset_size must be from 1 .* got 5"),
        ({"alpha_init": 0.0}, "Expected alpha_init > 0"),
    ):
        with pytest.raises(ValueError, match=message):
            make_rlpd(**kwargs)
    single = ValueOperator(
        MLP(OBSERVATION_DIM + ACT, 1, num_cells=[8]), in_keys=["observation", "action"]
    )
    with pytest.raises(ValueError, match="must be a stack of critics.*EnsembleMLP"):
        EnsembleSACLoss(make_policy(), single)
