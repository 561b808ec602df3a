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
from omegaconf import DictConfig
from online_mujoco import make_agent, make_collector, make_device, report_extras, updates_due
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.data.datasets import load_dataset
from torchrl.envs import EnvBase

from torchrl_aca.offline import DatasetError, MixedReplayBuffer, OfflineDataset, reference_scores
from torchrl_aca.offline.scores import normalized_score
from torchrl_aca.training.checkpoint import Counters, restore
from torchrl_aca.training.config import resumed_config, validate
from torchrl_aca.training.data import (
    TRANSITION_KEYS,
    EpisodeTracker,
    make_replay_buffer,
    transitions,
)
from torchrl_aca.training.envs import EnvState, make_vector_env
from torchrl_aca.training.errors import RunError
from torchrl_aca.training.evaluation import evaluate
from torchrl_aca.training.logging import MetricMeans, require_wandb_login
from torchrl_aca.training.randomness import RandomState, seed_everything
from torchrl_aca.training.run import Run


def train(cfg: DictConfig, checkpoint: dict[str, Any] | None = None) -> Path:
    """Trains one agent, from the start or from a checkpoint, and returns the run directory."""
    if cfg.optim.total_updates is None:
        cfg.optim.total_updates = int(cfg.utd * cfg.online_frames)
    validate(cfg, AGENTS)
    require_wandb_login(cfg.logger)
    device = make_device(cfg)
    seed_everything(cfg.seed)

    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, cfg.seed)
    eval_env = make_vector_env(cfg.env.name, cfg.eval.episodes, cfg.eval.seed)
    agent = make_agent(cfg, env, device)
    offline = load_offline_data(cfg, env)
    buffer = make_mixture(cfg, offline)
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
        scores = reference_scores(cfg.env.name)
        if scores:
            result["normalized_score"] = normalized_score(result["return_mean"], scores)
        return result

    facts = {"offline data": f"{cfg.dataset}, {cfg.offline_fraction} of a batch", "UTD": cfg.utd}
    with Run(cfg, parts, counters, resumed=checkpoint is not None, facts=facts) as run:
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


def load_offline_data(cfg: DictConfig, env: EnvBase) -> TensorDictBase | ReplayBuffer | None:
    """The data set, or None where no minibatch has a part of it.

    Raises:
        RunError: If there is none, or it was made in an environment of other sizes.
    """
    if not cfg.offline_fraction:
        return None
    if cfg.dataset is None:
        raise RunError(
            "dataset=null: expected the directory of a data set, or an id such as aca:NAME. Make "
            "one with recipes/make_dataset.py, or learn without: offline_fraction=0."
        )
    if ":" in cfg.dataset:
        return load_dataset(cfg.dataset, batch_size=cfg.optim.batch_size)
    dataset = OfflineDataset.load(cfg.dataset)
    for name, spec in (
        ("observation", env.observation_spec["observation"]),
        ("action", env.action_spec),
    ):
        got, expected = dataset.metadata[f"{name}_dim"], spec.shape[-1]
        if got != expected:
            raise RunError(
                f"dataset={cfg.dataset} has {name}s of length {got}; expected {expected}, as in "
                f"{cfg.env.name}. It is of {dataset.metadata['env_id']}: choose that env."
            )
    return dataset.data


def make_mixture(
    cfg: DictConfig, offline: TensorDictBase | ReplayBuffer | None
) -> MixedReplayBuffer:
    """The buffer that minibatches are drawn from. The loss scales the rewards of both halves."""
    try:
        return MixedReplayBuffer(
            offline,
            make_replay_buffer(cfg.buffer.capacity, cfg.optim.batch_size),
            offline_fraction=cfg.offline_fraction,
            batch_size=cfg.optim.batch_size,
            keys=TRANSITION_KEYS,
            seed=cfg.seed,
        )
    except ValueError as error:
        raise RunError(f"dataset={cfg.dataset} cannot be mixed in: {error}") from error


@hydra.main(version_base="1.3", config_path="configs", config_name="o2o_halfcheetah")
def main(cfg: DictConfig) -> None:
    """Starts or resumes a run; what the user can mend is told in one message."""
    try:
        if cfg.resume is not None:
            train(*resumed_config(cfg, HydraConfig.get().overrides.task))
            return
        train(cfg)
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
