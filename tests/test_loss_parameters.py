"""Loss, actor and critic hold the same parameters, through casts, copies, resets and updates."""

from __future__ import annotations

import pickle
import warnings
from copy import deepcopy

import pytest
import torch
from loss_cases import make_actor, make_data, make_loss, total
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_aca import ACALoss

COPIES = {"deepcopy": deepcopy, "pickle": lambda loss: pickle.loads(pickle.dumps(loss))}


def assert_tied(loss):
    """The parameters of loss, actor and critic are the same objects, each listed once."""
    assert loss.qvalue_network is loss.actor_network.critic
    critic = {id(p) for p in loss.qvalue_network.parameters()}
    assert critic == {id(p) for p in loss.qvalue_network_params.parameters()}
    assert loss.log_alpha is loss.actor_network.log_alpha
    assert {id(p) for p in loss.parameters()} == critic | {id(loss.log_alpha)}


# --- parameters -----------------------------------------------------------------------------------


def test_loss_actor_and_critic_share_each_parameter_once():
    loss = make_loss()
    assert_tied(loss)
    for named in (loss.named_parameters, loss.named_buffers):
        names = [name for name, _ in named()]
        assert len(names) == len(set(names))
        tensors = [tensor.data_ptr() for _, tensor in named()]
        assert len(tensors) == len(set(tensors))


def test_casting_the_loss_keeps_the_sharing_and_casts_the_actor():
    loss = make_loss()
    online = loss.qvalue_network.value.weight
    loss.to(torch.float64)
    assert loss.qvalue_network.value.weight is online
    assert_tied(loss)
    assert {tensor.dtype for tensor in loss.state_dict().values()} == {torch.float64}
    data = make_data(4).apply(lambda x: x.double() if x.is_floating_point() else x)
    assert loss.actor_network(data.select("observation"))["action"].dtype == torch.float64
    assert total(loss(data)).dtype == torch.float64


@pytest.mark.parametrize("copy", COPIES.values(), ids=COPIES)
def test_a_copy_is_tied_to_its_own_actor_and_to_nothing_else(copy):
    loss, data = make_loss(), make_data(5, draws=True)
    clone = copy(loss)
    assert_tied(clone)
    assert_tied(loss)
    torch.testing.assert_close(clone(data), loss(data), rtol=0, atol=0)
    before = loss(data)
    for tensor in (*clone.parameters(), *clone.buffers()):
        tensor.data.add_(1.0)
    torch.testing.assert_close(loss(data), before, rtol=0, atol=0)
    assert (clone(data)["loss_qvalue"] - before["loss_qvalue"]).abs() > 1e-3


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
    before = {key: value.clone() for key, value in before.items() if key.endswith("weight")}
    loss.reset_parameters_recursive()
    after = loss.state_dict()
    assert {key.split(".")[0] for key in before} == {
        "qvalue_network_params",
        "target_qvalue_network_params",
    }
    assert not any(torch.equal(after[key], value) for key, value in before.items())
    assert_tied(loss)


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
    assert_tied(other)


# --- targets --------------------------------------------------------------------------------------


def test_forward_warns_without_a_target_updater():
    with pytest.warns(UserWarning, match="No target network updater"):
        ACALoss(make_actor())(make_data(3))


@pytest.mark.parametrize("updater", ["soft", "hard", "none needed"])
def test_forward_is_silent_with_an_updater_or_without_targets(updater):
    loss = ACALoss(make_actor(), delay_qvalue=updater != "none needed")
    if updater == "soft":
        SoftUpdate(loss, tau=0.1)
    elif updater == "hard":
        HardUpdate(loss, value_network_update_interval=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(make_data(3))


@pytest.mark.parametrize("delay_qvalue", [True, False])
def test_changed_parameters_move_the_targets_only_if_not_delayed(delay_qvalue):
    loss = make_loss(delay_qvalue=delay_qvalue)
    before = loss.target_qvalue_network_params.clone()
    for param in loss.parameters():
        param.data.add_(1.0)
    shift = 0.0 if delay_qvalue else 1.0
    for key, value in loss.target_qvalue_network_params.items(True, True):
        torch.testing.assert_close(value, before[key] + shift)


def test_soft_update_moves_the_targets_by_tau():
    loss = ACALoss(make_actor())
    updater = SoftUpdate(loss, tau=0.25)
    start = loss.target_qvalue_network_params.clone()
    for param in loss.parameters():
        param.data.add_(1.0)
    updater.step()
    for key, value in loss.target_qvalue_network_params.items(True, True):
        torch.testing.assert_close(value, start[key] + 0.25)


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
