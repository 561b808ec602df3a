"""What is ACA's own in the sharing of parameters: the actor, and losses without targets."""

from __future__ import annotations

import pickle
import warnings
from copy import deepcopy

import pytest
import torch
from torchrl.objectives import HardUpdate

from loss_cases import make_actor, make_data, make_loss, total
from torchrl_aca import ACALoss

COPIES = {"deepcopy": deepcopy, "pickle": lambda loss: pickle.loads(pickle.dumps(loss))}


def test_casting_the_loss_casts_the_actor():
    loss = make_loss().to(torch.float64)
    data = make_data(4).apply(lambda x: x.double() if x.is_floating_point() else x)
    assert loss.actor_network(data.select("observation"))["action"].dtype == torch.float64
    assert {tensor.dtype for tensor in loss.state_dict().values()} == {torch.float64}


def test_the_state_of_the_loss_holds_the_guidance_weight_of_its_actor():
    loss, other = make_loss(make_actor(guidance_weight=7.0)), make_loss()
    other.load_state_dict(loss.to(torch.float32).state_dict())
    assert other.actor_network.guidance_weight == 7
    other.actor_network.guidance_weight = 8
    assert other.state_dict()["guidance_weight"] == 8


@pytest.mark.parametrize("copy", COPIES.values(), ids=COPIES)
def test_training_a_copy_changes_the_actions_of_its_actor(copy):
    clone, data = copy(make_loss()), make_data(5, draws=True)
    observation = data.select("observation")
    optimizer = torch.optim.SGD(clone.parameters(), lr=0.1)
    with torch.no_grad():
        torch.manual_seed(1)
        before = clone.actor_network(observation.clone())["action"]
    total(clone(data)).backward()
    optimizer.step()
    torch.manual_seed(1)
    assert not torch.equal(clone.actor_network(observation.clone())["action"], before)


def test_reset_parameters_recursive_redraws_online_and_target_parameters():
    loss = make_loss()
    before = loss.state_dict()
    before = {key: value.clone() for key, value in before.items() if key.endswith(".weight")}
    loss.reset_parameters_recursive()
    after = loss.state_dict()
    assert {key.split(".")[0] for key in before} == {
        "qvalue_network_params",
        "target_qvalue_network_params",
    }
    assert not any(torch.equal(after[key], value) for key, value in before.items())
    assert loss.qvalue_network.value.weight is loss.qvalue_network_params["value", "weight"]


@pytest.mark.parametrize("delay_qvalue", [True, False])
def test_state_dict_round_trip_into_a_second_loss(delay_qvalue):
    torch.manual_seed(1)
    loss, data = make_loss(delay_qvalue=delay_qvalue), make_data(5, draws=True)
    loss.log_alpha.data.fill_(0.3)
    other = make_loss(delay_qvalue=delay_qvalue)
    weight = other.actor_network.critic.value.weight
    other.load_state_dict(loss.state_dict(), strict=True)
    torch.testing.assert_close(other(data), loss(data), rtol=0, atol=0)
    assert other.actor_network.critic.value.weight is weight


def test_without_targets_no_updater_is_missed():
    loss = ACALoss(make_actor(), delay_qvalue=False)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loss(make_data(3))
    assert not caught


@pytest.mark.parametrize("delay_qvalue", [True, False])
def test_changed_parameters_move_the_targets_only_if_not_delayed(delay_qvalue):
    loss = make_loss(delay_qvalue=delay_qvalue)
    before = loss.target_qvalue_network_params.clone()
    for param in loss.parameters():
        param.data.add_(1.0)
    shift = 0.0 if delay_qvalue else 1.0
    for key, value in loss.target_qvalue_network_params.items(True, True):
        torch.testing.assert_close(value, before[key] + shift)


def test_hard_update_copies_the_parameters_once_its_interval_has_passed():
    loss = ACALoss(make_actor())
    updater = HardUpdate(loss, value_network_update_interval=2)
    start = loss.target_qvalue_network_params.clone()
    for param in loss.parameters():
        param.data.add_(1.0)
    for _ in range(2):
        updater.step()
        torch.testing.assert_close(loss.target_qvalue_network_params.data, start.data)
    updater.step()
    torch.testing.assert_close(
        loss.target_qvalue_network_params.data, loss.qvalue_network_params.data
    )


def test_a_state_dict_that_is_assigned_keeps_actor_and_loss_together():
    loss, other = make_loss(guidance_weight="auto"), make_loss(guidance_weight="auto")
    other.log_alpha.data.fill_(0.3)
    other.actor_network.guidance_weight = 8
    loss.load_state_dict(other.state_dict(), assign=True)
    actor = loss.actor_network
    assert actor.log_alpha is loss.log_alpha and actor.log_alpha.item() == pytest.approx(0.3)
    assert actor.guidance_weight is loss.guidance_weight and actor.guidance_weight == 8
    for name, value in actor.critic.state_dict().items():
        assert torch.equal(value, other.actor_network.critic.state_dict()[name])
    networks = zip(actor.critic.parameters(), loss.qvalue_network_params.parameters(), strict=True)
    assert all(held is trained for held, trained in networks)
