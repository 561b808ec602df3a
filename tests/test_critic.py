from __future__ import annotations

import copy
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

import actor_cases
import oracle
from actor_cases import ACTION, BATCH, CANDIDATES, OBS
from torchrl_aca import NoiseLevelCritic, NoiseLevelCriticBase
from torchrl_aca.interop import to_official

T = 20
make_critic = partial(actor_cases.make_critic, num_steps=T)


def num_parameters(critic):
    return sum(p.numel() for p in critic.parameters())


def draw(*batch, dtype=torch.float32):
    return torch.randn(*batch, OBS, dtype=dtype), torch.randn(*batch, ACTION, dtype=dtype)


# --- values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("first_level", [0, 1])
@pytest.mark.parametrize("num_critics", [1, 2, 3])
def test_values_equal_the_oracle(first_level, num_critics):
    critic = make_critic(first_level=first_level, num_critics=num_critics, dtype=torch.float64)
    observation, action = draw(BATCH, dtype=torch.float64)
    level = torch.arange(BATCH) * 4  # 0, 4, .. 20
    index = level if first_level else (level - 1).clamp(min=0)  # the official code's
    value = critic(observation, action, level)
    assert value.shape == (BATCH, num_critics)
    arrays = observation.numpy(), action.numpy(), index.numpy()
    expected = [oracle.critic(member, *arrays) for member in to_official(critic)]
    np.testing.assert_allclose(value.detach(), np.stack(expected, -1), atol=1e-12)


