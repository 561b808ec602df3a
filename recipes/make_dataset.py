"""Generates an offline data set in the manner of D4RL: "D4RL-style, locally generated".

    python recipes/make_dataset.py tier=random env=halfcheetah
    python recipes/make_dataset.py tier=medium_replay env=halfcheetah

`random` has uniform actions. `medium_replay` is every transition of a SAC run
(`configs/dataset_sac.yaml`) that stops when its evaluations reach a return, and `medium` is
episodes of that run's final policy, actions sampled. Every key is in `configs/make_dataset.yaml`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import hydra
import numpy as np
from dataset_episodes import (
    Episode,
    evaluations,
    finished_sac_run,
    replayed,
    rollouts,
    sampled_actions,
    uniform_actions,
)
from import_dataset import summary
from omegaconf import DictConfig, OmegaConf

from torchrl_aca.errors import RunError
from torchrl_aca.offline import DatasetError, DatasetWriter, OfflineDataset, reference_scores
from torchrl_aca.offline.registry import ROOT
from torchrl_aca.training.config import is_count, require
from torchrl_aca.training.envs import make_env
from torchrl_aca.training.report import plot_returns, versions

TIERS = ("random", "medium", "medium_replay")


def make_dataset(cfg: DictConfig) -> OfflineDataset:
    """Generates the data set that the configuration describes.

    Raises:
        DatasetError: If the directory exists already, or the returns lie outside their band.
        RunError: If a key is wrong, or the SAC run was stopped before its end.
    """
    validate(cfg)
    env = make_env(cfg.env.name)
    task = task_name(cfg.env.name)
    path = Path(cfg.path or Path(ROOT) / f"{task}-{cfg.tier}")
    if path.exists():
        raise DatasetError(f"{path} exists already. Choose another path, or delete it first.")
    source = None
    if cfg.tier != "random":
        source = finished_sac_run(cfg, Path(cfg.sac.run_dir or f"runs/{task}-sac"))
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


def task_name(env_id: str) -> str:
    """An environment's name without module and version, as in directories: "halfcheetah"."""
    return re.sub(r"-v\d+$", "", env_id.split(":")[-1]).lower()


def validate(cfg: DictConfig) -> None:
    """Checks the keys before any work."""
    tier = None if OmegaConf.is_missing(cfg, "tier") else cfg.tier
    if tier not in TIERS:
        raise RunError(f"tier={tier}: expected one of {list(TIERS)}. Set it with tier=... .")
    for key, least in (("episodes", 1), ("seed", 0), ("sac.seed", 0)):
        value = OmegaConf.select(cfg, key)
        require(is_count(value, least), cfg, key, f"an integer of at least {least}")


def episodes_of(cfg: DictConfig, env: gym.Env, source: Path | None) -> Iterator[Episode]:
    """The episodes of a tier, one after the other; `source` is the SAC run."""
    if source is None:
        return rollouts(env, uniform_actions(env, cfg.seed), cfg.episodes, cfg.seed)
    if cfg.tier == "medium":
        return rollouts(env, sampled_actions(source, cfg.seed), cfg.episodes, cfg.seed)
    return replayed(source)


def check_returns(cfg: DictConfig, returns: list[float]) -> None:
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
        print(summary(make_dataset(cfg)))
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit(
            "stopped: no data set was made. The same command makes it; a SAC run goes on from its "
            "newest checkpoint."
        ) from None


if __name__ == "__main__":
    main()
