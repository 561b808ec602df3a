"""Evaluation over whole episodes, without a trace in the training's random streams."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, GymWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import RandomPolicy

from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Env, Eval, RunConfig
from torchrl_aca.training.envs import make_env, make_vector_env

Policy = Callable[[TensorDictBase], TensorDictBase]


@contextmanager
def evaluation_mode(seed: int) -> Iterator[None]:
    """No gradients, deterministic actions, and random numbers of its own that start at `seed`."""
    with (
        torch.random.fork_rng(),
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
    ):
        torch.manual_seed(seed)
        yield


def make_eval_env(task: str | Env, settings: Eval) -> GymWrapper:
    """Builds the environments of the evaluation, one for each episode; `task` as in `make_env`.

    Raises:
        RunError: If episodes might never end, or see `make_env`.
    """
    env = make_vector_env(task, settings.episodes, settings.seed, max_steps=settings.max_steps)
    if env.envs[0].time_limit is None:
        raise RunError(
            f"{env.envs[0].spec.id} has no time limit, so an evaluation of it might never end; "
            "expected one. Give the length after which the evaluation cuts an episode, as in "
            "eval.max_steps=1000."
        )
    return env


def evaluate(
    policy: Policy,
    env: EnvBase,
    seed: int,
    device: torch.device,
    watch: Callable[[int], None] | None = None,
) -> dict[str, float]:
    """Runs exactly one whole episode in each of the parallel environments.

    They are seeded anew, so the result depends on the policy and the seed alone. One that has
    finished goes on until the last one has, but what it earns then is not counted: stopping at the
    first end instead would cut the episodes of the others short.

    Args:
        policy: Maps a TensorDict with "observation" to one with "action".
        env: Environment of batch size (num_episodes,); never the one that is trained on.
        seed: First seed of the environments, and the one of the policy's draws.
        device: Device of the policy.
        watch: Is told after each step how many have been made.

    Returns:
        `return_mean`, `return_std` (over episodes, not corrected for the sample), `num_episodes`
        and `episode_length` (mean).
    """
    returns = torch.zeros(env.batch_size, dtype=torch.float64)
    lengths = torch.zeros(env.batch_size, dtype=torch.int64)
    alive = torch.ones(env.batch_size, dtype=torch.bool)
    with evaluation_mode(seed):
        env.set_seed(seed)
        data = env.reset()
        while alive.any():
            data = policy(data.to(device)).to(env.device or "cpu")
            data, following = env.step_and_maybe_reset(data)
            returns += data["next", "reward"].squeeze(-1).cpu() * alive
            lengths += alive
            alive &= ~data["next", "done"].squeeze(-1).cpu()
            data = following
            if watch is not None:
                watch(int(lengths.max()))
    return {
        "return_mean": returns.mean().item(),
        "return_std": returns.std(correction=0).item(),
        "num_episodes": float(returns.numel()),
        "episode_length": lengths.double().mean().item(),
    }


def record_video(
    policy: Policy,
    task: str | Env,
    path: Path,
    seed: int,
    device: torch.device,
    *,
    max_steps: int | None = None,
) -> None:
    """Renders one whole episode of the deterministic policy to an MP4 file.

    Args:
        policy: See `evaluate`.
        task: See `make_env`.
        path: The file.
        seed: Of the environment and the policy's draws.
        device: Device of the policy.
        max_steps: See `make_env`.

    Raises:
        RunError: If this machine cannot render.
    """
    # Has no effect where a screen is set up or the variable is given; must precede the rendering.
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import imageio

        env = make_env(task, max_steps=max_steps, render_mode="rgb_array")
        observation, _ = env.reset(seed=seed)
        images, done = [env.render()], False
        with evaluation_mode(seed):
            while not done:
                data = TensorDict({"observation": torch.from_numpy(observation)}).to(device)
                action = policy(data)["action"].cpu().numpy()
                observation, _, terminated, truncated, _ = env.step(action)
                images.append(env.render())
                done = terminated or truncated
        imageio.mimwrite(path, images, fps=env.metadata.get("render_fps", 30), macro_block_size=1)
        env.close()
    except Exception as error:  # every renderer and encoder has exceptions of its own
        raise RunError(
            f"the video could not be rendered with MUJOCO_GL={os.environ.get('MUJOCO_GL')!r}: "
            f"{error}. Try MUJOCO_GL=egl (needs libEGL) or MUJOCO_GL=osmesa (needs libOSMesa), and "
            "pip install 'imageio[ffmpeg]'. The trained agent is safe in the checkpoints: "
            "film it later with python recipes/evaluate.py run=RUN_DIR video=true."
        ) from error


def report_extras(
    cfg: RunConfig, run_dir: Path, policy: Policy, env: EnvBase, device: torch.device
) -> None:
    """Adds, where asked for, the return of a random policy and a video of the trained one."""
    if cfg.eval.random:
        result = evaluate(RandomPolicy(env.action_spec), env, cfg.eval.seed, torch.device("cpu"))
        print(f"a random policy on the same seeds: {result['return_mean']:.1f}")
    if cfg.video.enabled:
        path = run_dir / "video.mp4"
        record_video(policy, cfg.env, path, cfg.eval.seed, device, max_steps=cfg.eval.max_steps)
        print(f"video: {path}")
