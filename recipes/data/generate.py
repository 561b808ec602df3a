"""Generates a data set: the episodes, their check, and what the metadata say."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np
from omegaconf import OmegaConf
from pydantic import Field

from data.episodes import Episode, replayed, rollouts, sampled_actions, uniform_actions
from data.sac_run import finished_sac_run
from torchrl_aca.errors import DatasetError
from torchrl_aca.offline import DatasetWriter, OfflineDataset, reference_scores
from torchrl_aca.offline.registry import ROOT
from torchrl_aca.training.config import Count, Section, Seed
from torchrl_aca.training.envs import make_env, task_name
from torchrl_aca.training.report import plot_returns, versions
from torchrl_aca.training.resume import read_evaluations

Tier = Literal["random", "medium", "medium_replay"]
Statistic = Literal["mean", "std", "min", "max"]
Band = Annotated[list[float | None], Field(min_length=2, max_length=2)]


class Task(Section):
    """The section `env` of `make_dataset.yaml`: the task as Gymnasium makes it."""

    name: str = Field(min_length=1)


class SACRun(Section):
    """The section `sac` of `make_dataset.yaml`."""

    run_dir: str | None
    seed: Seed
    overrides: list[str]


class GeneratorConfig(Section):
    """`make_dataset.yaml`."""

    tier: Tier
    env: Task
    path: str | None
    episodes: Count
    seed: Seed
    sac: SACRun
    check: bool
    bands: dict[str, dict[Tier, dict[Statistic, Band]]]


def make_dataset(cfg: GeneratorConfig) -> OfflineDataset:
    """Generates the data set that the configuration describes.

    Raises:
        DatasetError: If the directory exists already, or the returns lie outside their band.
        RunError: If the SAC run was stopped before its end.
    """
    env = make_env(cfg.env.name)
    task = task_name(cfg.env.name)
    path = Path(cfg.path or Path(ROOT) / f"{task}-{cfg.tier}")
    if path.exists():
        raise DatasetError(f"{path} exists already. Choose another path, or delete it first.")
    source = None
    if cfg.tier != "random":
        run_dir = Path(cfg.sac.run_dir or f"runs/{task}-sac")
        source = finished_sac_run(cfg.env.name, cfg.sac.seed, cfg.sac.overrides, run_dir)
    with DatasetWriter(
        path,
        env.observation_space.shape[0],
        env.action_space.shape[0],
        action_bounds=(env.action_space.low.tolist(), env.action_space.high.tolist()),
        allow_constant=("observation", "reward"),  # some tasks are like that, and the loop is ours
    ) as writer:
        for episode in episodes_of(cfg, env, source):
            writer.add_episode(**episode)
        name = f"{task} {cfg.tier} (D4RL-style, locally generated)"
        returns = writer.complete(writer.returns)
        if cfg.check:
            check_returns(cfg, returns)
        plot_returns(writer.staging / "returns.png", returns, name)
        return writer.finish(
            name=name,
            env_id=cfg.env.name,
            reference_scores=reference_scores(cfg.env.name),
            provenance=provenance(cfg, source),
        )


def episodes_of(cfg: GeneratorConfig, env: gym.Env, source: Path | None) -> Iterator[Episode]:
    """The episodes of a tier, one after the other; `source` is the SAC run."""
    if cfg.tier != "medium_replay" and env.spec.max_episode_steps is None:
        raise DatasetError(
            f"{cfg.env.name} has no time limit, so an episode might never end; expected one. "
            "Register the task with max_episode_steps."
        )
    if source is None:
        return rollouts(env, uniform_actions(env, cfg.seed), cfg.episodes, cfg.seed)
    if cfg.tier == "medium":
        return rollouts(env, sampled_actions(source, cfg.seed), cfg.episodes, cfg.seed)
    return replayed(source)


def check_returns(cfg: GeneratorConfig, returns: list[float]) -> None:
    """Raises `DatasetError` if a statistic of whole episodes' returns lies outside its band."""
    values = np.array(returns)
    bands = cfg.bands.get(cfg.env.name, {}).get(cfg.tier, {})
    if bands and not returns:
        raise DatasetError("no episode is complete, so the returns cannot be checked: check=false.")
    for name, (low, high) in bands.items():
        value = getattr(values, name)()
        if not (-np.inf if low is None else low) <= value <= (np.inf if high is None else high):
            raise DatasetError(
                f"the {name} of the {len(values)} returns is {value:.1f}; expected {low} to "
                f"{high}, as in bands.{cfg.env.name}.{cfg.tier}. Nothing was kept. With few "
                "episodes this can be chance: raise episodes, or take it as it is with check=false."
            )


def provenance(cfg: GeneratorConfig, source: Path | None) -> dict[str, Any]:
    """What the metadata say about where the data come from."""
    facts = {
        "command": " ".join(["python", *sys.argv]),
        "versions": versions(),
        "config": cfg.model_dump(),
    }
    if source is not None:
        facts["sac"] = {
            "config": OmegaConf.to_container(OmegaConf.load(source / "config.yaml")),
            "evaluations": read_evaluations(source),
        }
    return facts
