"""Online training on MuJoCo: one loop for every algorithm.

    python recipes/online_mujoco.py env=hopper algo=aca seed=1
    python recipes/online_mujoco.py --config-name quickstart
    python recipes/online_mujoco.py --multirun env=hopper,walker2d seed=0,1
    python recipes/online_mujoco.py resume=runs/<directory>

Every key of `configs/online_mujoco.yaml` can be overridden by name. Steps are counted in updates
and in environment frames: with five parallel environments and one update per step of all of them,
an update is five frames.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

import renderer  # noqa: F401
import resolvers  # noqa: F401
from agents import configured, make_agent
from agents.pretrained import refuse_offline_phase
from torchrl_aca.replay import make_replay_buffer
from torchrl_aca.training.acceleration import capture
from torchrl_aca.training.envs import make_vector_env
from torchrl_aca.training.evaluation import evaluate, make_eval_env, report_extras
from torchrl_aca.training.launch import launch, make_device
from torchrl_aca.training.logging import require_wandb_login
from torchrl_aca.training.randomness import seed_everything
from torchrl_aca.training.run import Run
from torchrl_aca.training.workers import make_collection


def train(cfg: DictConfig, checkpoint: dict[str, Any] | None = None) -> Path:
    """Trains one agent, from the start or from a checkpoint, and returns the run directory."""
    cfg = configured(cfg)
    refuse_offline_phase(cfg)
    require_wandb_login(cfg.logger)
    device = make_device(cfg)
    seed_everything(cfg.seed)

    env = make_vector_env(cfg.env, cfg.collector.num_envs, cfg.seed)
    eval_env = make_eval_env(cfg.env, cfg.eval)
    agent = make_agent(cfg, env, device)
    buffer = make_replay_buffer(cfg.buffer.capacity, cfg.optim.batch_size)
    collection = make_collection(cfg, env, agent.policy, device)
    evaluated = capture(agent.policy, cfg.cudagraphs)
    evaluation = partial(evaluate, evaluated, eval_env, cfg.eval.seed, device)

    with Run(
        cfg, agent, buffer, collection, evaluation, checkpoint, device=device, script=__file__
    ) as run:
        for data in collection:  # of shape (num_envs, steps)
            if len(rows := agent.rows_of(data)):
                buffer.extend(rows)
            for batch in run.due(buffer):
                run.add(agent.update(batch))
            if run.end_iteration():
                break
    if run.completed:
        report_extras(cfg, run.dir, agent.policy, eval_env, device)
    return run.dir


@hydra.main(version_base="1.3", config_path="configs", config_name="online_mujoco")
def main(cfg: DictConfig) -> None:
    launch(train, cfg)


if __name__ == "__main__":
    main()
