"""Generates an offline data set in the manner of D4RL: "D4RL-style, locally generated".

    python recipes/make_dataset.py tier=random env=halfcheetah
    python recipes/make_dataset.py tier=medium_replay env=halfcheetah

`random` has uniform actions. `medium_replay` is every transition of a SAC run
(`configs/dataset_sac.yaml`) that stops when its evaluations reach a return, and `medium` is
episodes of that run's final policy, actions sampled. Every key is in `configs/make_dataset.yaml`.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from online_mujoco import make_agent, make_device, train
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_aca.offline import DatasetError, DatasetWriter, OfflineDataset, reference_scores
from torchrl_aca.training.checkpoint import read_checkpoint, restore
from torchrl_aca.training.config import resumed_config
from torchrl_aca.training.envs import make_env, make_vector_env
from torchrl_aca.training.errors import RunError
from torchrl_aca.training.report import plot_returns, versions

Episode = dict[str, Any]
TIERS = ("random", "medium", "medium_replay")


def make_dataset(cfg: DictConfig, env_choice: str) -> OfflineDataset:
    """Generates the data set that the configuration describes.

    Raises:
        DatasetError: If the directory exists already, or the returns lie outside their band.
        RunError: If a key is wrong, or the SAC run was stopped before its end.
    """
    if cfg.tier not in TIERS:
        raise RunError(f"tier={cfg.tier}: expected one of {list(TIERS)}.")
    path = Path(cfg.path or f"datasets/{env_choice}-{cfg.tier}")
    if path.exists():
        raise DatasetError(f"{path} exists already. Choose another path, or delete it first.")
    source = None if cfg.tier == "random" else sac_run(cfg, env_choice)
    env = make_env(cfg.env.name)
    with DatasetWriter(
        path,
        env.observation_space.shape[0],
        env.action_space.shape[0],
        action_bounds=(env.action_space.low.tolist(), env.action_space.high.tolist()),
    ) as writer:
        for episode in episodes_of(cfg, env, source):
            writer.add_episode(**episode)
        if cfg.check:
            check_returns(cfg, [r for i, r in enumerate(writer.returns) if i not in writer.cut])
        dataset = writer.finish(
            name=f"{env_choice} {cfg.tier} (D4RL-style, locally generated)",
            env_id=cfg.env.name,
            reference_scores=reference_scores(cfg.env.name),
            provenance=provenance(cfg, source),
        )
    plot_returns(path / "returns.png", dataset.episode_returns(), dataset.metadata["name"])
    return dataset


def episodes_of(cfg: DictConfig, env: gym.Env, source: Path | None) -> Iterator[Episode]:
    """The episodes of a tier, one after the other."""
    if source is None:
        env.action_space.seed(cfg.seed)
        return rollouts(env, lambda observation: env.action_space.sample(), cfg)
    if cfg.tier == "medium":
        return rollouts(env, sampled_actions(source, cfg.seed), cfg)
    return replayed(source)


def rollouts(
    env: gym.Env, act: Callable[[np.ndarray], np.ndarray], cfg: DictConfig
) -> Iterator[Episode]:
    """Whole episodes of `act`, the i-th begun with `cfg.seed + i`."""
    names = ("observation", "action", "next_observation", "reward", "terminated", "truncated")
    for number in tqdm(range(cfg.episodes), unit="episode"):
        observation, _ = env.reset(seed=cfg.seed + number)
        steps, done = [], False
        while not done:
            action = act(observation)
            following, reward, terminated, truncated, _ = env.step(action)
            steps.append((observation, action, following, reward, terminated, truncated))
            observation, done = following, terminated or truncated
        yield {
            name: np.array(column)
            for name, column in zip(names, zip(*steps, strict=True), strict=True)
        }


def sampled_actions(run_dir: Path, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """The stochastic policy of a finished run."""
    cfg, checkpoint = OmegaConf.load(run_dir / "config.yaml"), read_checkpoint(run_dir)
    agent = make_agent(cfg, make_vector_env(cfg.env.name, 1, 0), make_device(cfg))
    restore({"agent.loss": agent.state["loss"]}, checkpoint["parts"])
    torch.manual_seed(seed)

    def act(observation: np.ndarray) -> np.ndarray:
        data = TensorDict(observation=torch.from_numpy(observation))
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return agent.policy(data)["action"].numpy()

    return act


def replayed(run_dir: Path) -> Iterator[Episode]:
    """Every transition of a run with one environment, from the buffer in its checkpoint."""
    parts = read_checkpoint(run_dir)["parts"]
    rows, frames = parts["buffer"]["rows"], parts["counters"]["frames"]
    copies, size = len(parts["env"]["copies"]), len(rows["action"])
    if copies != 1 or size != frames:
        raise RunError(
            f"{run_dir} has {copies} copies and {size} of {frames} frames in its buffer; expected "
            "one copy and a buffer that holds them all. Set collector.num_envs and buffer.capacity."
        )
    done = rows["next.done"].flatten()
    ends = [*(done.nonzero().flatten() + 1).tolist(), size]
    for start, end in zip([0, *ends], ends, strict=False):
        if start == end:  # the buffer ends with an episode
            continue
        terminated = rows["next.terminated"][start:end].flatten()
        complete = bool(done[end - 1])
        truncated = done[start:end] & ~terminated
        truncated[-1] |= not complete
        yield {
            "observation": rows["observation"][start:end],
            "action": rows["action"][start:end],
            "next_observation": rows["next.observation"][start:end],
            "reward": rows["next.reward"][start:end].flatten(),
            "terminated": terminated,
            "truncated": truncated,
            "complete": complete,
        }


def sac_run(cfg: DictConfig, env_choice: str) -> Path:
    """The directory of the finished SAC run; starts it, or goes on with it, where need be."""
    run_dir = Path(cfg.sac.run_dir or f"runs/{env_choice}-sac")
    overrides = [f"env={env_choice}", f"seed={cfg.sac.seed}", *cfg.sac.overrides]
    if not (run_dir / "config.yaml").exists():
        train(hydra.compose("dataset_sac", [*overrides, f"run_dir={run_dir}"]))
    elif not is_finished(run_dir):
        train(*resumed_config(hydra.compose("dataset_sac", [*overrides, f"resume={run_dir}"]), []))
    if not is_finished(run_dir):
        raise RunError(f"the SAC run in {run_dir} was stopped. Go on with the same command.")
    return run_dir


def is_finished(run_dir: Path) -> bool:
    """Whether a run has made all its updates, or stopped at the return it was to reach."""
    cfg, history = OmegaConf.load(run_dir / "config.yaml"), evaluations(run_dir)
    if cfg.eval.stop_return is not None and len(history) > 1:
        latest = sum(row["return_mean"] for row in history[-2:]) / 2
        if latest >= cfg.eval.stop_return:
            return True
    return bool(history) and history[-1]["updates"] >= cfg.optim.total_updates


def evaluations(run_dir: Path) -> list[dict[str, float]]:
    """The rows of a run's eval.csv."""
    with open(run_dir / "eval.csv") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def check_returns(cfg: DictConfig, returns: list[float]) -> None:
    """Raises `DatasetError` if a statistic of the returns lies outside its band."""
    values = np.array(returns)
    bands = cfg.bands.get(cfg.env.name, {}).get(cfg.tier, {})
    for name, (low, high) in bands.items():
        value = getattr(values, name)()
        if not (-np.inf if low is None else low) <= value <= (np.inf if high is None else high):
            raise DatasetError(
                f"the {name} of the {len(values)} returns is {value:.1f}; expected {low} to "
                f"{high}. Nothing was kept. With few episodes this can be chance: raise "
                "episodes, or take it as it is with check=false."
            )


def provenance(cfg: DictConfig, source: Path | None) -> dict[str, Any]:
    """What the metadata say about where the data come from."""
    facts = {
        "command": " ".join(["python", *sys.argv]),
        "versions": versions(),
        "config": OmegaConf.to_container(cfg),
    }
    if source is not None:
        facts["sac"] = {
            "config": OmegaConf.to_container(OmegaConf.load(source / "config.yaml")),
            "evaluations": evaluations(source),
        }
    return facts


@hydra.main(version_base="1.3", config_path="configs", config_name="make_dataset")
def main(cfg: DictConfig) -> None:
    """Generates a data set and says what it holds; an error is told in one message."""
    try:
        dataset = make_dataset(cfg, HydraConfig.get().runtime.choices.env)
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None
    returns = dataset.metadata["returns"]
    print(
        f"{dataset.path}: {dataset.metadata['transitions']} transitions in "
        f"{dataset.metadata['episodes']} episodes, return {returns['mean']:.1f} ± "
        f"{returns['std']:.1f} ({returns['min']:.1f} to {returns['max']:.1f})"
    )


if __name__ == "__main__":
    main()
