"""The paper's two-dimensional bandit: eight Gaussian modes on a circle, four of them high."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

MODE_STD = 0.3
MODE_WEIGHTS = torch.tensor([2.0, 1.0] * 4)
_ANGLES = torch.arange(8) * torch.pi / 4
MODES = 2**0.5 * torch.stack([_ANGLES.cos(), _ANGLES.sin()], dim=-1)
HIGH_MODES = {"top": MODES[2], "right": MODES[0], "bottom": MODES[6], "left": MODES[4]}


def mixture(action: Tensor) -> Tensor:
    """The sum of the weighted modes, each with peak height 1, for actions of shape (*, 2)."""
    squared_distance = (action.unsqueeze(-2) - MODES.to(action)).square().sum(-1)
    return (-squared_distance / (2 * MODE_STD**2)).exp() @ MODE_WEIGHTS.to(action)


def _highest() -> float:
    # The neighbours pull the maximum a little off the centre: look on a fine grid around one.
    offset = torch.linspace(-0.01, 0.01, 201, dtype=torch.float64)
    grid = torch.cartesian_prod(offset, offset) + HIGH_MODES["right"].double()
    return mixture(grid).max().item()


HIGHEST = _highest()


def reward(action: Tensor) -> Tensor:
    """The mixture's density, scaled to a maximum of 1; shape (*,) for actions of shape (*, 2)."""
    return mixture(action) / HIGHEST


def mode_shares(action: Tensor, radius: float = MODE_STD) -> dict[str, float]:
    """The share of the actions, (N, 2), that lie within `radius` of each high mode."""
    return {
        name: ((action - centre).norm(dim=-1) < radius).float().mean().item()
        for name, centre in HIGH_MODES.items()
    }


class TwoDBandit(EnvBase):
    """A batch of bandits with one step per episode and nothing to observe.

    The action spec is the box that random actions are drawn from. The reward is defined in the
    whole plane, so actions outside the box are taken as they are.
    """

    def __init__(self, num_envs: int = 1, half_width: float = 2.0) -> None:
        super().__init__(batch_size=[num_envs])
        shape = (num_envs, 2)
        self.action_spec = Bounded(-half_width, half_width, shape=shape)
        self.observation_spec = Composite(
            observation=Unbounded(shape=(num_envs, 1)), shape=self.batch_size
        )
        self.reward_spec = Unbounded(shape=(num_envs, 1))

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        return TensorDict(observation=torch.zeros(*self.batch_size, 1), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        over = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        value = reward(tensordict["action"]).unsqueeze(-1)
        return self._reset().update({"reward": value, "done": over, "terminated": over.clone()})

    def _set_seed(self, seed: int | None) -> None:
        """The env draws nothing."""
