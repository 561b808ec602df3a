"""Lower bounds of values from the returns in the data, with what is unknown after a cut."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_aca.checks import check_at_least, check_choice
from torchrl_aca.errors import DatasetError
from torchrl_aca.offline.dataset import returns_to_go

Tail = Literal["truncate", "mask", "bootstrap_rate"]


def check_tail(tail: Tail, gamma: float) -> None:
    """Raises `ValueError` if there is no such tail, or it has no finite sum."""
    check_choice(get_args(Tail), tail=tail)
    if tail == "bootstrap_rate" and gamma >= 1:
        raise ValueError(f"tail='bootstrap_rate' needs gamma below 1, got gamma={gamma}.")


def return_bounds(
    data: TensorDictBase, gamma: float, *, tail: Tail = "truncate", horizon: int = 460
) -> Tensor:
    """Computes what Cal-QL takes as lower bounds of the values: discounted returns to go.

    After a terminal state nothing follows, and the return is exact. After a time limit the episode
    would have gone on, and its rest is unknown. With `k` steps left, `gamma^k` of the value there
    is missing; so with negative rewards the return is no lower bound near the end.

    Args:
        data: Whole episodes in the order in which they were made, shape (n,), with `next.reward`,
            `next.done` and `next.terminated` of shape (n, 1). Where there is an `episode` of shape
            (n,), a change of it ends an episode too; so does the end of the data.
        gamma: Discount factor in [0, 1].
        tail: What to take for the rest of an episode that was cut. `truncate`: nothing, as the
            code of Cal-QL and WSRL does. `mask`: there is no bound, minus infinity, in its last
            `horizon` steps. `bootstrap_rate`: its last reward for ever, `r / (1 - gamma)`, as in
            WSRL's code for tasks without an end; `gamma` has to be below 1.
        horizon: Steps without a bound, for `mask`. With a gamma of 0.99, 1 % of the value of the
            last state is left after 460 steps.

    Returns:
        Shape (n, 1), in the rewards' dtype.

    Raises:
        DatasetError: If no row ends an episode, so that no return is known.
        ValueError: If a setting is out of range.
    """
    check_tail(tail, gamma)
    check_at_least(1, horizon=horizon)
    if not data["next", "done"].any():
        raise DatasetError(
            f"none of {len(data)} rows ends an episode (next.done), so returns to go are unknown; "
            "expected whole episodes. Record or import the data with their time limits."
        )
    ends = _ends(data)
    cut = ends & ~data["next", "terminated"].squeeze(-1)
    reward = data["next", "reward"]
    if tail == "bootstrap_rate":
        reward = torch.where(cut.unsqueeze(-1), reward / (1 - gamma), reward)
    following = {"reward": reward, "done": ends.unsqueeze(-1)}
    rows = data.empty().set("next", data["next"].empty().update(following))
    bounds = returns_to_go(rows, gamma)
    if tail == "mask":
        bounds[_near_a_cut(ends, cut, horizon)] = -torch.inf
    return bounds


def _ends(data: TensorDictBase) -> Tensor:
    """Which rows are the last of their episode, (n,)."""
    ends = data["next", "done"].squeeze(-1).clone()
    ends[-1] = True
    if (episode := data.get("episode", None)) is not None:
        ends[:-1] |= episode[1:] != episode[:-1]
    return ends


def _near_a_cut(ends: Tensor, cut: Tensor, horizon: int) -> Tensor:
    """Which rows are among the last `horizon` of an episode that was cut, (n,)."""
    places = ends.nonzero().squeeze(-1)
    rows = torch.arange(len(ends), device=ends.device)
    end_of = places[torch.searchsorted(places, rows)]
    return cut[end_of] & (end_of - rows < horizon)
