"""Evaluation: whole episodes only, and no trace in the training's random streams."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import RandomPolicy

from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Eval
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.evaluation import evaluate, make_eval_env

CPU = torch.device("cpu")


class Countdown(gym.Env):
    """Pays 1 per step and ends after a number of steps drawn at reset; steps past it pay 100."""

    observation_space = gym.spaces.Box(0, 100, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(3, 30))
        self.episodes = getattr(self, "episodes", 0) + 1
        return np.array([self.left], np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.array([self.left], np.float32), 1.0, self.left == 0, False, {}


@pytest.fixture
def countdown():
    gym.register("Countdown-v0", Countdown)
    yield make_vector_env("Countdown-v0", num_envs=6, seed=0)
    del gym.registry["Countdown-v0"]


def test_each_copy_counts_exactly_one_whole_episode(countdown):
    result = evaluate(RandomPolicy(countdown.action_spec), countdown, seed=5, device=CPU)
    lengths = []
    for seed in range(5, 11):
        env = Countdown()
        env.reset(seed=seed)
        env.reset()  # seeding resets, and the evaluation resets once more
        lengths.append(env.left)
    assert len(set(lengths)) > 2
    assert result == {
        "return_mean": pytest.approx(np.mean(lengths)),
        "return_std": pytest.approx(np.std(lengths)),
        "num_episodes": 6.0,
        "episode_length": pytest.approx(np.mean(lengths)),
    }


def test_evaluation_is_deterministic_and_leaves_the_random_streams_alone():
    env = make_vector_env("Hopper-v4", num_envs=3, seed=0)
    policy = RandomPolicy(env.action_spec)
    torch.manual_seed(7)
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()
    first = evaluate(policy, env, seed=1, device=CPU)
    assert torch.equal(torch.get_rng_state(), before)
    assert (np.random.get_state()[1] == numpy_before).all()
    torch.rand(3)
    assert evaluate(policy, env, seed=1, device=CPU) == first
    assert evaluate(policy, env, seed=2, device=CPU) != first


def test_policy_runs_deterministically_without_gradients(countdown):
    def policy(data):
        assert exploration_type() == ExplorationType.DETERMINISTIC
        assert not torch.is_grad_enabled()
        return data.set("action", torch.zeros(6, 1))

    evaluate(policy, countdown, seed=0, device=CPU)
    assert torch.is_grad_enabled()


def test_an_environment_without_a_time_limit_needs_one_for_its_evaluation(countdown):
    settings = Eval(
        interval=1, episodes=2, seed=0, random=False, draws="fresh", max_steps=None,
        stop_return=None,
    )  # fmt: skip
    with pytest.raises(RunError, match="Countdown-v0 has no time limit.*eval.max_steps=1000"):
        make_eval_env("Countdown-v0", settings)
    env = make_eval_env("Countdown-v0", settings.model_copy(update={"max_steps": 2}))
    result = evaluate(RandomPolicy(env.action_spec), env, seed=5, device=CPU)
    assert result["episode_length"] == 2.0
