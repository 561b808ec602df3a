"""Parameters of every method, beside the table of ACA's paper, and of what that table leaves out.

    python recipes/parameters.py
    python recipes/parameters.py halfcheetah

The table counts what is trained, temperatures left out. Beside it stands what is held in all, with
target critics and moving averages of policies.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

import renderer  # noqa: F401
from agents import AGENTS, configured, make_agent
from torchrl_aca.training.envs import make_vector_env

CONFIGS = Path(__file__).resolve().parent / "configs"
PAPER = {
    "sac": 1.000,
    "qsm": 1.000,
    "dipo": 1.012,
    "dacer": 1.008,
    "qvpo": 1.007,
    "sdac": 1.007,
    "aca": 0.677,
}


def compose(*overrides: str) -> DictConfig:
    """The configuration of `recipes/online_mujoco.py`."""
    with hydra.initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return hydra.compose("online_mujoco", list(overrides))


def count(algo: str, env_name: str, env: EnvBase) -> tuple[int, int]:
    """Parameters of a method that are trained, and those with their targets and averages."""
    cfg = configured(compose(f"algo={algo}", f"env={env_name}"))
    agent = make_agent(cfg, env, torch.device("cpu"))
    buffers = agent.state["loss"].named_buffers()
    targets = [b for name, b in buffers if name.startswith("target_") and b.ndim]
    return agent.num_parameters, agent.num_parameters + sum(b.numel() for b in targets)


def table(env_name: str) -> str:
    """A row for each method: counts, their ratios to SAC's, and the paper's ratio."""
    env = make_vector_env(configured(compose(f"env={env_name}")).env.name, 1, 0)
    counts = {algo: count(algo, env_name, env) for algo in AGENTS}
    env.close()
    lines = [
        "| method | parameters | ratio | paper | with targets | ratio |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for algo in sorted(AGENTS, key=lambda name: counts[name]):
        (trained, held), (of_sac, held_of_sac) = counts[algo], counts["sac"]
        paper = f"{PAPER[algo]:.3f}" if algo in PAPER else ""
        ratios = f"{trained / of_sac:.3f} | {paper} | {held:,} | {held / held_of_sac:.3f}"
        lines.append(f"| {algo} | {trained:,} | {ratios} |")
    return "\n".join(lines)


def main() -> None:
    """Prints the table of a task."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    tasks = sorted(path.stem for path in (CONFIGS / "env").glob("*.yaml"))
    parser.add_argument("task", nargs="?", default="humanoid", choices=tasks)
    print(table(parser.parse_args().task))


if __name__ == "__main__":
    main()
