"""The exact, savable state of Gymnasium environments: an episode that goes on after a restart."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium.wrappers import (
    DtypeObservation,
    FlattenObservation,
    OrderEnforcing,
    PassiveEnvChecker,
    TimeLimit,
)
from torchrl.envs import GymWrapper

# What has no state but the simulator's, and what may stand around it without one of its own.
_KNOWN_SIMULATORS = "gymnasium.envs.mujoco."
_KNOWN_WRAPPERS = (
    DtypeObservation,
    FlattenObservation,
    OrderEnforcing,
    PassiveEnvChecker,
    TimeLimit,
)
_INTEGRATION_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class ResumableEnv(gym.Wrapper):
    """Saves and restores an environment in the middle of an episode.

    After `load_state_dict`, `reset` returns the restored observation until the first step is made,
    so a collector that resets its environments when it starts goes on with the saved episode.

    The state is exact for Gymnasium's own MuJoCo environments. Others, the user's subclasses of
    these among them, and those with wrappers of the user's choice may have a state of their own:
    they keep their random stream but begin a new episode, because Gymnasium has no general way to
    save them.
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
        if self.is_exact:
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
    def is_exact(self) -> bool:
        """Whether the state holds all that the next step follows from."""
        known = type(self.unwrapped).__module__.startswith(_KNOWN_SIMULATORS)
        return known and all(isinstance(layer, _KNOWN_WRAPPERS) for layer in self._layers())

    @property
    def time_limit(self) -> TimeLimit | None:
        """The wrapper that ends episodes, if there is one."""
        return next((layer for layer in self._layers() if isinstance(layer, TimeLimit)), None)

    def _layers(self) -> Iterator[gym.Wrapper]:
        """The wrappers inside this one, from the outside in."""
        env = self.env
        while isinstance(env, gym.Wrapper):
            yield env
            env = env.env


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

    @property
    def is_exact(self) -> bool:
        """Whether a restored environment goes on with its episode, bit for bit."""
        return all(copy.is_exact for copy in self.copies)

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
