"""Where the episodes of `make_dataset.py` come from: random actions, or a SAC run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_aca.errors import RunError
from torchrl_aca.training import load_policy
from torchrl_aca.training.checkpoint import read_checkpoint

Episode = dict[str, Any]  # keywords of `DatasetWriter.add_episode`
COLUMNS = ("observation", "action", "next_observation", "reward", "terminated", "truncated")


def rollouts(
    env: gym.Env, act: Callable[[np.ndarray], np.ndarray], episodes: int, seed: int
) -> Iterator[Episode]:
    """Whole episodes of `act`, the i-th begun with `seed + i`."""
    for number in tqdm(range(episodes), unit="episode", disable=None):
        observation, _ = env.reset(seed=seed + number)
        steps, done = [], False
        while not done:
            action = act(observation)
            following, reward, terminated, truncated, _ = env.step(action)
            steps.append((observation, action, following, reward, terminated, truncated))
            observation, done = following, terminated or truncated
        columns = map(np.array, zip(*steps, strict=True))
        yield dict(zip(COLUMNS, columns, strict=True))


def uniform_actions(env: gym.Env, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """A policy that looks at nothing."""
    env.action_space.seed(seed)
    return lambda observation: env.action_space.sample()


def sampled_actions(run_dir: Path, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """The stochastic policy that a run ended with."""
    policy = load_policy(run_dir)
    torch.manual_seed(seed)

    def act(observation: np.ndarray) -> np.ndarray:
        data = TensorDict(observation=torch.from_numpy(observation))
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return policy(data)["action"].numpy()

    return act


def replayed(run_dir: Path) -> Iterator[Episode]:
    """Every transition of a run with one environment, from the buffer in its checkpoint.

    Raises:
        RunError: If the buffer does not hold them all, in the order in which they were made.
    """
    parts = read_checkpoint(run_dir)["parts"]
    rows, frames = parts["buffer"]["rows"], parts["collection"]["frames"]
    num_envs, size = len(parts["collection"]["episodes"]["returns"]), len(rows["action"])
    if num_envs != 1 or size != frames:
        raise RunError(
            f"{run_dir} has {num_envs} parallel environments, and {size} of its {frames} frames "
            "in the buffer; expected one, and all frames. Delete the run, or give another "
            "sac.run_dir, and set collector.num_envs=1 and buffer.capacity in sac.overrides."
        )
    ends = (rows["next.done"].flatten().nonzero().flatten() + 1).tolist()
    if not ends or ends[-1] < size:  # the run stopped inside an episode
        ends.append(size)
    for start, end in zip([0, *ends], ends, strict=False):
        observation, action, following, reward, done, terminated = (
            rows[key][start:end]
            for key in (
                "observation",
                "action",
                "next.observation",
                "next.reward",
                "next.done",
                "next.terminated",
            )
        )
        complete = bool(done[-1])
        done[-1] = True
        columns = (
            observation,
            action,
            following,
            reward.flatten(),
            terminated.flatten(),
            (done & ~terminated).flatten(),
        )
        yield {**dict(zip(COLUMNS, columns, strict=True)), "complete": complete}
