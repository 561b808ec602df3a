"""What the three losses compute: gradients, targets, draws, replay, learning."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type

from loss_cases import (
    ACTION_DIM,
    NUM_STEPS,
    make_actor,
    make_data,
    make_loss,
    set_constant,
    total,
)
from torchrl_aca import (
    ACALoss,
    CriticGuidedDenoisingActor,
    CustomCritic,
    NoiseLevelCritic,
    NoiseSchedule,
)

LOSSES = ("loss_qvalue", "loss_noise_level", "loss_alpha")

# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LOSSES)
def test_each_loss_reaches_only_its_own_parameters(name):
    loss = make_loss()
    loss(make_data(6))[name].backward()
    of_alpha = name == "loss_alpha"
    critic = list(loss.qvalue_network.parameters())
    assert all((p.grad is None) is of_alpha for p in critic)
    assert of_alpha or all(p.grad.abs().sum() > 0 for p in critic)
    assert (loss.log_alpha.grad is not None) is of_alpha


# --- random draws ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["noise_level", "noise", "next_action"])
def test_given_draws_are_used(name):
    loss, data = make_loss(), make_data(6, draws=True)
    out = loss(data)
    torch.manual_seed(99)
    torch.testing.assert_close(loss(data), out, rtol=0, atol=0)
    data[name] = make_data(6, draws=True)[name]
    changed = "loss_qvalue" if name == "next_action" else "loss_noise_level"
    other = loss(data)
    assert [key for key in LOSSES if not torch.equal(other[key], out[key])] == [changed]


@pytest.mark.parametrize("mode", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_the_next_action_is_drawn_as_in_acting_whatever_the_exploration_type(mode):
    loss, data = make_loss(), make_data(6)
    torch.manual_seed(7)
    with torch.no_grad():
        data["next_action"] = loss.actor_network.sample(data["next", "observation"], (6,))
    expected = loss.qvalue_loss(data)
    del data["next_action"]
    torch.manual_seed(7)
    with set_exploration_type(mode):
        torch.testing.assert_close(loss.qvalue_loss(data), expected)


def test_num_target_candidates_is_the_number_of_chains_of_the_target(monkeypatch):
    actor, data = make_actor(num_candidates=3), make_data(2)
    guided, gradient = [], actor.critic.action_gradient

    def count(features, action, level):
        guided.append((len(action), level.item()))
        return gradient(features, action, level)

    monkeypatch.setattr(actor.critic, "action_gradient", count)
    for given in (None, 1, 5):
        make_loss(actor, num_target_candidates=given)(data)
    # From level 1 no gradient is asked for.
    assert guided == [(chains, level) for chains in (3, 1, 5) for level in (4, 3, 2)]


@pytest.mark.parametrize("first_level", [0, 1])
def test_drawn_noise_levels_are_1_to_t_whatever_the_networks_indices(first_level, monkeypatch):
    loss = make_loss(make_actor(first_level=first_level))
    seen, evaluate = [], loss.qvalue_network.evaluate
    monkeypatch.setattr(
        loss.qvalue_network, "evaluate", lambda *args: seen.append(args[2]) or evaluate(*args)
    )
    loss.noise_level_loss(make_data(500))
    clean, noisy = seen
    assert not clean.any()
    assert noisy.unique().tolist() == list(range(1, NUM_STEPS + 1))


def test_given_draws_may_be_looked_for_elsewhere_or_nowhere():
    """Replay data may hold entries of these names that mean something else."""
    data = make_data(6, draws=True)
    free = data.exclude("noise", "noise_level", "next_action")
    torch.manual_seed(1)
    renamed, without = make_loss(), make_loss(use_given_draws=False)
    renamed.set_keys(noise="z", noise_level="t", next_action=("agent", "next_action"))
    for loss in (renamed, without):
        torch.manual_seed(2)
        expected = loss(free.clone())
        torch.manual_seed(2)
        torch.testing.assert_close(loss(data.clone()), expected, rtol=0, atol=0)


def test_the_same_seed_gives_the_same_losses():
    data = make_data(6)
    results = []
    for seed in (5, 5, 6):
        torch.manual_seed(0)
        loss = make_loss()
        torch.manual_seed(seed)
        results.append(loss(data.clone()))
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)
    assert results[0]["loss_qvalue"] != results[2]["loss_qvalue"]


# --- the noise-level loss -------------------------------------------------------------------------


@pytest.mark.parametrize("first_level", [0, 1])
@pytest.mark.parametrize("target", ["mean", "self"])
def test_noise_level_loss_by_hand(target, first_level):
    actor = make_actor(first_level=first_level)
    loss, data = make_loss(actor, noise_level_target=target), make_data(6, draws=True)
    level = data["noise_level"]
    signal = actor.schedule.alphas_cumprod[level - 1].float().unsqueeze(-1)
    noisy = signal.sqrt() * data["action"] + (1 - signal).sqrt() * data["noise"]
    with torch.no_grad():
        clean = actor.critic(data["observation"], data["action"], torch.zeros_like(level))
        value = actor.critic(data["observation"], noisy, level)
    goal = clean if target == "self" else clean.mean(-1, keepdim=True)
    expected = (value - goal).square().sum(-1).mean()
    torch.testing.assert_close(loss.noise_level_loss(data)["loss_noise_level"], expected)


# --- units, shapes, critics -----------------------------------------------------------------------


def test_actions_in_the_units_of_the_env_give_the_same_losses():
    plain = make_loss()
    low, high = torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 1.0])
    actor = make_actor(plain.actor_network.critic, spec=Bounded(low, high))
    loss, data = make_loss(actor), make_data(6, draws=True)
    loss.target_qvalue_network_params.data.update_(plain.target_qvalue_network_params.data)
    expected = plain(data)
    for key in ("action", "next_action"):
        data[key] = low + (data[key] + 1) / 2 * (high - low)
    torch.testing.assert_close(loss(data), expected)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (2, 1, 3)])
def test_losses_do_not_depend_on_how_rows_are_arranged(batch):
    loss, data = make_loss(), make_data(*batch, draws=True)
    flat = data.reshape(-1)
    torch.testing.assert_close(loss(data), loss(flat))
    assert data["td_error"].shape == batch
    torch.testing.assert_close(data["td_error"].reshape(-1), flat["td_error"])
    loss.reduction = "none"
    assert loss.qvalue_loss(data)["loss_qvalue"].shape == batch


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_drawn_losses_of_any_batch_shape_are_finite(batch):
    losses = make_loss()(make_data(*batch))
    assert all(value.isfinite().all() for value in losses.values())


@pytest.mark.parametrize(
    "keys",
    [["observation", ("next", "observation")], [("next", "reward")]],
    ids=["observation", "reward"],
)
def test_float64_observations_and_rewards_are_taken_by_a_float32_critic(keys):
    loss, data = make_loss(), make_data(6, draws=True)
    expected = loss(data)
    for key in keys:
        data[key] = data[key].double()
    out = loss(data)
    torch.testing.assert_close(out, expected)
    total(out).backward()


class PixelStateHead(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(8 + 3 + 2 + 1, 16), nn.Mish(), nn.Linear(16, 2))

    def forward(self, hidden, state, action, noise_level):
        return self.net(torch.cat([hidden, state, action, noise_level.unsqueeze(-1)], -1))


def test_a_critic_of_pixels_and_state_is_trained_and_encodes_each_state_once():
    encoder = nn.Sequential(nn.Conv2d(1, 4, 3, stride=2), nn.Mish(), nn.Flatten(), nn.Linear(36, 8))
    rows = []
    encoder.register_forward_hook(lambda module, args, output: rows.append(len(output)))
    head_keys = ["hidden", "state", "action", "noise_level"]
    module = TensorDictSequential(
        TensorDictModule(encoder, ["pixels"], ["hidden"]),
        TensorDictModule(PixelStateHead(), head_keys, ["state_action_value"]),
    )
    actor = make_actor(CustomCritic(module), action_dim=ACTION_DIM, num_candidates=5)
    loss, data = make_loss(actor), make_data(6)
    for part in (data, data["next"]):
        part["pixels"] = torch.randn(6, 1, 8, 8)
        part["state"] = part.pop("observation")
    out = loss.qvalue_loss(data)
    assert rows == [6, 6, 6]  # s; s' by the online critic, which samples, and by the target
    rows.clear()
    out.update(loss.noise_level_loss(data))
    assert rows == [6]
    total(out).backward()
    assert all(p.grad.abs().sum() > 0 for p in module.parameters())
    assert set(loss.in_keys) >= {"pixels", "state", ("next", "pixels"), ("next", "state")}


# --- prioritised replay ---------------------------------------------------------------------------


def test_importance_weights_give_the_weighted_mean():
    loss, data = make_loss(reduction="none"), make_data(6, draws=True)
    rows = loss(data)
    weights = torch.rand(6)
    data["priority_weight"] = weights
    loss.reduction = "mean"
    weighted = loss(data)
    for key in ("loss_qvalue", "loss_noise_level"):
        torch.testing.assert_close(weighted[key], (rows[key] * weights).sum() / weights.sum())
    loss.use_prioritized_weights = False
    torch.testing.assert_close(loss(data)["loss_qvalue"], rows["loss_qvalue"].mean())


def test_prioritised_replay_end_to_end():
    # The extension of TorchRL 0.14.1's wheel loads with torch 2.14.1, and not with 2.13.0.
    pytest.importorskip(
        "torchrl._torchrl",
        reason="the binary extension of TorchRL, which prioritised samplers need, does not load",
        exc_type=ImportError,
    )
    buffer = TensorDictPrioritizedReplayBuffer(
        alpha=0.7, beta=0.9, storage=LazyTensorStorage(40), batch_size=20, priority_key="td_error"
    )
    buffer.extend(make_data(40))
    loss = make_loss()
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    sample = buffer.sample()
    assert sample["priority_weight"].unique().numel() == 1
    for _ in range(4):
        losses = loss(sample)
        assert sample["td_error"].shape == (20,) and (sample["td_error"] > 0).all()
        buffer.update_tensordict_priority(sample)
        total(losses).backward()
        optimizer.step()
        optimizer.zero_grad()
        assert all(losses[key].isfinite() for key in LOSSES)
        sample = buffer.sample()
    assert sample["priority_weight"].unique().numel() > 1


def test_td_error_is_the_largest_absolute_error_of_the_critics():
    loss = make_loss(reward_scale=1.0)
    set_constant(loss, online=0.0, target=0.0)
    bias = loss.qvalue_network_params["value", "bias"]
    bias.data.copy_(torch.tensor([0.5, 3.0]).view_as(bias))
    data = make_data(2)
    data["next", "reward"] = torch.tensor([[1.0], [-1.0]])
    loss.qvalue_loss(data)
    torch.testing.assert_close(data["td_error"], torch.tensor([2.0, 4.0]))
    assert not data["td_error"].requires_grad


def test_an_update_reads_no_value_and_stays_on_its_device():
    """As a CUDA graph asks: on the device `meta`, which has no values, both would raise."""
    loss = ACALoss(make_actor().to("meta"))
    optimizer = torch.optim.Adam(loss.qvalue_network.parameters())
    data = make_data(4).to("meta")
    data["next_action"] = loss.sample_next_action(data)
    for losses in (loss.qvalue_loss(data), loss.noise_level_loss(data), loss.alpha_loss()):
        sum(value for name, value in losses.items() if name.startswith("loss")).backward()
    optimizer.step()
    devices = {param.grad.device.type for param in loss.parameters() if param.requires_grad}
    assert devices == {"meta"} == {data["td_error"].device.type}


# --- arguments ------------------------------------------------------------------------------------


def test_qvalue_network_must_be_the_critic_of_the_actor():
    actor, other = make_actor(), make_actor()
    assert ACALoss(actor, qvalue_network=actor.critic).qvalue_network is actor.critic
    with pytest.raises(ValueError, match="must be actor_network.critic"):
        ACALoss(actor, qvalue_network=other.critic)


def test_what_is_no_actor_is_told():
    with pytest.raises(TypeError, match="expects a CriticGuidedDenoisingActor, got NoiseLevelC"):
        ACALoss(make_actor().critic)


def test_qvalue_network_may_be_the_plain_module_that_the_actor_was_built_with():
    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = nn.Linear(5, 2)

        def forward(self, observation, action, noise_level):
            return self.net(torch.cat([observation, action], -1))

    module = TensorDictModule(
        Net(), ["observation", "action", "noise_level"], ["state_action_value"]
    )
    actor = make_actor(module, action_dim=ACTION_DIM)
    assert ACALoss(actor, qvalue_network=module).qvalue_network is actor.critic


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"noise_level_target": "max"}, "noise_level_target"),
        ({"num_target_candidates": 0}, "num_target_candidates"),
        ({"loss_function": "huber"}, "loss_function to be one of .* got 'huber'"),
        ({"reduction": "avg"}, "reduction to be one of .* got 'avg'"),
        ({"entropy_noise_scale": 0.0}, "entropy_noise_scale > 0"),
    ],
)
def test_bad_options_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ACALoss(make_actor(), **kwargs)


def test_target_entropy_is_minus_nine_tenths_of_the_action_dim_unless_given():
    assert make_loss().target_entropy.item() == pytest.approx(-0.9 * ACTION_DIM)
    assert make_loss(target_entropy_scale=0.5).target_entropy.item() == pytest.approx(
        -ACTION_DIM / 2
    )
    assert make_loss(target_entropy=-3.0).target_entropy.item() == -3.0


# --- learning -------------------------------------------------------------------------------------


def test_the_actor_learns_the_best_arm_of_a_bandit():
    critic = NoiseLevelCritic(1, 1, num_steps=8, num_cells=(32, 32))
    actor = CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(8), num_candidates=32)
    loss = ACALoss(actor, num_target_candidates=1, reward_scale=1.0, delay_qvalue=False)
    optimizer = torch.optim.Adam(critic.parameters(), lr=3e-3)
    flag = torch.ones(64, 1, dtype=torch.bool)
    observation = torch.zeros(64, 1)
    for _ in range(400):
        action = torch.rand(64, 1) * 2 - 1
        following = {"observation": observation, "reward": -(action - 0.5).square()}
        data = {"observation": observation, "action": action}
        data["next"] = {**following, "done": flag, "terminated": flag}
        losses = loss(TensorDict(data, batch_size=[64]))
        optimizer.zero_grad()
        (losses["loss_qvalue"] + losses["loss_noise_level"]).backward()
        optimizer.step()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        chosen = actor(observation=torch.zeros(1))
    assert chosen.item() == pytest.approx(0.5, abs=0.1)
