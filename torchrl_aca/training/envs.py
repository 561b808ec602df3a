"""Vectorised Gymnasium environments with a true final observation and an exact, savable state."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import DtypeObservation, TimeLimit
from torchrl.envs import GymWrapper

from torchrl_aca.errors import RunError

_INTEGRATION_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class ResumableEnv(gym.Wrapper):
    """Saves and restores an environment in the middle of an episode.

    After `load_state_dict`, `reset` returns the restored observation until the first step is made,
    so a collector that resets its environments when it starts goes on with the saved episode.

    The state is exact for MuJoCo environments. Other environments keep their random stream but
    begin a new episode, because Gymnasium has no general way to save them.
    """

    def __init__(self, env: gym.Env) -> None:
        """Wraps `env`, which must already have its time limit."""
        super().__init__(env)
        self._observation = np.empty(0)
        self._resumed = False

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode, or returns to the restored one that has not made a step yet."""
        if self._resumed:
            return self._observation, {}
        self._observation, info = self.env.reset(**kwargs)
        return self._observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Makes one step and remembers the observation for `state_dict`."""
        self._resumed = False
        result = self.env.step(action)
        self._observation = result[0]
        return result

    def state_dict(self) -> dict[str, Any]:
        """Returns random stream, elapsed steps, last observation and the simulator's arrays."""
        state: dict[str, Any] = {"random": self.unwrapped.np_random.bit_generator.state}
        if isinstance(getattr(self.unwrapped, "data", None), mujoco.MjData):
            state["elapsed_steps"] = self.time_limit._elapsed_steps if self.time_limit else None
            state["observation"] = torch.from_numpy(np.array(self._observation))
            state["simulation"] = _simulation_state(self.unwrapped.model, self.unwrapped.data)
        return state

    def load_state_dict(self, state_dict: dict[str, Any], *, in_episode: bool = True) -> None:
        """Restores what `state_dict` returned into an environment of the same kind.

        Args:
            state_dict: The state.
            in_episode: Whether the next `reset` goes on with the state's episode.
        """
        self._resumed = False
        self.reset()  # satisfies the wrappers that forbid a step before a reset
        self.unwrapped.np_random.bit_generator.state = state_dict["random"]
        if "simulation" not in state_dict:
            self.reset()
            return
        if self.time_limit:
            self.time_limit._elapsed_steps = state_dict["elapsed_steps"]
        self._observation = state_dict["observation"].numpy()
        _load_simulation_state(self.unwrapped.model, self.unwrapped.data, state_dict["simulation"])
        self._resumed = in_episode

    @property
    def time_limit(self) -> TimeLimit | None:
        """The wrapper that ends episodes, if there is one."""
        env = self.env
        while isinstance(env, gym.Wrapper):
            if isinstance(env, TimeLimit):
                return env
            env = env.env
        return None


def _simulation_state(model: Any, data: Any) -> dict[str, torch.Tensor]:
    integration = np.empty(mujoco.mj_stateSize(model, _INTEGRATION_STATE))
    mujoco.mj_getState(model, data, integration, _INTEGRATION_STATE)
    # The next step follows from the integration state alone, but rewards and observations also
    # read derived arrays (body positions, contact forces) that MuJoCo leaves half a step behind.
    # What has a size in fresh data is what does not depend on the contacts of the moment.
    fresh = mujoco.MjData(model)
    names = [
        name
        for name in dir(fresh)
        if not name.startswith("_")
        and isinstance(value := getattr(fresh, name), np.ndarray)
        and value.size
    ]
    arrays = {name: torch.from_numpy(np.array(getattr(data, name))) for name in names}
    return {"integration": torch.from_numpy(integration), **arrays}


def _load_simulation_state(model: Any, data: Any, state: dict[str, torch.Tensor]) -> None:
    mujoco.mj_setState(model, data, state["integration"].numpy(), _INTEGRATION_STATE)
    for name, value in state.items():
        if name != "integration":
            getattr(data, name)[...] = value.numpy()


class EnvState:
    """The states of parallel environments, for checkpoints."""

    def __init__(self, env: GymWrapper) -> None:
        """Takes an environment made by `make_vector_env`."""
        self.copies: tuple[ResumableEnv, ...] = tuple(env.envs)

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of each."""
        return {"copies": [copy.state_dict() for copy in self.copies]}

    def load_state_dict(self, state_dict: dict[str, Any], *, in_episode: bool = True) -> None:
        """Restores them; build the collector after this, not before.

        Args:
            state_dict: What `state_dict` returned.
            in_episode: Whether the next `reset` goes on with the episode of the state. If nothing
                had been collected yet, it starts the one that was due.
        """
        for copy, state in zip(self.copies, state_dict["copies"], strict=True):
            copy.load_state_dict(state, in_episode=in_episode)


def make_env(name: str, **kwargs: Any) -> gym.Env:
    """Builds one Gymnasium environment with float32 observations.

    Args:
        name: A Gymnasium id; "module:Id-v0" imports the module first.
        **kwargs: For `gymnasium.make`.

    Raises:
        RunError: If the id is unknown, or actions or observations are not a vector of numbers with
            finite action bounds.
    """
    try:
        with _quiet_construction():
            env = DtypeObservation(gym.make(name, **kwargs), np.float32)
    except (gym.error.Error, ModuleNotFoundError) as error:
        raise RunError(
            f"env.name={name!r} cannot be made: {error}. Give the id of an installed Gymnasium "
            "environment, such as HalfCheetah-v4, or choose env=... from recipes/configs/env."
        ) from error
    _check_spaces(name, env)
    return env


def task_name(env_id: str) -> str:
    """Returns an id without module and version, as in names of directories: "halfcheetah"."""
    return re.sub(r"-v\d+$", "", env_id.split(":")[-1]).lower()


def make_vector_env(
    name: str, num_envs: int, seed: int, *, max_steps: int | None = None
) -> GymWrapper:
    """Builds `num_envs` parallel environments that step together in this process.

    They do not reset themselves: ("next", "observation") of a last step is the true final
    observation, and the collector starts the next episode.

    Args:
        name: A Gymnasium id.
        num_envs: Number of environments; the batch size of the result is (num_envs,).
        seed: They are seeded with seed, seed + 1, ...
        max_steps: Length after which an episode is cut. Default: the task's own.

    Raises:
        RunError: See `make_env`.
    """
    limit = {} if max_steps is None else {"max_episode_steps": max_steps}
    members = [lambda: ResumableEnv(make_env(name, **limit))] * num_envs
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
            "Wrap it in gymnasium.wrappers.RescaleAction or declare its true bounds."
        )
    if not isinstance(observations, gym.spaces.Box) or len(observations.shape) != 1:
        raise RunError(
            f"{name} has the observation space {observations}; expected a one-dimensional Box. "
            "Flatten it with gymnasium.wrappers.FlattenObservation, or write a recipe of your own."
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
