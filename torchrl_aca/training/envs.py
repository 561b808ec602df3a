"""Vectorised Gymnasium environments with a true final observation."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import DtypeObservation, FlattenObservation
from torchrl.envs import GymWrapper

from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Env, Wrapper
from torchrl_aca.training.env_state import ResumableEnv


def make_env(task: str | Env, *, max_steps: int | None = None, **kwargs: Any) -> gym.Env:
    """Builds one Gymnasium environment with a flat float32 observation.

    An observation of several parts (a `Dict`, a `Tuple`) becomes one vector of all of them, in the
    order of its space.

    Args:
        task: A Gymnasium id; "module:Id-v0" imports the module first. Or the section `env` of a
            configuration, with keywords and wrappers.
        max_steps: Length after which an episode is cut. Default: the task's own.
        **kwargs: More keywords for `gymnasium.make`.

    Raises:
        RunError: If the id, a keyword or a wrapper is unknown, or actions or observations are not a
            vector of numbers with finite action bounds.
    """
    task = Env(name=task) if isinstance(task, str) else task
    if max_steps is not None:
        kwargs["max_episode_steps"] = max_steps
    try:
        with _quiet_construction():
            env = gym.make(task.name, **{**(task.kwargs or {}), **kwargs})
    except (gym.error.Error, ImportError, TypeError) as error:
        raise RunError(
            f"env.name={task.name!r} cannot be made: {error}. Give the id of an installed "
            "Gymnasium environment, such as HalfCheetah-v4, or choose env=... from "
            f"recipes/configs/env; env.kwargs={task.kwargs} must be what it takes."
        ) from error
    for wrapper in task.wrappers:
        env = _wrap(env, wrapper)
    if not isinstance(env.observation_space, gym.spaces.Box):
        env = FlattenObservation(env)
    with _quiet_construction():
        env = DtypeObservation(env, np.float32)
    _check_spaces(task.name, env)
    return env


def _wrap(env: gym.Env, wrapper: Wrapper) -> gym.Env:
    """Puts a wrapper around an environment: one of Gymnasium's by its name, or "module:Class"."""
    module, _, name = wrapper.name.rpartition(":")
    try:
        kind = getattr(import_module(module or "gymnasium.wrappers"), name)
        return kind(env, **(wrapper.model_extra or {}))
    except Exception as error:  # wrappers are foreign code
        raise RunError(
            f"env.wrappers: {wrapper.name} cannot be put around {env}: "
            f"{type(error).__name__}: {error}. Give the name of a class of gymnasium.wrappers, or "
            "module:Class, and the keywords that it takes."
        ) from error


def task_name(env_id: str) -> str:
    """Returns an id without module and version, as in names of directories: "halfcheetah"."""
    return re.sub(r"-v\d+$", "", env_id.split(":")[-1]).replace("/", "-").lower()


def make_vector_env(
    task: str | Env, num_envs: int, seed: int, *, max_steps: int | None = None
) -> GymWrapper:
    """Builds `num_envs` parallel environments that step together in this process.

    They do not reset themselves: ("next", "observation") of a last step is the true final
    observation, and the collector starts the next episode.

    Args:
        task: See `make_env`.
        num_envs: Number of environments; the batch size of the result is (num_envs,).
        seed: They are seeded with seed, seed + 1, ...
        max_steps: See `make_env`.

    Raises:
        RunError: See `make_env`.
    """
    members = [lambda: ResumableEnv(make_env(task, max_steps=max_steps))] * num_envs
    env = GymWrapper(SyncVectorEnv(members, autoreset_mode=AutoresetMode.DISABLED))
    env.set_seed(seed)
    return env


def _check_spaces(name: str, env: gym.Env) -> None:
    actions, observations = env.action_space, env.observation_space
    if not isinstance(actions, gym.spaces.Box) or len(actions.shape) != 1:
        raise RunError(
            f"{name} has the action space {actions}; expected a one-dimensional Box. These "
            "algorithms need continuous actions: choose another environment."
        )
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise RunError(
            f"{name} has unbounded actions ({actions}); expected finite lower and upper bounds. "
            "Declare its true bounds, or wrap it in a class that does, with env.wrappers."
        )
    if not isinstance(observations, gym.spaces.Box) or len(observations.shape) != 1:
        raise RunError(
            f"{name} has the observation space {observations}; expected a one-dimensional Box, or "
            "parts of which one can be made. Flatten arrays of several dimensions with "
            "env.wrappers=[{name: FlattenObservation}]; for images write a recipe of your own."
        )


@contextmanager
def _quiet_construction() -> Iterator[None]:
    # The paper's tasks are the -v4 ones on purpose, their XML files predate MuJoCo 3, and the
    # networks take float32: none of these notices helps. Everything else is still shown.
    previous = getattr(mujoco, "get_mju_user_warning", lambda: None)()  # new in MuJoCo 4

    def show(message: str) -> None:
        if "settotalmass" not in message:
            warnings.warn(message, stacklevel=2)

    mujoco.set_mju_user_warning(show)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*is out of date.*")
            warnings.filterwarnings("ignore", message=".*precision lowered by casting.*")
            yield
    finally:
        mujoco.set_mju_user_warning(previous)