@pytest.mark.parametrize("num_cells", [(7,), (7, 5), (6, 5, 4, 3)])
def test_candidates_share_the_features_of_their_state(num_cells):
    critic = make_critic(num_cells=num_cells, dtype=torch.float64)
    observation, _ = draw(BATCH, dtype=torch.float64)
    action = torch.randn(CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    value = critic.evaluate(critic.encode(observation), action, torch.tensor(3))
    assert value.shape == (CANDIDATES, BATCH, 2)
    expected = [
        oracle.critic(member, observation.numpy(), action.numpy(), 3)
        for member in to_official(critic)
    ]
    np.testing.assert_allclose(value.detach(), np.stack(expected, -1), atol=1e-12)


def test_each_state_of_the_candidates_may_have_its_own_level():
    critic = make_critic()
    observation, _ = draw(BATCH)
    action, level = torch.randn(CANDIDATES, BATCH, ACTION), torch.randint(0, T + 1, (BATCH,))
    together = critic.evaluate(critic.encode(observation), action, level)
    alone = torch.stack([critic(observation, candidate, level) for candidate in action])
    torch.testing.assert_close(together, alone)


@pytest.mark.parametrize("batch", [(), (BATCH,), (2, 3), (2, 1, 3)])
def test_every_batch_shape_gives_the_values_of_the_flat_batch(batch):
    critic = make_critic()
    observation, action = draw(*batch)
    level = torch.randint(0, T + 1, batch)
    td = TensorDict(observation=observation, action=action, noise_level=level, batch_size=batch)
    value = critic(td)["state_action_value"]
    assert value.shape == (*batch, 2)
    flat = critic(observation.view(-1, OBS), action.view(-1, ACTION), level.view(-1))
    torch.testing.assert_close(value.view(-1, 2), flat)
    torch.testing.assert_close(critic(observation, action, level), value)


@pytest.mark.parametrize("first_level", [0, 1])
def test_levels_0_to_t_have_values_of_their_own_but_0_and_1_of_the_official_code(first_level):
    critic = make_critic(first_level=first_level)
    observation, action = torch.zeros(T + 1, OBS), torch.zeros(T + 1, ACTION)
    value = critic(observation, action, torch.arange(T + 1)).detach()[:, 0]
    assert value.unique().numel() == T + first_level
    assert torch.equal(value[0], value[1]) is (first_level == 0)
    gradient = critic.action_gradient(critic.encode(observation), action, torch.arange(T + 1))
    assert torch.allclose(gradient[0], gradient[1]) is (first_level == 0)
    with pytest.raises(IndexError):
        critic(observation[0], action[0], torch.tensor(T + 1))


def test_float64_observations_are_cast_to_the_parameters():
    critic = make_critic()
    observation, action = draw(BATCH)
    level = torch.zeros(BATCH, dtype=torch.long)
    value = critic(observation.double(), action, level)
    assert value.dtype == torch.float32
    assert torch.equal(value, critic(observation, action, level))


# --- keys -----------------------------------------------------------------------------------------


def test_keys_may_be_renamed_and_nested():
    keys = [("agent", "state"), ("agent", "act"), ("agent", "level")]
    critic = make_critic(in_keys=keys, out_keys=[("agent", "q")])
    assert critic.in_keys == keys and critic.out_keys == [("agent", "q")]
    observation, action = draw(BATCH)
    level = torch.randint(0, T + 1, (BATCH,))
    td = TensorDict(batch_size=[BATCH])
    for key, value in zip(keys, (observation, action, level), strict=True):
        td[key] = value
    assert critic(td) is td
    torch.testing.assert_close(td["agent", "q"], critic(observation, action, level))


def test_a_key_that_is_not_in_a_list_is_told():
    with pytest.raises(ValueError, match=r"out_keys as a list of keys, such as \['q'\], got a str"):
        make_critic(out_keys="q")


def test_tensors_may_be_given_by_name():
    critic = make_critic()
    observation, action = draw(BATCH)
    level = torch.zeros(BATCH, dtype=torch.long)
    named = critic(noise_level=level, action=action, observation=observation)
    torch.testing.assert_close(named, critic(observation, action, level))


# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(BATCH,), (CANDIDATES, BATCH)])
def test_action_gradient_is_the_oracles_summed_over_critics(shape):
    critic = make_critic(dtype=torch.float64)
    observation, _ = draw(BATCH, dtype=torch.float64)
    action = torch.randn(*shape, ACTION, dtype=torch.float64)
    gradient = critic.action_gradient(critic.encode(observation), action, torch.tensor(5))
    arrays = observation.numpy(), action.numpy(), 5
    expected = sum(oracle.critic_action_gradient(m, *arrays) for m in to_official(critic))
    np.testing.assert_allclose(gradient, expected, atol=1e-12)


ACTIVATIONS = [nn.Mish, nn.ReLU, nn.GELU, nn.SiLU, nn.Tanh, nn.ELU]


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("num_cells", [(7,), (7, 5, 6)])
def test_written_out_gradient_equals_the_generic_one(activation, num_cells):
    critic = make_critic(activation=activation, num_cells=num_cells, dtype=torch.float64)
    observation, _ = draw(BATCH, dtype=torch.float64)
    features = critic.encode(observation)
    action = torch.randn(CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    level = torch.randint(0, T + 1, (BATCH,))
    written = critic.action_gradient(features, action, level)
    generic = NoiseLevelCriticBase._action_gradient(critic, features, action, level)
    torch.testing.assert_close(written, generic, rtol=0, atol=1e-10)


@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("owner", [NoiseLevelCritic, NoiseLevelCriticBase])
def test_action_gradient_works_in_every_grad_mode_and_keeps_no_graph(mode, owner):
    critic = make_critic()
    observation, action = draw(BATCH)
    level = torch.tensor(2)
    expected = owner._action_gradient(critic, critic.encode(observation), action, level)
    with mode():
        features = critic.encode(observation)
        gradient = owner._action_gradient(critic, features, action, level)
    assert not gradient.requires_grad
    torch.testing.assert_close(gradient, expected)


def test_gradients_reach_every_parameter_and_agree_with_the_oracle():
    critic = make_critic(dtype=torch.float64)
    observation, action = draw(BATCH, dtype=torch.float64)
    level = torch.randint(0, T + 1, (BATCH,))
    critic(observation, action, level).sum().backward()
    layers = [critic.level_in, critic.level_out, *critic.hidden, critic.value]
    assert 2 * len(layers) == len(list(critic.parameters()))
    arrays = observation.numpy(), action.numpy(), level.numpy()
    for index, member in enumerate(to_official(critic)):
        grads = oracle.critic_parameter_gradients(member, *arrays, np.ones(BATCH))
        for i, layer in enumerate(layers):
            name = f"linear_{i}" if i else "linear"
            weight, bias = layer.weight.grad[index], layer.bias.grad[index, 0]
            assert weight.any() and bias.any()
            np.testing.assert_allclose(weight, grads[f"{name}.w"], atol=1e-12)
            np.testing.assert_allclose(bias, grads[f"{name}.b"], atol=1e-12)


# --- parameters -----------------------------------------------------------------------------------


def test_humanoid_has_475746_parameters():
    assert num_parameters(NoiseLevelCritic(376, 17)) == 475_746


def test_halfcheetah_has_the_parameters_of_two_mlps():
    level = (16 * 32 + 32) + (32 * 16 + 16)
    hidden = ((17 + 6 + 16) * 256 + 256) + 2 * (256 * 256 + 256)
    assert num_parameters(NoiseLevelCritic(17, 6)) == 2 * (level + hidden + 256 + 1)


def test_members_are_initialised_independently_with_the_truncated_normal():
    critic = NoiseLevelCritic(376, 17, num_critics=3)
    cut = 0.8796  # standard deviation of a standard normal cut at two of its own
    for layer in [*critic.hidden, critic.level_in, critic.level_out]:
        std = layer.weight.shape[1] ** -0.5
        for member in layer.weight:
            tolerance = 4 * std / member.numel() ** 0.5
            assert abs(member.std().item() - cut * std) < tolerance
            assert abs(member.mean().item()) < tolerance
        assert layer.weight.abs().max() <= 2 * std
        assert not layer.bias.any()
        correlation = torch.corrcoef(layer.weight.flatten(1)) - torch.eye(3)
        assert correlation.abs().max() < 5 / layer.weight[0].numel() ** 0.5


def test_reset_draws_every_weight_anew():
    critic = make_critic()
    before = copy.deepcopy(critic)
    critic.reset_parameters_recursive()
    for old, new in zip(before.parameters(), critic.parameters(), strict=True):
        assert not torch.equal(old, new)


def test_dtype_and_device_are_those_asked_for():
    critic = make_critic(dtype=torch.float64, device="meta")
    assert {(p.dtype, p.device.type) for p in critic.parameters()} == {(torch.float64, "meta")}


def test_there_are_no_buffers():
    assert not list(make_critic().buffers())


# --- errors, copies, compilation ------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad",
    [
        {"observation_dim": 0},
        {"action_dim": -1},
        {"num_steps": 0},
        {"num_critics": 0},
        {"num_cells": ()},
        {"num_cells": (16, 0)},
        {"embedding_dim": 7},
        {"embedding_dim": 0},
    ],
)
def test_sizes_must_be_positive_and_the_embedding_even(bad):
    name, value = next(iter(bad.items()))
    with pytest.raises(ValueError, match="expects positive sizes.*got") as error:
        NoiseLevelCritic(**{"observation_dim": OBS, "action_dim": ACTION, **bad})
    assert f"{name}={value}" in str(error.value)


@pytest.mark.parametrize("first_level", [-1, 2])
def test_first_level_is_0_or_1(first_level):
    with pytest.raises(ValueError, match=f"first_level must be 0 or 1, got {first_level}"):
        make_critic(first_level=first_level)


@pytest.mark.parametrize(
    ("method", "missing"),
    [("encode", "encode"), ("evaluate", "_evaluate"), ("action_gradient", "_evaluate")],
)
def test_the_base_names_the_method_that_a_subclass_lacks(method, missing):
    class Unfinished(NoiseLevelCriticBase):
        """Defines nothing."""

    arguments = [torch.zeros(1)] * (1 if method == "encode" else 3)
    with pytest.raises(NotImplementedError, match=f"Unfinished must define {missing}"):
        getattr(Unfinished(), method)(*arguments)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_copies_give_equal_values_and_share_nothing(duplicate):
    critic = make_critic()
    copied = duplicate(critic)
    observation, action = draw(BATCH)
    level = torch.randint(0, T + 1, (BATCH,))
    assert torch.equal(copied(observation, action, level), critic(observation, action, level))
    assert {p.data_ptr() for p in copied.parameters()}.isdisjoint(
        p.data_ptr() for p in critic.parameters()
    )


@pytest.mark.parametrize("activation", [nn.Mish, nn.ReLU])
@pytest.mark.parametrize("method", ["evaluate", "action_gradient"])
def test_compiles_without_a_graph_break(method, activation):
    critic = make_critic(activation=activation)
    observation, _ = draw(BATCH)
    features = tuple(feature.detach() for feature in critic.encode(observation))
    arguments = features, torch.randn(CANDIDATES, BATCH, ACTION), torch.tensor(4)
    compiled = torch.compile(getattr(critic, method), fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(*arguments), getattr(critic, method)(*arguments))


def test_repr_tells_the_sizes():
    text = repr(NoiseLevelCritic(5, 3, num_steps=7, num_cells=(8,)))
    assert "num_members=2, num_in=24, num_out=8" in text  # 5 + 3 + 16 level features
