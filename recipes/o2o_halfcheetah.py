"""Online learning with offline data on MuJoCo: section 4.2 of the ACA paper.

    python recipes/o2o_halfcheetah.py dataset=datasets/halfcheetah-medium_replay algo=aca seed=1
    python recipes/o2o_halfcheetah.py dataset=datasets/halfcheetah-medium_replay algo=rlpd utd=20
    python recipes/o2o_halfcheetah.py --config-name o2o_quickstart
    python recipes/o2o_halfcheetah.py resume=runs/<directory>

The agent learns from scratch, online, and each of its minibatches is partly from a fixed data set.
A run has up to three phases: an offline one, which ACA and RLPD do not have, a warm-up of random
actions without updates, and an online one. Every key is in `configs/o2o_halfcheetah.yaml`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from agents import AGENTS
from hydra.core.hydra_config import HydraConfig
from offline_data import (
    generate_missing,
    load_offline_data,
    make_mixture,
    offline_facts,
    task_scores,
)
from omegaconf import DictConfig, OmegaConf
from online_mujoco import make_agent, make_collector, make_device, report_extras, updates_due

from torchrl_aca.offline import DatasetError
from torchrl_aca.offline.scores import normalized_score
from torchrl_aca.training.checkpoint import Counters, restore
from torchrl_aca.training.config import is_count, is_number, require, resumed_config, validate
from torchrl_aca.training.data import EpisodeTracker, transitions
from torchrl_aca.training.envs import EnvState, make_vector_env
from torchrl_aca.training.errors import RunError
from torchrl_aca.training.evaluation import evaluate
from torchrl_aca.training.logging import MetricMeans, require_wandb_login
from torchrl_aca.training.randomness import RandomState, seed_everything
from torchrl_aca.training.run import Run


def train(cfg: DictConfig, checkpoint: dict[str, Any] | None = None) -> Path:
    """Trains one agent, from the start or from a checkpoint, and returns the run directory."""
    complete(cfg)
    validate(cfg, AGENTS)
    require_wandb_login(cfg.logger)
    generate_missing(cfg)
    device = make_device(cfg)
    seed_everything(cfg.seed)

    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, cfg.seed)
    eval_env = make_vector_env(cfg.env.name, cfg.eval.episodes, cfg.eval.seed)
    agent = make_agent(cfg, env, device)
    dataset = load_offline_data(cfg, env)
    scores = task_scores(cfg)
    buffer = make_mixture(cfg, dataset)
    episodes, means, counters = EpisodeTracker(cfg.collector.num_envs), MetricMeans(), Counters()
    parts = {
        **{f"agent.{name}": part for name, part in agent.state.items()},
        "buffer": buffer,
        "episodes": episodes,
        "means": means,
        "counters": counters,
        "env": EnvState(env),
        "random": RandomState(),
    }
    if checkpoint:
        restore(parts, checkpoint["parts"], optional=("env", "episodes"))
    collector = make_collector(cfg, env, agent, counters.frames, device)
    if checkpoint:  # once more, because building the collector draws random numbers
        restore({"random": parts["random"]}, checkpoint["parts"])

    def metrics() -> dict[str, float]:
        return {**episodes.metrics(), **means.pop()}

    def evaluation() -> dict[str, float]:
        result = evaluate(agent.policy, eval_env, cfg.eval.seed, device)
        if scores:
            result["normalized_score"] = normalized_score(result["return_mean"], scores)
        return result

    facts = {**offline_facts(dataset, buffer), "updates per online frame": cfg.optim.utd_ratio}
    with Run(cfg, parts, counters, checkpoint is not None, __file__, facts) as run:
        if counters.frames == 0:
            run.log_evaluation(evaluation())
        # Offline phase: a method that has one makes its updates here, on the data set alone.
        # Warm-up and online phase: random actions first, without updates.
        for data in collector:  # data has the shape (num_envs, steps)
            run.check(data)
            counters.frames += data.numel()
            episodes.add(data)
            buffer.extend(transitions(data))

            start = counters.updates
            while counters.updates < updates_due(cfg, counters.frames):
                means.add(agent.update(buffer.sample().to(device)))
                counters.updates += 1
            collector.update_policy_weights_()

            last = run.end_iteration(start, metrics, evaluation)
            if last or run.stopping:
                break
        run.finish(completed=last)
        if last:
            report_extras(cfg, run, agent, eval_env, device)
    collector.shutdown()
    return run.dir


def complete(cfg: DictConfig) -> None:
    """Checks the keys that are this recipe's own, and sets the number of updates.

    Raises:
        RunError: Naming the key, what was expected and what was got.
    """
    fraction = cfg.offline_fraction
    fits = is_number(fraction) and 0 <= fraction <= 1
    require(fits, cfg, "offline_fraction", "a share from 0 to 1")
    fits = cfg.dataset is None or isinstance(cfg.dataset, str)
    require(fits, cfg, "dataset", "the directory of a data set, aca:NAME, or null")
    for key in ("online_frames", "collector.init_random_frames"):
        require(is_count(OmegaConf.select(cfg, key)), cfg, key, "a positive integer")
    for key in ("utd", "optim.utd_ratio"):
        value = OmegaConf.select(cfg, key)
        require(is_number(value) and value > 0, cfg, key, "a number above 0")
    if cfg.optim.total_updates is None:
        warmup = cfg.collector.init_random_frames
        cfg.optim.total_updates = updates_due(cfg, warmup + cfg.online_frames)


@hydra.main(version_base="1.3", config_path="configs", config_name="o2o_halfcheetah")
def main(cfg: DictConfig) -> None:
    """Starts or resumes a run; what the user can mend is told in one message."""
    try:
        if cfg.resume is None:
            train(cfg)
        else:
            train(*resumed_config(cfg, HydraConfig.get().overrides.task))
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
