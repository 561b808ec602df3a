"""Where the episodes of `make_dataset.py` come from: random actions, or a SAC run."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import hydra
import numpy as np
import torch
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from online_mujoco import make_agent, make_device, train
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import (
    list_checkpoints,
    read_checkpoint,
    restore,
    updates_of,
)
from torchrl_aca.training.config import apply_overrides, require_equal, resumed_config
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.run import has_reached

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
    cfg, checkpoint = OmegaConf.load(run_dir / "config.yaml"), read_checkpoint(run_dir)
    device = make_device(cfg)
    agent = make_agent(cfg, make_vector_env(cfg.env.name, 1, 0), device)
    restore({"agent.loss": agent.state["loss"]}, checkpoint["parts"])
    torch.manual_seed(seed)

    def act(observation: np.ndarray) -> np.ndarray:
        data = TensorDict(observation=torch.from_numpy(observation)).to(device)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return agent.policy(data)["action"].cpu().numpy()

    return act


def replayed(run_dir: Path) -> Iterator[Episode]:
    """Every transition of a run with one environment, from the buffer in its checkpoint.

    Raises:
        RunError: If the buffer does not hold them all, in the order in which they were made.
    """
    parts = read_checkpoint(run_dir)["parts"]
    rows, frames = parts["buffer"]["rows"], parts["counters"]["frames"]
    copies, size = len(parts["env"]["copies"]), len(rows["action"])
    if copies != 1 or size != frames:
        raise RunError(
            f"{run_dir} has {copies} copies of the environment, and {size} of its {frames} frames "
            "in the buffer; expected one copy, and all frames. Delete the run, or give another "
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


def finished_sac_run(cfg: DictConfig, run_dir: Path) -> Path:
    """Starts the SAC run of a `make_dataset.yaml`, or goes on with it, where need be.

    Returns:
        Its directory, `run_dir`.

    Raises:
        RunError: If the run is another one than the configuration asks for, or was stopped.
    """
    typed = [f"env.name={cfg.env.name}", f"seed={cfg.sac.seed}", *cfg.sac.overrides]
    try:
        wanted = hydra.compose("dataset_sac", [*typed, f"run_dir={run_dir}"])
    except HydraException as error:
        raise RunError(f"sac.overrides: {str(error).splitlines()[0]}") from None
    if not (run_dir / "config.yaml").exists():
        train(wanted)
    elif not list_checkpoints(run_dir / "checkpoints"):
        raise RunError(
            f"{run_dir} holds a run without a checkpoint: it is at work, or it was killed before "
            "its first one. If it was killed, delete the directory; the same command starts anew."
        )
    else:
        stored = OmegaConf.load(run_dir / "config.yaml")
        require_equal(wanted, stored, wanted, "the SAC run's configuration")
        typed += ["eval.stop_return", "optim.total_updates"]  # where it ends is this command's say
        apply_overrides(stored, wanted, typed)
        if not is_finished(run_dir, stored):
            wanted.resume = str(run_dir)
            train(*resumed_config(wanted, typed))
    if not is_finished(run_dir, OmegaConf.load(run_dir / "config.yaml")):
        raise RunError(
            f"the SAC run in {run_dir} was stopped before its end, so no data set was made. The "
            "same command goes on with it."
        )
    return run_dir


def is_finished(run_dir: Path, cfg: DictConfig) -> bool:
    """Whether a run has made all its updates, or stopped at the return it was to reach."""
    history = evaluations(run_dir)
    updates = history[-1]["updates"]
    # A run that was killed between its last evaluation and its last checkpoint still has to go on.
    saved = updates_of(list_checkpoints(run_dir / "checkpoints")[-1]) == updates
    enough = updates >= cfg.optim.total_updates or has_reached(history, cfg.eval.stop_return)
    return saved and enough


def evaluations(run_dir: Path) -> list[dict[str, float]]:
    """The rows of a run's eval.csv."""
    with open(run_dir / "eval.csv", newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
