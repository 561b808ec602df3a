from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_aca import CriticGuidedDenoisingActor, CustomCritic, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.custom_critic import as_noise_level_critic

OBS, ACTION, BATCH, CANDIDATES, T = 4, 3, 6, 5, 4


class Network(nn.Module):
    """``(observation, action, noise_level) -> E values``."""

    def __init__(self, num_critics=2):
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(OBS + ACTION + 1, 8), nn.Tanh(), nn.Linear(8, num_critics)
        )

    def forward(self, observation, action, noise_level):
        return self.net(torch.cat([observation, action, noise_level.unsqueeze(-1) / T], -1))


class Encoder(nn.Module):
    """Pixels to features; counts its calls and the images it has seen."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv2d(3, 4, 3, stride=2), nn.ReLU(), nn.Flatten(), nn.Dropout(0.5), nn.LazyLinear(5)
        )
        self.net(torch.zeros(1, 3, 8, 8))
        self.num_calls, self.num_images = 0, 0

    def forward(self, pixels):
        self.num_calls += 1
        self.num_images += len(pixels)
        return self.net(pixels)


class Head(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(5 + OBS + ACTION + 1, 8), nn.Tanh(), nn.Linear(8, 2))

    def forward(self, features, state, action, noise_level):
        return self.net(torch.cat([features, state, action, noise_level.unsqueeze(-1) / T], -1))


PIXELS, STATE = ("sensors", "pixels"), ("sensors", "state")


def pixel_critic():
    return TensorDictSequential(
        TensorDictModule(Encoder(), in_keys=[PIXELS], out_keys=["features"]),
        TensorDictModule(
            Head(),
            in_keys=["features", STATE, "action", "noise_level"],
            out_keys=["state_action_value"],
        ),
    ).eval()


def pixel_observations(*batch):
    return torch.randn(*batch, 3, 8, 8), torch.randn(*batch, OBS)


def pixel_td(pixels, state, **entries):
    batch = state.shape[:-1]
    sensors = TensorDict(pixels=pixels, state=state, batch_size=batch)
    return TensorDict(sensors=sensors, batch_size=batch, **entries)


def tensordict_module():
    keys = ["observation", "action", "noise_level"]
    return TensorDictModule(Network(), in_keys=keys, out_keys=["state_action_value"])


def make_actor(critic, **kwargs):
    kwargs = {"num_candidates": CANDIDATES, "action_dim": ACTION, **kwargs}
    return CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(T), **kwargs)


# --- values and gradients -------------------------------------------------------------------------


@pytest.mark.parametrize("make", [Network, tensordict_module])
@pytest.mark.parametrize("shape", [(BATCH,), (CANDIDATES, BATCH)])
def test_values_and_gradients_of_a_module_equal_a_direct_call(make, shape):
    module = make()
    network = module if isinstance(module, Network) else module.module
    critic = CustomCritic(module)
    assert critic.in_keys == ["observation", "action", "noise_level"]
    observation = torch.randn(BATCH, OBS)
    action = torch.randn(*shape, ACTION, requires_grad=True)
    level = torch.randint(0, T + 1, (BATCH,))
    expected = network(observation.expand(*shape, OBS), action, level.expand(shape))
    (expected_gradient,) = torch.autograd.grad(expected.sum(), action)
    features = critic.encode(observation)
    torch.testing.assert_close(critic.evaluate(features, action, level), expected)
    gradient = critic.action_gradient(features, action, level)
    torch.testing.assert_close(gradient, expected_gradient)
    assert not gradient.requires_grad


@pytest.mark.parametrize("shape", [(BATCH,), (CANDIDATES, BATCH)])
def test_values_and_gradients_of_a_pixel_critic_equal_a_direct_call(shape):
    module = pixel_critic()
    critic = CustomCritic(module)
    assert set(critic.observation_keys) == {PIXELS, STATE}
    pixels, state = pixel_observations(BATCH)
    action = torch.randn(*shape, ACTION, requires_grad=True)
    level = torch.tensor(2)
    by_key = {PIXELS: pixels, STATE: state}
    features = critic.encode(*[by_key[key] for key in critic.observation_keys])
    encoded = module[0].module(pixels).expand(*shape, -1)
    arguments = encoded, state.expand(*shape, -1), action, level.expand(shape)
    expected = module[1].module(*arguments)
    (expected_gradient,) = torch.autograd.grad(expected.sum(), action)
    torch.testing.assert_close(critic.evaluate(features, action, level), expected)
    torch.testing.assert_close(critic.action_gradient(features, action, level), expected_gradient)


def test_evaluation_leaves_the_features_as_they_were():
    critic = CustomCritic(Network())
    features = critic.encode(torch.randn(BATCH, OBS))
    critic.action_gradient(features, torch.randn(BATCH, ACTION), torch.tensor(0))
    critic.evaluate(features, torch.randn(BATCH, ACTION), torch.tensor(0))
    assert list(features.keys()) == ["observation"]


@pytest.mark.parametrize("batch", [(), (BATCH,), (2, 3)])
def test_every_batch_shape_gives_the_values_of_the_flat_batch(batch):
    critic = CustomCritic(pixel_critic())
    pixels, state = pixel_observations(*batch)
    action, level = torch.randn(*batch, ACTION), torch.randint(0, T + 1, batch)
    value = critic(pixel_td(pixels, state, action=action, noise_level=level))["state_action_value"]
    assert value.shape == (*batch, 2)
    flat = pixel_td(
        pixels.view(-1, 3, 8, 8),
        state.view(-1, OBS),
        action=action.view(-1, ACTION),
        noise_level=level.view(-1),
    )
    torch.testing.assert_close(value.view(-1, 2), critic(flat)["state_action_value"])


def test_a_module_that_ignores_the_level_is_a_plain_critic():
    network = nn.Sequential(nn.Linear(ACTION, 8), nn.Tanh(), nn.Linear(8, 2))
    module = TensorDictModule(network, in_keys=["action"], out_keys=["state_action_value"])
    critic = CustomCritic(module, observation_keys=["observation"])
    observation, action = torch.randn(BATCH, OBS), torch.randn(BATCH, ACTION)
    values = [critic(observation, action, torch.full((BATCH,), level)) for level in (0, 3)]
    assert torch.equal(*values)
    torch.testing.assert_close(values[0], network(action))


def test_a_plain_critic_of_state_and_action_acts():
    class Plain(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = nn.Linear(OBS + ACTION, 2)

        def forward(self, observation, action):
            return self.net(torch.cat([observation, action], -1))

    keys = ["observation", "action"]
    module = TensorDictModule(Plain(), in_keys=keys, out_keys=["state_action_value"])
    td = TensorDict(observation=torch.randn(BATCH, OBS), batch_size=[BATCH])
    assert make_actor(module)(td)["action"].shape == (BATCH, ACTION)


def test_a_single_critic_has_one_column():
    critic = CustomCritic(Network(num_critics=1))
    arguments = torch.randn(BATCH, OBS), torch.randn(BATCH, ACTION), torch.zeros(BATCH).long()
    assert critic(*arguments).shape == (BATCH, 1)
    td = TensorDict(observation=arguments[0], batch_size=[BATCH])
    assert make_actor(critic)(td)["action"].shape == (BATCH, ACTION)


def test_keys_may_be_renamed_and_nested():
    critic = CustomCritic(
        Network(),
        observation_keys=[("agent", "state")],
        action_key=("agent", "act"),
        noise_level_key=("agent", "level"),
        value_key=("agent", "q"),
    )
    observation, action = torch.randn(BATCH, OBS), torch.randn(BATCH, ACTION)
    level = torch.randint(0, T + 1, (BATCH,))
    agent = TensorDict(state=observation, act=action, level=level, batch_size=[BATCH])
    td = critic(TensorDict(agent=agent, batch_size=[BATCH]))
    torch.testing.assert_close(td["agent", "q"], critic.module(observation, action, level))


# --- in the actor ---------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (BATCH,), (2, 3)])
def test_the_encoder_sees_every_state_once_per_call_of_the_actor(batch):
    module = pixel_critic()
    actor = make_actor(module)
    td = actor(pixel_td(*pixel_observations(*batch)))
    assert td["action"].shape == (*batch, ACTION)
    encoder = module[0].module
    assert encoder.num_calls == 1
    assert encoder.num_images == torch.Size(batch).numel()


def test_states_act_alone_as_they_do_in_a_batch():
    actor = make_actor(pixel_critic())
    pixels, state = pixel_observations(BATCH)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        together = actor(pixel_td(pixels, state))["action"]
        alone = [actor(pixel_td(*one))["action"] for one in zip(pixels, state, strict=True)]
    torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-5)


def test_a_custom_critic_acts_as_the_built_in_one_of_the_same_function():
    critic = NoiseLevelCritic(OBS, ACTION, num_steps=T, num_cells=(8,), dtype=torch.float64)
    module = TensorDictModule(critic, in_keys=critic.in_keys, out_keys=critic.out_keys)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    expected = make_actor(critic).denoise(observation, noise)
    actual = make_actor(module).denoise(observation, noise)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-10)


def test_the_actor_holds_the_users_parameters_and_its_own_log_alpha():
    module = pixel_critic()
    actor = make_actor(module)
    assert {id(p) for p in actor.parameters()} == {
        *(id(p) for p in module.parameters()),
        id(actor.log_alpha),
    }


# --- the module tree ------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [Network, tensordict_module, pixel_critic])
def test_every_parameter_is_listed_once(make):
    module = make()
    critic = CustomCritic(module)
    names = [name for name, _ in critic.named_parameters(remove_duplicate=False)]
    assert len(names) == len(list(module.parameters()))
    assert sorted(critic.state_dict()) == sorted(f"module.{name}" for name in module.state_dict())


def test_train_and_eval_reach_the_submodules():
    critic = CustomCritic(pixel_critic())
    pixels, state = pixel_observations(BATCH)
    td = pixel_td(
        pixels, state, action=torch.zeros(BATCH, ACTION), noise_level=torch.zeros(BATCH).long()
    )

    def values():
        return critic(td.clone())["state_action_value"]

    assert torch.equal(values(), values())
    critic.train()
    assert not torch.equal(values(), values())  # dropout
    critic.eval()
    assert torch.equal(values(), values())


def test_casts_and_moves_reach_the_submodules():
    critic = CustomCritic(pixel_critic()).double()
    arguments = [o.double() for o in pixel_observations(BATCH)]
    order = [arguments[(PIXELS, STATE).index(key)] for key in critic.observation_keys]
    action = torch.zeros(BATCH, ACTION, dtype=torch.float64)
    value = critic.evaluate(critic.encode(*order), action, torch.tensor(0))
    assert value.dtype == torch.float64
    critic.to("meta")
    features = critic.encode(*[o.to("meta") for o in order])
    value = critic.evaluate(features, action.to("meta"), torch.tensor(0, device="meta"))
    assert value.device.type == "meta"


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_copies_are_equal_and_run_on_their_own_parameters(duplicate):
    critic = CustomCritic(Network())
    copied = duplicate(critic)
    arguments = torch.randn(BATCH, OBS), torch.randn(BATCH, ACTION), torch.zeros(BATCH).long()
    expected = critic(*arguments)
    torch.testing.assert_close(copied(*arguments), expected)
    for parameter in copied.parameters():
        nn.init.zeros_(parameter)
    assert not copied(*arguments).any()
    torch.testing.assert_close(critic(*arguments), expected)


def test_gradients_reach_every_parameter():
    critic = CustomCritic(pixel_critic())
    td = pixel_td(
        *pixel_observations(BATCH),
        action=torch.randn(BATCH, ACTION),
        noise_level=torch.ones(BATCH).long(),
    )
    critic(td)["state_action_value"].sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in critic.parameters())


# --- errors ---------------------------------------------------------------------------------------


def test_a_module_must_read_the_action():
    module = TensorDictModule(Network(), ["observation", "a", "t"], ["state_action_value"])
    with pytest.raises(ValueError, match="must read the action 'action'.*pass action_key="):
        CustomCritic(module)
    assert CustomCritic(module, action_key="a", noise_level_key="t").in_keys[-2:] == ["a", "t"]


def test_a_module_must_write_the_value():
    module = TensorDictModule(Network(), ["observation", "action", "noise_level"], ["q"])
    with pytest.raises(ValueError, match="write the value 'state_action_value'.*value_key="):
        CustomCritic(module)
    assert CustomCritic(module, value_key="q").out_keys == ["q"]


def test_values_need_a_column_per_critic():
    class Squeezed(Network):
        def forward(self, *arguments):
            return super().forward(*arguments)[..., 0]

    arguments = torch.randn(BATCH, OBS), torch.randn(BATCH, ACTION), torch.zeros(BATCH).long()
    with pytest.raises(ValueError, match=r"must have shape \(rows, E\), here \(6, E\).*got \(6,\)"):
        CustomCritic(Squeezed())(*arguments)


def test_only_modules_become_critics():
    critic = NoiseLevelCritic(OBS, ACTION, num_cells=(8,))
    assert as_noise_level_critic(critic) is critic
    assert isinstance(as_noise_level_critic(Network()), CustomCritic)
    with pytest.raises(TypeError, match="must be an nn.Module, got function"):
        as_noise_level_critic(lambda *arguments: arguments)


def test_the_actor_asks_for_the_action_dimension_that_a_custom_critic_does_not_tell():
    with pytest.raises(ValueError, match="Pass spec= or action_dim="):
        make_actor(Network(), action_dim=None)


def test_towers_in_one_sequence_with_keys_of_the_same_name_stay_apart():
    def tower(out_key):
        body = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["hidden"])
        value = nn.Linear(4 + 2, 1)
        head = TensorDictModule(
            lambda hidden, action, value=value: value(torch.cat([hidden, action], -1)),
            in_keys=["hidden", "action"],
            out_keys=[out_key],
        )
        return body, head

    join = TensorDictModule(
        lambda *values: torch.cat(values, -1), in_keys=["q1", "q2"], out_keys=["state_action_value"]
    )
    module = TensorDictSequential(*tower("q1"), *tower("q2"), join)
    critic = CustomCritic(module)
    observation, action = torch.randn(5, 3), torch.randn(5, 2)
    expected = module(TensorDict(observation=observation, action=action, batch_size=[5]))
    values = critic.evaluate(critic.encode(observation), action, torch.zeros(5, dtype=torch.long))
    torch.testing.assert_close(values, expected["state_action_value"])
    values.sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())


def test_another_module_in_place_of_the_first_is_told():
    critic = CustomCritic(Network())
    with pytest.raises(
        AttributeError, match=r"cannot be replaced: expected CustomCritic\(module\)"
    ):
        critic.module = Network()


@pytest.mark.parametrize("batch", [(0,), (2, 0)])
def test_no_states_have_no_values(batch):
    rows = torch.zeros(*batch, OBS), torch.zeros(*batch, ACTION), torch.zeros(batch).long()
    for critic in (CustomCritic(Network()), NoiseLevelCritic(OBS, ACTION, num_cells=[8])):
        assert critic(*rows).shape[:-1] == batch


def test_one_key_instead_of_a_list_is_told():
    with pytest.raises(ValueError, match=r"observation_keys as a list of keys, such as .'pixels'."):
        CustomCritic(nn.Linear(3, 1), observation_keys="pixels")
