"""ACA from an environment's specs in one call, and what it says of environments that do not fit."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, RenameTransform, TransformedEnv

from torchrl_aca import (
    ACALoss,
    CriticGuidedDenoisingActor,
    NoiseLevelCritic,
    NoiseSchedule,
    make_aca,
    make_aca_actor,
)
from torchrl_aca.training.envs import make_vector_env

SMALL = {"num_cells": [8], "num_steps": 3, "num_candidates": 2}


class TwoVectors(EnvBase):
    """Two observations, a two-dimensional action and an image that nobody reads."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(
            position=Unbounded(3), robot=Composite(velocity=Unbounded(2)), image=Unbounded((3, 4))
        )
        self.action_spec = Bounded(-2.0, 2.0, shape=(2,))
        self.reward_spec = Unbounded(1)

    def _reset(self, tensordict):
        return self.observation_spec.rand()

    def _step(self, tensordict):
        done = torch.zeros(1, dtype=torch.bool)
        return self.observation_spec.rand().update({"reward": torch.ones(1), "done": done})

    def _set_seed(self, seed):
        torch.manual_seed(seed)


def test_it_is_what_the_parts_are_when_they_are_built_by_hand():
    env = GymEnv("Pendulum-v1")
    torch.manual_seed(0)
    aca = make_aca(
        env,
        num_target_candidates=4,
        loss={"reward_scale": 2.0},
        gamma=0.9,
        tau=0.1,
        lr=0.2,
        alpha_lr=0.3,
    )
    torch.manual_seed(0)
    critic = NoiseLevelCritic(3, 1)
    actor = CriticGuidedDenoisingActor(
        critic, NoiseSchedule.cosine(20), spec=env.action_spec_unbatched
    )
    loss = ACALoss(actor, num_target_candidates=4, reward_scale=2.0)
    loss.make_value_estimator(gamma=0.9)
    for name, value in loss.state_dict().items():
        assert torch.equal(aca.loss.state_dict()[name], value), name
    assert aca.actor.half_range == 2  # Pendulum's torque
    assert aca.loss.num_target_candidates == 4 and aca.loss.reward_scale == 2
    groups = aca.optimizer.param_groups[0], aca.alpha_optimizer.param_groups[0]
    assert [group["lr"] for group in groups] == [0.2, 0.3]
    assert groups[1]["params"] == [aca.loss.log_alpha]
    with torch.no_grad():
        aca.actor.critic.value.bias.add_(1)
        before = aca.loss.target_qvalue_network_params["value", "bias"].clone()
        aca.target_update.step()
        after = aca.loss.target_qvalue_network_params["value", "bias"]
    torch.testing.assert_close(after, before + 0.1)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_parallel_environments_give_the_sizes_of_one(num_envs):
    aca = make_aca(make_vector_env("Hopper-v4", num_envs, 0), **SMALL)
    critic = aca.actor.critic
    assert (critic.observation_dim, critic.action_dim) == (11, 3)


def test_several_observations_are_joined_in_the_order_of_their_keys():
    env = TwoVectors()
    keys = ["position", ("robot", "velocity")]
    aca = make_aca(env, observation_keys=keys, **SMALL)
    assert aca.actor.in_keys == keys and aca.actor.critic.observation_dim == 5
    data = env.rollout(4, aca.actor)
    assert data["action"].shape == (4, 2)
    losses = aca.loss(data)
    losses["loss_qvalue"].backward()
    assert losses["loss_qvalue"].isfinite() and aca.actor.critic.value.weight.grad is not None

    joined = NoiseLevelCritic(5, 2, num_cells=[8], num_steps=3)
    joined.load_state_dict(aca.actor.critic.state_dict())
    rows = TensorDict(action=data["action"], noise_level=torch.ones(4).long(), batch_size=[4])
    parts = data["position"], data["robot", "velocity"]
    one = joined(rows.copy().set("observation", torch.cat(parts, -1)))["state_action_value"]
    two = aca.actor.critic(data.select(*keys).update(rows))["state_action_value"]
    assert torch.equal(one, two)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (["observation"], r"a vector 'observation' among its observations, got only \["),
        (["position", "image"], r"a vector 'image' .* got shape \(3, 4\). Pass observation_keys"),
    ],
)
def test_observations_that_are_not_there_or_no_vectors_are_told(keys, told):
    with pytest.raises(ValueError, match=told):
        make_aca(TwoVectors(), observation_keys=keys, **SMALL)


def test_what_is_no_environment_or_no_spec_of_one_action_is_told():
    with pytest.raises(TypeError, match=r"got TimeLimit. Wrap it, as in torchrl.envs.GymWrapper"):
        make_aca(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="such as env.action_spec_unbatched"):
        make_aca_actor(11, make_vector_env("Hopper-v4", 2, 0).action_spec, **SMALL)
    with pytest.raises(ValueError, match="schedule to be one of .*got 'steep'"):
        make_aca(GymEnv("Pendulum-v1"), schedule="steep")


