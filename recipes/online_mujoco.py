"""Online training on MuJoCo: one loop for every algorithm.

    python recipes/online_mujoco.py env=hopper algo=aca seed=1
    python recipes/online_mujoco.py --config-name quickstart
    python recipes/online_mujoco.py resume=runs/<directory>

Every key of `configs/online_mujoco.yaml` can be overridden by name. Steps are counted in updates
and in environment frames: with five copies and one update per step of all of them, an update is
five frames.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import hydra
import torch
from agents import AGENTS
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import RandomPolicy

from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import Counters, restore
from torchrl_aca.training.config import resumed_config, validate
from torchrl_aca.training.data import BufferState, EpisodeTracker, make_replay_buffer, transitions
from torchrl_aca.training.envs import EnvState, make_vector_env
from torchrl_aca.training.errors import RunError
from torchrl_aca.training.evaluation import evaluate, record_video
from torchrl_aca.training.logging import MetricMeans, require_wandb_login
from torchrl_aca.training.randomness import RandomState, seed_everything
from torchrl_aca.training.run import Run


def train(cfg: DictConfig, checkpoint: dict[str, Any] | None = None) -> Path:
    """Trains one agent, from the start or from a checkpoint, and returns the run directory."""
    validate(cfg, AGENTS)
    require_wandb_login(cfg.logger)
    device = make_device(cfg)
    seed_everything(cfg.seed)

    env = make_vector_env(cfg.env.name, cfg.collector.num_envs, cfg.seed)
    eval_env = make_vector_env(cfg.env.name, cfg.eval.episodes, cfg.eval.seed)
    agent = make_agent(cfg, env, device)
    buffer = make_replay_buffer(cfg.buffer.capacity, cfg.optim.batch_size)
    episodes, means, counters = EpisodeTracker(cfg.collector.num_envs), MetricMeans(), Counters()
    parts = {
        **{f"agent.{name}": part for name, part in agent.state.items()},
        "buffer": BufferState(buffer),
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
        return evaluate(agent.policy, eval_env, cfg.eval.seed, device)

    with Run(cfg, parts, counters, checkpoint is not None, __file__) as run:
        if counters.frames == 0:
            run.log_evaluation(evaluation())
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


def make_agent(cfg: DictConfig, env: EnvBase, device: torch.device) -> Agent:
    """Builds the agent; a value that one of its parts refuses is told in one message."""
    try:
        return AGENTS[cfg.algo.name](cfg, env, device)
    except ValueError as error:
        raise RunError(f"algo={cfg.algo.name} cannot be built: {error}") from error


def updates_due(cfg: DictConfig, frames: int) -> int:
    """Returns how many updates belong to so many frames: exact, with no remainder to carry."""
    trained = max(0, frames - cfg.collector.init_random_frames)
    return int(trained * Fraction(str(cfg.optim.utd_ratio)))


def make_device(cfg: DictConfig) -> torch.device:
    """Sets threads and precision and returns the device; "auto" is CUDA where there is one."""
    if cfg.num_threads is not None:
        torch.set_num_threads(cfg.num_threads)
    torch.set_float32_matmul_precision(cfg.matmul_precision)
    name = cfg.device
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        message = str(error).splitlines()[0]
        raise RunError(f"device={name}: {message}. Use device=cpu or device=auto.") from error
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if cfg.cudagraphs and device.type != "cuda":
        raise RunError(
            f"cudagraphs=true: expected device=cuda, got {device}. Leave it out on a CPU; "
            "compile=true works there."
        )
    return device


def make_collector(
    cfg: DictConfig, env: EnvBase, agent: Agent, frames: int, device: torch.device
) -> Collector:
    """Collects in this process; random actions until `init_random_frames` frames in all."""
    return Collector(
        env,
        agent.policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        init_random_frames=max(0, cfg.collector.init_random_frames - frames),
        total_frames=-1,
        policy_device=device,
        env_device="cpu",
        storing_device="cpu",
        auto_register_policy_transforms=False,  # these policies are feed-forward
    )


def report_extras(
    cfg: DictConfig, run: Run, agent: Agent, eval_env: EnvBase, device: torch.device
) -> None:
    """Adds, where asked for, the return of a random policy and a video of the trained one."""
    if cfg.eval.random:
        policy = RandomPolicy(eval_env.action_spec)
        result = evaluate(policy, eval_env, cfg.eval.seed, torch.device("cpu"))
        run.bar.write(f"a random policy on the same seeds: {result['return_mean']:.1f}")
    if cfg.video.enabled:
        path = run.dir / "video.mp4"
        record_video(agent.policy, cfg.env.name, path, cfg.eval.seed, device)
        run.bar.write(f"video: {path}")


@hydra.main(version_base="1.3", config_path="configs", config_name="online_mujoco")
def main(cfg: DictConfig) -> None:
    """Starts or resumes a run; what the user can mend is told in one message."""
    try:
        if cfg.resume is None:
            train(cfg)
        else:
            train(*resumed_config(cfg, HydraConfig.get().overrides.task))
    except RunError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
