"""What TorchRL asks of every loss module: keys, dispatch, reductions, masks, compilation."""

from __future__ import annotations

import pytest
import torch
from loss_cases import ACTION_DIM, make_actor, make_data, make_loss, total
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_aca import ACALoss, NoiseLevelCritic

LOSSES = {"loss_qvalue", "loss_noise_level", "loss_alpha"}
METRICS = {"pred_value", "target_value", "noisy_value", "alpha", "entropy", "exploration_std"}
NEXT_KEYS = ("reward", "done", "terminated")
DEFAULT_KEYS = {
    "action": "action",
    "value": "state_value",
    "state_action_value": "state_action_value",
    "noise_level": "noise_level",
    "noise": "noise",
    "next_action": "next_action",
    "priority": "td_error",
    "reward": "reward",
    "done": "done",
    "terminated": "terminated",
    "priority_weight": "priority_weight",
}


def test_forward_leaves_every_given_value_as_it_was():
    data = make_data(5, draws=True)
    before = data.clone()
    make_loss()(data)
    assert set(data.keys(True, True)) - set(before.keys(True, True)) == {"td_error"}
    assert (data.select(*before.keys(True, True)) == before).all()


def test_out_keys_are_the_losses_and_detached_metrics():
    loss = make_loss()
    out = loss(make_data(5))
    assert set(out.keys()) == set(loss.out_keys) == LOSSES | METRICS
    assert {key for key in loss.out_keys if key.startswith("loss")} == LOSSES
    assert all(out[key].shape == () for key in LOSSES | METRICS)
    assert not any(out[key].requires_grad for key in METRICS)


def test_each_loss_alone_equals_its_share_of_forward():
    loss, data = make_loss(), make_data(5, draws=True)
    whole = loss(data)
    alone = loss.qvalue_loss(data)
    alone.update(loss.noise_level_loss(data)).update(loss.alpha_loss())
    torch.testing.assert_close(alone, whole, rtol=0, atol=0)


# --- keys -----------------------------------------------------------------------------------------


def next_key(key):
    return ("next", key) if isinstance(key, str) else ("next", *key)


def renamed(data, key, new):
    """``data`` with the entry that the loss calls ``key`` under another name."""
    old = DEFAULT_KEYS[key]
    if key in NEXT_KEYS:
        old, new = next_key(old), next_key(new)
    data = data.clone()
    return data.rename_key_(old, new) if old in data.keys(True) else data


def test_default_keys():
    loss = make_loss()
    assert {key: getattr(loss.tensor_keys, key) for key in DEFAULT_KEYS} == DEFAULT_KEYS
    assert vars(loss.tensor_keys).keys() == DEFAULT_KEYS.keys()


@pytest.mark.parametrize("new", ["other", ("deep", "other")], ids=["flat", "nested"])
@pytest.mark.parametrize("key", DEFAULT_KEYS)
def test_set_keys_renames_what_is_read_and_written(key, new):
    data = make_data(5, draws=True)
    data["priority_weight"] = torch.rand(5)
    loss = make_loss()
    loss.make_value_estimator()
    expected = loss(data.clone())
    loss.set_keys(**{key: new})
    other = renamed(data, key, new)
    torch.testing.assert_close(loss(other), expected, rtol=0, atol=0)
    if key == "priority":
        assert other[new].shape == (5,)
    if key in NEXT_KEYS:
        assert next_key(new) in loss.in_keys


def test_set_keys_rejects_an_unknown_key():
    with pytest.raises(ValueError, match="unknown_key"):
        make_loss().set_keys(unknown_key="other")


def test_set_keys_with_none_restores_the_default():
    loss = make_loss()
    loss.set_keys(reward="other")
    loss.set_keys(reward=None)
    assert loss.tensor_keys.reward == "reward"


def test_nested_observation_and_action_keys_come_from_the_actor():
    observation, action = ("agent", "observation"), ("agent", "action")
    torch.manual_seed(1)
    expected_loss = make_loss()
    torch.manual_seed(1)
    critic = NoiseLevelCritic(
        3, 2, num_steps=4, num_cells=(16, 16), in_keys=[observation, "noisy_action", ("a", "level")]
    )
    loss = make_loss(make_actor(critic, out_keys=[action]))
    data = make_data(5, draws=True)
    expected = expected_loss(data.clone())
    data.rename_key_("action", action)
    data.rename_key_("noise_level", ("a", "level"))
    data.rename_key_("observation", observation)
    data.rename_key_(("next", "observation"), ("next", *observation))
    torch.testing.assert_close(loss(data), expected)
    assert {observation, action, ("next", *observation)} <= set(loss.in_keys)


