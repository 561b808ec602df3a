"""A tiny data set and tiny runs of the recipe with offline data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

import o2o_halfcheetah
from recipe_cases import CONFIGS
from torchrl_aca.offline import DatasetWriter
from torchrl_aca.training.launch import start

SIZES = {"observation_dim": 11, "action_dim": 3}  # Hopper's
MARK = 1000.0  # below every offline reward, above every online one
TINY = [
    "env=hopper",
    "num_threads=1",
    "online_frames=60",
    "collector.warmup_frames=50",
    "buffer.capacity=300",
    "optim.batch_size=16",
    "eval.interval=30",
    "eval.episodes=2",
    "checkpoint.interval=25",
    "logger.interval=10",
]
ALGORITHMS = {
    "aca": [
        "algo=aca",
        "aca.num_cells=[16,16]",
        "aca.num_steps=3",
        "aca.num_candidates=3",
        "aca.num_target_candidates=2",
        "aca.alpha_interval=20",
    ],
    "rlpd": ["algo=rlpd", "rlpd.num_cells=[16,16]", "rlpd.num_qvalue_nets=3"],
    "rlpd_wsrl": [
        "algo=rlpd_wsrl",
        "utd=1",
        "rlpd.num_cells=[16,16]",
        "rlpd.num_qvalue_nets=3",
    ],
}
OFFLINE = 20  # updates of the offline phase
CQL = ["cql.num_cells=[16,16]", "cql.num_qvalue_nets=3", "cql.num_actions=2"]
WITH_OFFLINE_PHASE = {
    "cql": ["algo=cql", *CQL, "cql.gap_threshold=3"],
    "calql": ["algo=calql", *CQL],
    "wsrl": ["algo=wsrl", *CQL, "utd=1", "wsrl.actor_interval=4"],
    "iql": ["algo=iql", "iql.num_cells=[16,16]", "iql.num_qvalue_nets=3"],
}
ALGORITHMS |= {
    algo: [*sizes, f"offline_updates={OFFLINE}"] for algo, sizes in WITH_OFFLINE_PHASE.items()
}


def record(
    path: Path,
    env_id="Hopper-v4",
    sizes=SIZES,
    bound=1.0,
    seed=0,
    reference_scores=None,
    complete=True,
) -> Path:
    """Three episodes of noise with rewards that no online transition has."""
    random = np.random.default_rng(seed)
    with DatasetWriter(path, **sizes, action_bounds=(-bound, bound)) as writer:
        for _ in range(3):
            states = random.normal(size=(41, sizes["observation_dim"]))
            writer.add_episode(
                states[:-1],
                random.uniform(-bound, bound, (40, sizes["action_dim"])),
                states[1:],
                MARK + random.uniform(1, 2, 40),
                np.zeros(40, bool),
                np.arange(40) == 39,
                complete=complete,
            )
        writer.finish(name="noise", env_id=env_id, reference_scores=reference_scores)
    return path


def run_o2o(*overrides: str, name: str = "o2o_halfcheetah") -> Path:
    """The recipe without a process of its own: takes overrides, as the command does."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return start(o2o_halfcheetah.train, compose(name, list(overrides)), overrides)


def settings(data: Path, run_dir: Path, algo: str = "aca") -> list[str]:
    return [*ALGORITHMS[algo], *TINY, f"dataset={data}", f"run_dir={run_dir}"]
