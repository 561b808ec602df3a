"""The losses of CQL, Cal-QL and WSRL against a float64 restatement in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ensemble_oracle import (
    ACT,
    BATCH,
    EXACT,
    GAMMA,
    HIGH,
    LOW,
    MEMBERS,
    Oracle,
    array,
    assert_slope,
    seeded,
)
from loss_cases import (
    make_calql,
    make_calql_data,
    make_cql,
    make_cql_with_threshold,
    make_policy,
    make_rlpd_data,
)
from torchrl_aca.baselines import EnsembleSACLoss
from torchrl_aca.baselines.cql import WSRL_SETTINGS
from torchrl_aca.baselines.ensemble_sac import TEMPERATURES

NUM, BACKUP = 3, 2  # of the cases: actions of each kind, and in the backup
CASES = {
    "cql": (make_cql, make_rlpd_data),
    "cql_with_threshold": (make_cql_with_threshold, make_rlpd_data),
    "calql": (make_calql, make_calql_data),
}


class Draws:
    """What ``qvalue_loss`` draws after a seed, in its order."""

    def __init__(self, seed=5):
        def normal(num):
            return array(torch.randn(num, BATCH, ACT, dtype=torch.float64))

        torch.manual_seed(seed)
        self.backup = normal(BACKUP)
        self.subset = torch.randint(MEMBERS, (2,)).tolist()
        self.here, self.there = normal(NUM), normal(NUM)
        self.uniform = array(torch.rand(NUM, BATCH, ACT, dtype=torch.float64))
        self.members = torch.randint(MEMBERS, (2,)).tolist()


class CQLOracle(Oracle):
    """With one explicit loop over the actions of each state."""

    def __init__(self, loss, data):
        super().__init__(loss, data, "wsrl")
        self.returns = array(data["mc_return"])[:, 0] if "mc_return" in data else None

    def weight(self):
        raw = self.params.get("raw_cql_weight")
        return 0.6 if raw is None else np.log1p(np.exp(raw))

    def backup(self, draws):
        state, best = self.data["next_state"], -np.inf
        for noise in draws.backup:
            action, _ = self.policy(state, noise)
            values = [self.critic("target", i, state, action) for i in draws.subset]
            best = np.maximum(best, np.minimum(*values))
        return self.data["reward"] + GAMMA * (1 - self.data["terminated"]) * best

    def actions(self, draws):
        """(action, its log-density, whether the policy drew it) for each of the 3n."""
        for unit in draws.uniform:
            yield LOW + unit * (HIGH - LOW), -ACT * np.log(2), False
        for key, noises in (("state", draws.here), ("next_state", draws.there)):
            for noise in noises:
                yield *self.policy(self.data[key], noise), True

    def gap(self, draws):
        state, gaps = self.data["state"], []
        for i in draws.members:
            total = 0.0
            for action, log_density, is_policy in self.fixed_actions:
                value = self.critic("online", i, state, action)
                if is_policy and self.returns is not None:
                    value = np.maximum(value, self.returns)
                total = total + np.exp(value - log_density)
            gaps.append(np.log(total) - self.critic("online", i, state, self.data["action"]))
        return np.mean(gaps, 0)

    def qvalue_loss(self, draws):
        state, action, target = self.data["state"], self.data["action"], self.fixed_target
        errors = [self.critic("online", i, state, action) - target for i in range(MEMBERS)]
        return np.mean(np.square(errors)) + self.fixed_weight * np.mean(self.gap(draws))

    def fix(self, draws):
        """What no gradient goes through."""
        self.fixed_target, self.fixed_weight = self.backup(draws), self.weight()
        self.fixed_actions = list(self.actions(draws))
        return self


def compared(name):
    make, make_data = CASES[name]
    loss, data, draws = make(), make_data(BATCH), Draws()
    return loss, data, draws, CQLOracle(loss, data).fix(draws)


def gradients(loss, value):
    loss.zero_grad(set_to_none=True)
    value.backward()
    return {name: param.grad for name, param in loss.named_parameters() if param.grad is not None}


@pytest.mark.parametrize("name", CASES)
def test_qvalue_loss_and_gradient_equal_the_oracle(name):
    loss, data, draws, oracle = compared(name)
    out = seeded(loss.qvalue_loss, data)
    assert out["loss_qvalue"].item() == pytest.approx(oracle.qvalue_loss(draws), **EXACT)
    assert out["target_value"].item() == pytest.approx(oracle.fixed_target.mean(), **EXACT)
    np.testing.assert_allclose(array(data["cql_gap"]), oracle.gap(draws), rtol=1e-8)
    assert out["cql_gap"].item() == pytest.approx(oracle.gap(draws).mean(), **EXACT)
    function = lambda: oracle.qvalue_loss(draws)  # noqa: E731
    assert_slope(loss, out["loss_qvalue"], oracle, function, "qvalue_network_params")


def test_weight_loss_and_gradient_equal_the_oracle():
    loss, data, draws, oracle = compared("cql_with_threshold")
    seeded(loss.qvalue_loss, data)  # whose gap is used again
    out = loss.cql_weight_loss(data)
    function = lambda: oracle.weight() * np.mean(0.7 - oracle.gap(draws))  # noqa: E731
    assert out["loss_cql_weight"].item() == pytest.approx(function(), **EXACT)
    assert out["cql_weight"].item() == pytest.approx(0.6)
    assert_slope(loss, out["loss_cql_weight"], oracle, function, "raw_cql_weight")


@pytest.mark.parametrize(("threshold", "rises"), [(-50.0, True), (50.0, False)])
def test_the_weight_rises_while_the_gap_is_above_its_threshold(threshold, rises):
    loss, data = make_cql(gap_threshold=threshold), make_rlpd_data(BATCH)
    before = loss.cql_weight.item()
    optimizer = torch.optim.SGD([loss.raw_cql_weight], lr=1e-3)
    loss.cql_weight_loss(data)["loss_cql_weight"].backward()  # a gap of its own
    optimizer.step()
    assert (loss.cql_weight.item() > before) == rises


@pytest.mark.parametrize("seed", range(5))
def test_the_gap_trains_its_two_members_alone(seed):
    data, draws = make_rlpd_data(BATCH), Draws(seed)
    with_gap, without = make_cql(), make_cql(cql_weight=0.0)
    without.load_state_dict({**with_gap.state_dict(), "_fixed_weight": torch.tensor(0.0)})
    both = [
        gradients(loss, seeded(loss.qvalue_loss, data, seed=seed)["loss_qvalue"])
        for loss in (with_gap, without)
    ]
    assert both[0].keys() == both[1].keys()
    assert all(name.startswith("qvalue_network_params") for name in both[0])
    moved = sum((both[0][n] - both[1][n]).abs().flatten(1).sum(1) for n in both[0])
    assert set(moved.nonzero().flatten().tolist()) == set(draws.members)


@pytest.mark.parametrize("floor", [-1e6, -float("inf")])
def test_calql_is_cql_where_the_floor_is_below_every_value(floor):
    loss, other, data = make_calql(), make_cql(), make_calql_data(BATCH)
    other.load_state_dict(loss.state_dict())
    data["mc_return"].fill_(floor)
    out, expected = (seeded(each.qvalue_loss, data) for each in (loss, other))
    assert out.pop("bound_rate") == 0
    torch.testing.assert_close(out, expected)
    torch.testing.assert_close(
        gradients(loss, out["loss_qvalue"]), gradients(other, expected["loss_qvalue"])
    )


def test_above_every_value_the_floor_leaves_the_uniform_actions_to_be_pushed_down():
    loss, data = make_calql(), make_calql_data(BATCH)
    data["mc_return"].fill_(30.0)
    out = seeded(loss.qvalue_loss, data)
    assert out["bound_rate"] == 1
    draws = Draws()
    oracle = CQLOracle(loss, data).fix(draws)
    densities = np.stack([d for _, d, is_policy in oracle.fixed_actions if is_policy])
    data_values = np.mean(
        [
            oracle.critic("online", i, oracle.data["state"], oracle.data["action"])
            for i in draws.members
        ],
        0,
    )
    # Nothing but the floor is left in the sum: exp(30) drowns the uniform actions.
    expected = 30 + np.log(np.exp(-densities).sum(0)) - data_values
    np.testing.assert_allclose(array(data["cql_gap"]), expected, rtol=1e-6)


def test_wsrls_online_loss_is_that_of_sac_with_the_same_parameters():
    loss, data = make_cql(), make_rlpd_data(BATCH)
    sac = EnsembleSACLoss(make_policy(), loss.qvalue_network, **WSRL_SETTINGS)
    sac.make_value_estimator(gamma=GAMMA)
    sac.load_state_dict({name: loss.state_dict()[name] for name in sac.state_dict()})
    torch.testing.assert_close(
        seeded(loss.td_loss, data), seeded(sac.qvalue_loss, data), rtol=0, atol=0
    )
    assert "cql_gap" not in data


def test_one_backup_action_with_entropy_is_the_target_of_the_parent():
    loss = make_cql(num_backup_actions=1, entropy_backup=True)
    data = make_rlpd_data(BATCH)
    conservative, plain = seeded(loss.qvalue_loss, data), seeded(loss.td_loss, data)
    assert conservative["target_value"].item() == pytest.approx(plain["target_value"].item())


def test_a_large_weight_and_temperature_begin_where_they_should():
    assert make_cql(cql_weight=1000.0, gap_threshold=1.0).cql_weight.item() == 1000.0
    for function, inverse in TEMPERATURES.values():
        for value in (1e-3, 1.0, 1000.0):
            assert function(torch.tensor(inverse(value)).double()).item() == pytest.approx(value)


def test_bad_options_are_refused():
    for kwargs, message in (
        ({"cql_weight": -1.0}, "Expected cql_weight >= 0"),
        ({"cql_weight": 0.0, "gap_threshold": 1.0}, "Expected cql_weight > 0"),
        ({"num_actions": 0}, "Expected num_actions >= 1"),
        ({"num_backup_actions": 0}, "Expected num_backup_actions >= 1"),
        ({"subset_size": 5}, "subset_size must be from 1"),
    ):
        with pytest.raises(ValueError, match=message):
            make_cql(**kwargs)
    with pytest.raises(ValueError, match="needs a bounded action spec"):
        make_cql(policy=make_policy(spec=False), target_entropy=-1.0)
