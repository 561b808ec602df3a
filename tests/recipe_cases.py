"""Recipes, run as users run them, and what their run directories hold."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from tensordict import TensorDict

from torchrl_aca.training.checkpoint import list_checkpoints

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"
CONFIGS = RECIPES / "configs"

# A run of seconds, for every entry of AGENTS: sizes that show whatever a checkpoint could miss.
TINY_RUN = [
    "env=hopper",
    "num_threads=1",
    "collector.warmup_frames=200",
    "buffer.capacity=300",
    "optim.batch_size=16",
    "optim.total_updates=60",
    "eval.interval=30",
    "eval.episodes=2",
    "checkpoint.interval=25",
    "logger.interval=10",
]
CQL_SIZES = ["cql.num_cells=[16,16]", "cql.num_qvalue_nets=3", "cql.num_actions=2"]
TINY_SIZES = {
    "aca": [
        "aca.num_cells=[16,16]",
        "aca.num_steps=3",
        "aca.num_candidates=3",
        "aca.num_target_candidates=2",
        "aca.alpha_interval=20",
    ],
    "dacer": [
        "dacer.num_cells=[16,16]",
        "dacer.num_steps=3",
        "dacer.num_entropy_samples=10",
        "dacer.alpha_interval=20",
    ],
    "dipo": ["dipo.num_cells=[16,16]", "dipo.num_steps=4", "dipo.num_gradient_steps=5"],
    "nclql": ["nclql.num_cells=[16,16]", "nclql.num_steps=3"],
    "qsm": [
        "qsm.num_cells=[16,16]",
        "qsm.num_steps=3",
        "qsm.num_candidates=3",
        "qsm.num_target_candidates=2",
    ],
    "qvpo": [
        "qvpo.num_cells=[16,16]",
        "qvpo.num_steps=3",
        "qvpo.num_candidates=3",
        "qvpo.num_target_candidates=2",
    ],
    "rlpd": [
        "rlpd.num_cells=[16,16]",
        "rlpd.num_qvalue_nets=3",
        "rlpd.actor_interval=7",  # so that the run stops between two steps of the actor
        "optim.utd_ratio=0.4",
    ],
    "sac": ["sac.num_cells=[16,16]"],
    "sdac": [
        "sdac.num_cells=[16,16]",
        "sdac.num_steps=3",
        "sdac.num_candidates=3",
        "sdac.num_target_candidates=2",
        "sdac.num_proposals=4",
        "sdac.alpha_interval=20",
    ],
    "cql": [*CQL_SIZES, "cql.gap_threshold=5", "optim.utd_ratio=0.2"],
    "calql": [*CQL_SIZES, "calql.tail=mask", "calql.horizon=5", "optim.utd_ratio=0.2"],
    "wsrl": [*CQL_SIZES, "wsrl.actor_interval=7", "optim.utd_ratio=0.4"],
    "iql": ["iql.num_cells=[16,16]", "iql.num_qvalue_nets=3", "optim.utd_ratio=0.2"],
}
TINY = {algo: [f"algo={algo}", *TINY_RUN, *sizes] for algo, sizes in TINY_SIZES.items()}


def start(*arguments: str, cwd: Path, recipe: str = "online_mujoco") -> subprocess.Popen:
    """A recipe's command, running."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, str(RECIPES / f"{recipe}.py"), *arguments],
        cwd=cwd,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def run(*arguments: str, cwd: Path, recipe: str = "online_mujoco") -> tuple[int, str, str]:
    """A recipe's command, run to its end: exit status, output, errors."""
    process = start(*arguments, cwd=cwd, recipe=recipe)
    output, errors = process.communicate(timeout=120)
    return process.returncode, output, errors


def composed(*overrides: str, name: str = "online_mujoco") -> DictConfig:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return compose(name, overrides=list(overrides))


def rows_of(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def without_time(path: Path) -> list[dict[str, str]]:
    return [{k: v for k, v in row.items() if "second" not in k} for row in rows_of(path)]


def leaves(value, path=""):
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{path}/{key}")
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from leaves(inner, f"{path}/{index}")
    else:
        yield path, value


def checkpoint_leaves(run_dir: Path) -> dict[str, object]:
    content = torch.load(list_checkpoints(run_dir / "checkpoints")[-1], weights_only=True)
    return dict(leaves(content["parts"]))


def assert_same_state(first: Path, second: Path) -> None:
    one, two = checkpoint_leaves(first), checkpoint_leaves(second)
    assert one.keys() == two.keys()
    for key in one.keys() - {"/counters/seconds"}:
        if isinstance(one[key], torch.Tensor):
            assert torch.equal(one[key], two[key]), key
        else:
            assert one[key] == two[key], key


def collected(num_envs: int = 5, steps: int = 1, observation_dim: int = 17, action_dim: int = 6):
    shape = (num_envs, steps)
    observation = torch.randn(*shape, observation_dim)
    flag = torch.zeros(*shape, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": observation,
            "action": torch.rand(*shape, action_dim),
            "loc": torch.zeros(*shape, action_dim),
            "done": flag,
            "next": {
                "observation": observation + 1,
                "reward": torch.randn(*shape, 1),
                "done": flag.clone(),
                "terminated": flag.clone(),
                "truncated": flag.clone(),
            },
        },
        batch_size=shape,
    )


def batch_of(seed: int, size: int = 64) -> TensorDict:
    """A bandit: any state, an episode of one step, and the best action is 1.5 of [-3, 3]."""
    generator = torch.Generator().manual_seed(seed)
    action = 6 * torch.rand(size, 1, generator=generator) - 3
    ended = torch.ones(size, 1, dtype=torch.bool)
    following = {
        "observation": torch.randn(size, 4, generator=generator),
        "reward": -((action - 1.5) ** 2),
        "done": ended,
        "terminated": ended,
    }
    observation = torch.randn(size, 4, generator=generator)
    rows = {"observation": observation, "action": action, "next": following}
    return TensorDict(rows, batch_size=[size])
