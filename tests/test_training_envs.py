"""Environments: true final observations, right flags, exact saved states, checked spaces."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco.inverted_pendulum_v4 import InvertedPendulumEnv
from torchrl.collectors import Collector
from torchrl.modules import RandomPolicy

from torchrl_aca.errors import RunError
from torchrl_aca.training.collection import Collection
from torchrl_aca.training.config import Collector as CollectorSettings
from torchrl_aca.training.config import Env
from torchrl_aca.training.env_state import EnvState
from torchrl_aca.training.envs import (
    _quiet_construction,
    make_env,
    make_vector_env,
)


def bare_env(name: str, seed: int) -> gym.Env:
    with _quiet_construction():  # MuJoCo would leave a MUJOCO_LOG.TXT
        env = gym.make(name)
    env.reset(seed=seed)
    return env


def roll(env, actions: torch.Tensor):
    """Steps through actions (steps, copies, A); returns what was stepped and what follows."""
    data, stepped, following = env.reset(), [], []
    for action in actions:
        data["action"] = action
        now, data = env.step_and_maybe_reset(data)
        stepped.append(now.clone())
        following.append(data.clone())
    return torch.stack(stepped), torch.stack(following)


@pytest.mark.parametrize(
    ("name", "steps", "flag"),
    [("HalfCheetah-v4", 1003, "truncated"), ("Hopper-v4", 120, "terminated")],
)
def test_final_observation_and_flags_equal_a_bare_environment(name, steps, flag):
    env = make_vector_env(name, num_envs=2, seed=3)
    torch.manual_seed(0)
    actions = torch.stack([env.action_spec.rand() for _ in range(steps)])
    stepped, following = roll(env, actions)
    other = {"truncated": "terminated", "terminated": "truncated"}[flag]
    ends = 0
    for copy in range(2):
        bare = bare_env(name, seed=3 + copy)
        bare.reset()  # make_vector_env resets with the seed, then `roll` resets once more
        for step in range(steps):
            observation, reward, terminated, truncated, _ = bare.step(actions[step, copy].numpy())
            row = stepped[step, copy]["next"]
            assert torch.equal(row["observation"], torch.tensor(observation, dtype=torch.float32))
            assert row["reward"].item() == np.float32(reward)
            assert row["terminated"].item() == terminated
            assert row["truncated"].item() == truncated
            if terminated or truncated:
                ends += 1
                assert row[flag].item() and not row[other].item() and row["done"].item()
                observation, _ = bare.reset()
            start = following[step, copy]
            assert torch.equal(start["observation"], torch.tensor(observation, dtype=torch.float32))
            assert not start["done"].item()
    assert ends >= 2


@pytest.mark.parametrize("name", ["Humanoid-v4", "Ant-v4", "Reacher-v4", "Pusher-v5"])
def test_restored_environment_goes_on_bit_for_bit(name):
    env = make_vector_env(name, num_envs=2, seed=0)
    torch.manual_seed(0)
    actions = torch.stack([env.action_spec.rand() for _ in range(75)])
    roll(env, actions[:7])
    state = EnvState(env).state_dict()
    other = make_vector_env(name, num_envs=2, seed=99)
    EnvState(other).load_state_dict(state)

    def rest(env, data):
        rows = []
        for action in actions[7:]:
            data["action"] = action
            now, data = env.step_and_maybe_reset(data)
            rows.append(now.clone())
        return torch.stack(rows)

    resumed_start = other.reset()
    unbroken_start = resumed_start.clone()  # the first environment must not be reset
    unbroken, resumed = rest(env, unbroken_start), rest(other, resumed_start)
    for key in (("next", "observation"), ("next", "reward"), ("next", "done"), "observation"):
        assert torch.equal(unbroken[key], resumed[key]), key


def test_reset_returns_the_restored_observation_until_the_first_step():
    env = make_env("Pendulum-v1")
    vector = make_vector_env("Hopper-v4", num_envs=1, seed=0)
    roll(vector, torch.zeros(3, 1, 3))
    state = EnvState(vector).state_dict()
    EnvState(vector).load_state_dict(state)
    first, second = vector.reset()["observation"], vector.reset()["observation"]
    assert torch.equal(first, second)
    assert torch.equal(first[0], state["copies"][0]["observation"])
    vector.rand_step(vector.reset())
    assert not torch.equal(vector.reset()["observation"], first)
    assert env.observation_space.dtype == np.float32


def test_an_environment_without_a_simulator_state_resumes_with_a_new_episode():
    env = make_vector_env("Pendulum-v1", num_envs=2, seed=0)
    state = EnvState(env).state_dict()
    starts = []
    for seed in (1, 2):
        other = make_vector_env("Pendulum-v1", num_envs=2, seed=seed)
        EnvState(other).load_state_dict(state)
        starts.append(other.reset()["observation"])
    assert torch.equal(*starts)


def test_collector_starts_the_next_episode_from_its_reset():
    env = make_vector_env("Hopper-v4", num_envs=5, seed=0)
    torch.manual_seed(0)
    collector = Collector(
        env, RandomPolicy(env.action_spec), frames_per_batch=300, total_frames=300
    )
    (data,) = list(collector)
    done = data["next", "done"].squeeze(-1)[:, :-1]
    assert done.any()
    jump = data["next", "observation"][:, :-1] != data["observation"][:, 1:]
    assert torch.equal(jump.any(-1), done)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Discrete(3), "expected a one-dimensional Box"),
        (gym.spaces.Box(-np.inf, np.inf, (2,)), "unbounded actions"),
        (gym.spaces.Box(-1, 1, (2, 2)), "expected a one-dimensional Box"),
    ],
)
def test_unsuitable_action_spaces_are_refused(space, message):
    class Odd(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (2,))
        action_space = space

    gym.register("Odd-v0", Odd, disable_env_checker=True)
    try:
        with pytest.raises(RunError, match=message):
            make_env("Odd-v0")
    finally:
        del gym.registry["Odd-v0"]


def test_unknown_environment_is_named():
    with pytest.raises(RunError, match="NoSuchTask-v0.*cannot be made"):
        make_env("NoSuchTask-v0")


class Parts(gym.Env):
    """An observation of several parts, with a keyword of its own."""

    observation_space = gym.spaces.Dict(
        velocity=gym.spaces.Box(-1, 1, (2,)),
        angle=gym.spaces.Box(-1, 1, (), dtype=np.float64),
        mode=gym.spaces.Discrete(3),
    )
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, reward: float = 1.0) -> None:
        self.reward = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return {"velocity": np.float32([0.1, 0.2]), "angle": np.array(0.3), "mode": 1}, {}

    def step(self, action):
        return self.reset()[0], self.reward, False, False, {}


@pytest.fixture
def parts_env():
    gym.register("Parts-v0", Parts, max_episode_steps=3, disable_env_checker=True)
    yield "Parts-v0"
    del gym.registry["Parts-v0"]


def test_an_observation_of_several_parts_becomes_one_vector(parts_env):
    env = make_vector_env(parts_env, num_envs=2, seed=0)
    observation = env.reset()["observation"]
    keys = list(Parts.observation_space)
    flat = {"velocity": [0.1, 0.2], "angle": [0.3], "mode": [0.0, 1.0, 0.0]}
    expected = torch.tensor([number for key in keys for number in flat[key]])
    assert torch.equal(observation, expected.expand(2, 6))
    assert observation.dtype == torch.float32
    for _ in range(3):
        data = env.rand_step(env.reset())
    assert data["next", "observation"].shape == (2, 6)


def test_keywords_and_wrappers_reach_the_environment(parts_env):
    halve = {"name": f"{__name__}:Halve"}
    clip = {"name": "ClipReward", "min_reward": 0.0, "max_reward": 0.75}
    for wrappers, reward in (
        ([], 2.0),
        ([clip], 0.75),
        ([clip, halve], 0.375),
        ([halve, clip], 0.75),
    ):
        task = Env.model_validate(
            {"name": parts_env, "kwargs": {"reward": 2.0}, "wrappers": wrappers}
        )
        env = make_vector_env(task, num_envs=1, seed=0)
        assert env.rand_step(env.reset())["next", "reward"].item() == reward


class Halve(gym.RewardWrapper):
    def reward(self, reward):
        return reward / 2


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"kwargs": {"colour": "red"}}, "colour.*env.kwargs=.*must be what it takes"),
        ({"wrappers": [{"name": "NoSuchWrapper"}]}, "NoSuchWrapper cannot be put around"),
        ({"wrappers": [{"name": "ClipReward", "low": 0}]}, "ClipReward.*keyword argument 'low'"),
        ({"wrappers": [{"name": "no_module:Wrapper"}]}, "No module named 'no_module'"),
    ],
)
def test_wrong_keywords_and_wrappers_are_told(parts_env, section, message):
    with pytest.raises(RunError, match=message):
        make_env(Env.model_validate({"name": parts_env, **section}))


class Goal(InvertedPendulumEnv):
    """One of MuJoCo's, with a state beside the simulator's."""

    def reset_model(self):
        self.goal = self.np_random.uniform(-1, 1)
        return super().reset_model()


@pytest.mark.parametrize(
    ("name", "wrappers", "exact"),
    [
        ("Hopper-v4", [], True),
        ("Pendulum-v1", [], False),
        ("Hopper-v4", [{"name": "NormalizeReward"}], False),
        ("Goal-v0", [], False),
    ],
)
def test_an_episode_goes_on_only_where_its_whole_state_is_known(name, wrappers, exact, monkeypatch):
    spec = gym.envs.registration.EnvSpec("Goal-v0", Goal, max_episode_steps=100)
    monkeypatch.setitem(gym.registry, "Goal-v0", spec)
    env = make_vector_env(Env.model_validate({"name": name, "wrappers": wrappers}), 1, seed=0)
    settings = CollectorSettings(num_envs=1, frames_per_batch=4, warmup_frames=4, warmup="random")
    collection = Collection(env, RandomPolicy(env.action_spec), settings)
    assert (collection.why_unsavable() is None) == exact
    next(iter(collection))
    state = collection.state_dict()
    begun = collection.episodes.returns.clone()
    assert begun.item() != 0
    collection.load_state_dict(state)
    assert collection.episodes.returns.equal(begun if exact else torch.zeros_like(begun))
    collection.close()


def test_deepmind_control_comes_through_shimmy():
    pytest.importorskip("shimmy", reason="needs the extra dmc")
    pytest.importorskip("dm_control", reason="needs the extra dmc")
    env = make_vector_env("shimmy:dm_control/walker-walk-v0", num_envs=2, seed=0, max_steps=3)
    data = env.rollout(5)
    assert data["observation"].shape == (2, 3, 24)
    assert data["next", "truncated"][:, -1].all() and not data["next", "terminated"].any()