def test_a_wrong_observation_dim_or_number_of_keys_is_told():
    critic = NoiseLevelCritic(4, 1, num_cells=[8], num_steps=3)
    told = "observation_dim=4, got observations of 3 numbers. Build it with observation_dim=3"
    actor = CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(3), num_candidates=2)
    data = TensorDict(observation=torch.zeros(2, 3), batch_size=[2])
    with pytest.raises(ValueError, match=told):
        actor(data)
    with pytest.raises(ValueError, match=told):
        critic(torch.zeros(2, 3), torch.zeros(2, 1), torch.zeros(2).long())
    for keys in (["observation", "action"], "observation"):
        with pytest.raises(ValueError, match="at least three, got"):
            NoiseLevelCritic(4, 1, in_keys=keys)
    two = CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(3), in_keys=["a", "b"])
    data = TensorDict(a=torch.zeros(2, 4), b=torch.zeros(2, 1), batch_size=[2])
    with pytest.raises(ValueError, match=r"got observations of 4 \+ 1 numbers"):
        two(data)


@pytest.mark.parametrize("key", ["act", ("agents", "act")])
def test_the_action_may_have_another_key(key):
    env = TransformedEnv(TwoVectors(), RenameTransform([], [], ["action"], [key]))
    keys = ["position", ("robot", "velocity")]
    aca = make_aca(env, observation_keys=keys, **SMALL)
    assert aca.actor.out_keys == [key]
    data = env.rollout(4, aca.actor)
    assert data[key].shape == (4, 2)
    assert aca.loss(data)["loss_qvalue"].isfinite()


@pytest.mark.parametrize("same_process", [True, False])
def test_a_copy_is_a_learner_of_its_own(same_process):
    aca = make_aca(GymEnv("Pendulum-v1"), **SMALL)
    data = GymEnv("Pendulum-v1").rollout(4, aca.actor)
    learn(aca, data)  # so that optimisers have moments, and targets are not the online ones
    clone = copy.deepcopy(aca) if same_process else pickle.loads(pickle.dumps(aca))
    kept = {name: value.clone() for name, value in aca.loss.state_dict().items()}
    for name, value in clone.loss.state_dict().items():
        assert torch.equal(value, kept[name]), name
    torch.manual_seed(1)
    learn(clone, data)
    for name, value in aca.loss.state_dict().items():
        assert torch.equal(value, kept[name]), name
    torch.manual_seed(1)
    learn(aca, data)
    again, moved = aca.loss.state_dict(), set()
    for name, value in clone.loss.state_dict().items():
        assert torch.equal(value, again[name]), name
        if not value.equal(kept[name]):
            moved.add(name.split(".")[0])
    assert {"qvalue_network_params", "target_qvalue_network_params", "log_alpha"} <= moved


def learn(aca, data) -> None:
    losses = aca.loss(data)
    aca.loss.zero_grad()
    sum(losses[name] for name in aca.loss.loss_names).backward()
    aca.optimizer.step()
    aca.alpha_optimizer.step()
    aca.target_update.step()


def test_reward_and_flags_are_read_where_the_environment_has_them():
    old = ["reward", "done", "terminated"]
    new = [("agents", "r"), ("agents", "done"), ("agents", "terminated")]
    env = TransformedEnv(TwoVectors(), RenameTransform(old, new, [], []))
    aca = make_aca(env, observation_keys=["position"], **SMALL)
    keys = aca.loss.tensor_keys
    assert [keys.reward, keys.done, keys.terminated] == new
    assert aca.loss(env.rollout(4, aca.actor))["loss_qvalue"].isfinite()


def test_one_of_several_actions_is_chosen_by_name():
    class TwoActions(TwoVectors):
        def __init__(self):
            super().__init__()
            leaf = self.action_spec.clone()
            self.action_spec = Composite(first=leaf, second=leaf.clone())

    keys = {"observation_keys": ["position"]}
    with pytest.raises(ValueError, match=r"one action, got \['first', 'second'\]. Pass out_keys"):
        make_aca(TwoActions(), **keys, **SMALL)
    aca = make_aca(TwoActions(), out_keys=["second"], **keys, **SMALL)
    assert aca.actor.out_keys == ["second"]


def test_observation_keys_that_are_not_in_a_list_are_told():
    with pytest.raises(ValueError, match="Expected observation_keys as a list of keys"):
        make_aca(TwoVectors(), observation_keys="position", **SMALL)


def test_an_action_that_is_no_vector_is_told():
    with pytest.raises(ValueError, match="bounded, continuous action spec"):
        make_aca(GymEnv("CartPole-v1", categorical_action_encoding=True))
