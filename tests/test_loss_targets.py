"""The TD target: value estimators, ends of episodes, multi-step data."""

from __future__ import annotations

import pytest
import torch
from torchrl.data.postprocs import MultiStep
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator

from loss_cases import make_data, make_loss, set_constant, total

SUPPORTED = (ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda)

# --- value estimators -----------------------------------------------------------------------------


@pytest.mark.parametrize("value_type", list(ValueEstimators))
def test_off_policy_estimators_work_on_trajectories_and_others_are_refused(value_type):
    loss = make_loss()
    if value_type not in SUPPORTED:
        with pytest.raises(NotImplementedError):
            loss.make_value_estimator(value_type)
        return
    loss.make_value_estimator(value_type)
    data = make_data(3, 5)
    total(loss(data)).backward()
    assert data["td_error"].shape == (3, 5)
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize(
    ("value_type", "lmbda"),
    [(ValueEstimators.TD0, 0.0), (ValueEstimators.TD1, 1.0), (ValueEstimators.TDLambda, 0.7)],
)
def test_estimators_on_a_trajectory_by_hand(value_type, lmbda):
    gamma, value, loss = 0.9, 3.0, make_loss(reward_scale=0.5)
    set_constant(loss, online=0.0, target=value)
    hyperparams = {"lmbda": lmbda} if value_type is ValueEstimators.TDLambda else {}
    loss.make_value_estimator(value_type, gamma=gamma, **hyperparams)
    data = make_data(1, 4)
    data["next", "reward"] = torch.tensor([2.0, 4.0, -2.0, 6.0]).view(1, 4, 1)
    data["next", "done"][:, 1] = True  # truncated: the return ends, the value does not
    loss(data)
    expected, after = [], value
    for reward, done in zip((6.0, -2.0, 4.0, 2.0), (False, False, True, False), strict=True):
        after = value if done else after
        after = 0.5 * reward + gamma * ((1 - lmbda) * value + lmbda * after)
        expected.insert(0, abs(after))
    torch.testing.assert_close(data["td_error"], torch.tensor([expected]))


@pytest.mark.parametrize(
    "estimator",
    [
        lambda: (TDLambdaEstimator, {"gamma": 0.9, "lmbda": 0.7, "value_network": None}),
        lambda: (TDLambdaEstimator(gamma=0.9, lmbda=0.7, value_network=None), {}),
        lambda: ("TDLambda", {"gamma": 0.9, "lmbda": 0.7}),
    ],
    ids=["subclass", "instance", "string"],
)
def test_an_estimator_may_be_a_subclass_an_instance_or_a_string(estimator):
    loss, data = make_loss(), make_data(3, 5, draws=True)
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.9, lmbda=0.7)
    expected = loss(data)
    value_type, hyperparams = estimator()
    loss.make_value_estimator(value_type, **hyperparams)
    torch.testing.assert_close(loss(data), expected)


def test_td0_with_gamma_099_is_the_default():
    loss = make_loss()
    assert isinstance(loss.value_estimator, TD0Estimator)
    assert loss.value_estimator.gamma == pytest.approx(0.99)


# --- the TD target --------------------------------------------------------------------------------


def test_truncated_rows_bootstrap_and_terminated_rows_do_not():
    loss = make_loss(reward_scale=0.5)
    loss.make_value_estimator(gamma=0.9)
    set_constant(loss, online=1.0, target=3.0)
    data = make_data(3)
    data["next", "reward"].fill_(2.0)
    data["next", "done"] = torch.tensor([[False], [True], [True]])
    data["next", "terminated"] = torch.tensor([[False], [False], [True]])
    out = loss(data)
    # y = 0.5 * 2 + 0.9 * 3 = 3.7 for the first two rows, 1 for the terminated one; Q = 1.
    torch.testing.assert_close(data["td_error"], torch.tensor([2.7, 2.7, 0.0]))
    assert out["target_value"].item() == pytest.approx((3.7 + 3.7 + 1.0) / 3)
    assert out["loss_qvalue"].item() == pytest.approx(2 * (2.7**2 + 2.7**2) / 3, rel=1e-5)


@pytest.mark.parametrize("value_type", SUPPORTED)
def test_nan_after_a_terminated_row_does_not_leak(value_type):
    loss, data = make_loss(), make_data(4, 3)
    loss.make_value_estimator(value_type)
    for key in ("done", "terminated"):
        data["next", key][:, -1] = True
    torch.manual_seed(1)
    expected = loss(data)
    data["next", "observation"][:, -1] = float("nan")
    torch.manual_seed(1)
    out = loss(data)
    torch.testing.assert_close(out, expected)
    total(out).backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters())


def test_the_target_takes_the_smaller_of_the_target_critics():
    loss = make_loss(reward_scale=1.0)
    loss.make_value_estimator(gamma=0.5)
    set_constant(loss, online=0.0, target=0.0)
    bias = loss.target_qvalue_network_params["value", "bias"]
    bias.data.copy_(torch.tensor([4.0, 2.0]).view_as(bias))
    data = make_data(2)
    data["next", "reward"].fill_(1.0)
    assert loss(data)["target_value"].item() == pytest.approx(1.0 + 0.5 * 2.0)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_multi_step_targets_discount_by_the_number_of_steps(n_steps):
    gamma, value, loss = 0.9, 3.0, make_loss(reward_scale=0.5)
    loss.make_value_estimator(gamma=gamma)
    set_constant(loss, online=0.0, target=value)
    data = make_data(2, 5)
    data["next", "reward"] = torch.arange(10.0).view(2, 5, 1)
    rewards = data["next", "reward"].squeeze(-1)
    data["collector", "mask"] = torch.ones(2, 5, dtype=torch.bool)
    data = MultiStep(gamma=gamma, n_steps=n_steps)(data)
    loss(data)
    for start in range(5):
        window = rewards[:, start : start + n_steps]
        steps = window.shape[1]  # fewer than n at the end of the trajectory
        discounts = gamma ** torch.arange(steps)
        expected = 0.5 * (window * discounts).sum(-1) + gamma**steps * value
        torch.testing.assert_close(data["td_error"][:, start], expected)


def test_one_step_data_of_multi_step_equals_single_step_data():
    loss, data = make_loss(), make_data(2, 5, draws=True)
    expected = loss(data.clone())
    data["collector", "mask"] = torch.ones(2, 5, dtype=torch.bool)
    torch.testing.assert_close(loss(MultiStep(gamma=0.99, n_steps=1)(data.clone())), expected)
    three = loss(MultiStep(gamma=0.99, n_steps=3)(data.clone()))
    assert (three["loss_qvalue"] - expected["loss_qvalue"]).abs() > 1e-3
