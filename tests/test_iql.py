"""IQL's losses against a float64 restatement in NumPy, and against TorchRL's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import IQLLoss

from ensemble_oracle import ACT, BATCH, EXACT, GAMMA, MEMBERS, Oracle, assert_slope, seeded
from loss_cases import OBSERVATION_DIM, make_iql, make_rlpd_data
from torchrl_aca.baselines import EnsembleMLP, make_clipped_gaussian_policy
from torchrl_aca.baselines.gaussian_policy import ClippedNormal

TAU, BETA, MAX_WEIGHT = 0.7, 3.0, 100.0


def subset_of(seed=5):
    torch.manual_seed(seed)
    return torch.randint(MEMBERS, (2,)).tolist()


class IQLOracle(Oracle):
    """The three losses, the first with one explicit case for each sign."""

    def __init__(self, loss, data):
        super().__init__(loss, data, "wsrl")

    def mlp(self, name, state):
        def param(layer, kind):
            return self.params[f"{name}.{layer}.{kind}"]

        hidden = np.maximum(state @ param(0, "weight").T + param(0, "bias"), 0)
        return hidden @ param(2, "weight").T + param(2, "bias")

    def state_value(self, state):
        return self.mlp("value_network.module", state)[:, 0]

    def advantage(self, subset):
        state, action = self.data["state"], self.data["action"]
        values = [self.critic("target", i, state, action) for i in subset]
        return np.minimum.reduce(values) - self.state_value(state)

    def value_loss(self, subset):
        return np.mean([TAU * u**2 if u > 0 else (1 - TAU) * u**2 for u in self.advantage(subset)])

    def target(self):
        next_value = self.state_value(self.data["next_state"])
        return self.data["reward"] + GAMMA * (1 - self.data["terminated"]) * next_value

    def qvalue_loss(self, target):
        state, action = self.data["state"], self.data["action"]
        errors = [self.critic("online", i, state, action) - target for i in range(MEMBERS)]
        return np.mean(np.square(errors))

    def weight(self, subset):
        return np.minimum(np.exp(BETA * self.advantage(subset)), MAX_WEIGHT)

    def actor_loss(self, weight):
        out = self.mlp("actor_network.module.0.module.0", self.data["state"])
        mean, std = out[:, :ACT], np.exp(out[:, ACT:])
        density = np.exp(-(((self.data["action"] - mean) / std) ** 2) / 2)
        density = density / (std * np.sqrt(2 * np.pi))
        return -np.mean(weight * np.log(density).sum(-1))


@pytest.fixture
def compared():
    """A loss whose advantages have both signs."""
    loss, data = make_iql(), make_rlpd_data(BATCH)
    middle = float(np.median(IQLOracle(loss, data).advantage(subset_of())))
    loss.value_network.module[2].bias.data.add_(middle)
    return loss, data, IQLOracle(loss, data)


def test_value_loss_and_gradient_equal_the_oracle(compared):
    loss, data, oracle = compared
    out = seeded(loss.value_loss, data)
    function = lambda: oracle.value_loss(subset_of())  # noqa: E731
    assert {-1, 1} == set(np.sign(oracle.advantage(subset_of())))
    assert out["loss_value"].item() == pytest.approx(function(), rel=1e-12)
    assert_slope(loss, out["loss_value"], oracle, function, "value_network")


def test_qvalue_loss_and_gradient_equal_the_oracle(compared):
    loss, data, oracle = compared
    out, target = loss.qvalue_loss(data), oracle.target()
    function = lambda: oracle.qvalue_loss(target)  # noqa: E731
    assert out["loss_qvalue"].item() == pytest.approx(function(), **EXACT)
    assert out["target_value"].item() == pytest.approx(target.mean(), **EXACT)
    assert_slope(loss, out["loss_qvalue"], oracle, function, "qvalue_network_params")


@pytest.mark.parametrize("reward", [0.0, 3.0], ids=["weights below the clip", "and on it"])
def test_actor_loss_and_gradient_equal_the_oracle(compared, reward):
    loss, data, oracle = compared
    shift = loss.target_qvalue_network_params["module", "layers", "6", "bias"]
    shift.data.add_(reward)
    oracle = IQLOracle(loss, data)
    out, weight = seeded(loss.actor_loss, data), oracle.weight(subset_of())
    assert (weight == MAX_WEIGHT).any() == bool(reward)
    assert out["loss_actor"].item() == pytest.approx(oracle.actor_loss(weight), **EXACT)
    assert out["advantage_weight"].item() == pytest.approx(weight.mean(), **EXACT)
    function = lambda: oracle.actor_loss(weight)  # noqa: E731
    assert_slope(loss, out["loss_actor"], oracle, function, "actor_network")


def test_with_all_members_it_is_torchrls_loss():
    """Whose targets are the minimum over all critics; values and gradients."""
    loss = make_iql(subset_size=MEMBERS, subset_with_replacement=False)
    data = make_rlpd_data(BATCH)
    member = EnsembleMLP(OBSERVATION_DIM + ACT, 1, num_cells=(6, 5), dtype=torch.float64)
    theirs = IQLLoss(
        loss.actor_network,
        ValueOperator(member, in_keys=["observation", "action"]),
        loss.value_network,
        num_qvalue_nets=MEMBERS,
        loss_function="l2",
        temperature=BETA,
        expectile=TAU,
    )
    theirs.make_value_estimator(gamma=GAMMA)
    for name in ("qvalue_network_params", "target_qvalue_network_params"):
        for key, stack in getattr(loss, name).items(True, True):
            getattr(theirs, name)[key].data.copy_(stack.data.unsqueeze(1))
    out, expected = loss(data.clone()), theirs(data.clone())
    for name in ("loss_value", "loss_actor"):
        torch.testing.assert_close(out[name], expected[name])
    # TorchRL adds the critics' losses up, we average them.
    torch.testing.assert_close(out["loss_qvalue"] * MEMBERS, expected["loss_qvalue"])
    expected["loss_qvalue"].backward()
    (out["loss_qvalue"] * MEMBERS).backward()
    for key, stack in loss.qvalue_network_params.items(True, True):
        torch.testing.assert_close(
            theirs.qvalue_network_params[key].grad.squeeze(1), stack.grad, rtol=1e-6, atol=1e-9
        )


def test_the_policy_clips_its_actions_and_scores_what_they_were_before():
    policy = make_clipped_gaussian_policy(3, Bounded(-0.1, 0.1, shape=(1,)), num_cells=[4])
    states = TensorDict(observation=torch.randn(50, 3), batch_size=[50])
    with set_exploration_type(ExplorationType.RANDOM):
        actions = policy(states)["action"]
    assert actions.max() == 0.1 and actions.min() == -0.1

    loc = torch.tensor([[1.0], [-5.0], [0.25]])
    low, high = torch.tensor([-2.0]), torch.tensor([0.5])
    draws = ClippedNormal(loc, torch.full((3, 1), 0.1), low=low, high=high)
    expected = torch.tensor([[0.5], [-2.0], [0.25]])
    for action in (draws.deterministic_sample, draws.mean, draws.mode):
        torch.testing.assert_close(action, expected)
    for sample in (draws.sample(torch.Size([9])), draws.rsample(torch.Size([9]))):
        assert sample.shape == (9, 3, 1)
        assert (sample[:, :2] == expected[:2]).all() and sample[:, 2].std() > 0
    density = torch.distributions.Normal(loc, 0.1).log_prob(torch.zeros(3, 1))[:, 0]
    torch.testing.assert_close(draws.log_prob(torch.zeros(3, 1)), density)


def test_bad_options_are_refused():
    for kwargs, message in (
        ({"expectile": 1.0}, r"Expected expectile in \(0, 1\)"),
        ({"temperature": 0.0}, "Expected temperature > 0"),
        ({"max_weight": -1.0}, "Expected max_weight > 0"),
        ({"subset_size": 0}, "subset_size must be from 1"),
    ):
        with pytest.raises(ValueError, match=message):
            make_iql(**kwargs)