# --- dispatch -------------------------------------------------------------------------------------


def as_kwargs(loss, data):
    return {k if isinstance(k, str) else "_".join(k): data[k] for k in loss.in_keys}


@pytest.mark.parametrize("draws", [False, True], ids=["drawn", "given"])
@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_keyword_arguments_give_what_a_tensordict_gives(draws, reduction):
    loss, data = make_loss(reduction=reduction), make_data(5, draws=draws)
    loss.set_keys(reward=("deep", "reward"))
    data = renamed(data, "reward", ("deep", "reward"))
    if draws:
        loss.in_keys = [*loss.in_keys, "noise_level", "noise", "next_action"]
    torch.manual_seed(3)
    expected = loss(data)
    torch.manual_seed(3)
    values = loss(**as_kwargs(loss, data))
    assert len(values) == len(loss.out_keys)
    for key, value in zip(loss.out_keys, values, strict=True):
        torch.testing.assert_close(value, expected[key], rtol=0, atol=0)


def test_select_out_keys_leaves_the_chosen_loss():
    loss, data = make_loss(), make_data(5, draws=True)
    expected = loss(data)["loss_qvalue"]
    loss.in_keys = [*loss.in_keys, "next_action"]
    loss.select_out_keys("loss_qvalue", "alpha")
    value, alpha = loss(**as_kwargs(loss, data))
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(alpha, torch.tensor(5.0))


# --- reductions and masks -------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
def test_reductions_agree_with_one_another(batch):
    data = make_data(*batch, draws=True)
    torch.manual_seed(1)
    out = {}
    loss = make_loss()
    for reduction in ("none", "mean", "sum"):
        loss.reduction, loss.out_keys = reduction, None
        out[reduction] = loss(data)
    assert out["none"].batch_size == batch and set(out["none"].keys()) == LOSSES
    for key in ("loss_qvalue", "loss_noise_level"):
        assert out["none"][key].shape == batch
        torch.testing.assert_close(out["none"][key].mean(), out["mean"][key])
        torch.testing.assert_close(out["none"][key].sum(), out["sum"][key])
    # Alpha's loss depends on no row: it is the same number whatever the reduction.
    torch.testing.assert_close(out["none"]["loss_alpha"], out["mean"]["loss_alpha"].expand(batch))
    torch.testing.assert_close(out["sum"]["loss_alpha"], out["mean"]["loss_alpha"])


@pytest.mark.parametrize("key", [("collector", "mask"), "valid", ("deep", "valid")])
def test_masked_rows_count_for_nothing(key):
    loss, data = make_loss(), make_data(6, draws=True)
    valid = torch.tensor([True, False, True, True, False, True])
    if key != ("collector", "mask"):
        loss.loss_mask_key = key
    expected = loss(data[valid])
    data[key] = valid
    data["next", "reward"][~valid] = 1e6
    out = loss(data)
    for name in LOSSES:
        torch.testing.assert_close(out[name], expected[name])


def test_masks_can_be_switched_off():
    loss, data = make_loss(), make_data(6, draws=True)
    expected = loss(data)
    data["collector", "mask"] = torch.arange(6) % 2 == 0
    loss.loss_mask_key = None
    torch.testing.assert_close(loss(data), expected)


# --- compilation ----------------------------------------------------------------------------------


@pytest.mark.parametrize("draws", [True, False], ids=["given", "drawn"])
def test_compiled_loss_equals_eager(draws):
    loss, data = make_loss(), make_data(4, draws=draws)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    results = []
    for function in (loss, compiled):
        loss.zero_grad(set_to_none=True)
        torch.manual_seed(2)
        out = function(data.clone())
        total(out).backward()
        results.append((out, [param.grad.clone() for param in loss.parameters()]))
    torch.testing.assert_close(*results)


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


USED_BY_TD0 = [key for key in make_loss().in_keys if key != ("next", "done")]


@pytest.mark.parametrize("key", USED_BY_TD0, ids=str)
def test_a_missing_entry_is_named(key):
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
        make_loss()(make_data(2, draws=True).exclude(key))
