"""What has to hold of recorded episodes before they become a data set."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import torch
from tensordict.utils import NestedKey

from torchrl_aca.errors import DatasetError
from torchrl_aca.offline.layout import dotted

NUMBERS: tuple[NestedKey, ...] = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
)
VARYING: dict[str, NestedKey] = {
    "observation": "observation",
    "action": "action",
    "reward": ("next", "reward"),
}
# float32 rounding of the same state, reached through two files or two dtypes, stays below this.
RTOL, ATOL = 1e-5, 1e-6


class DatasetChecks:
    """Checks episodes one by one and keeps counts and ranges, never rows.

    What concerns one episode raises in `add`, as early as it can be known; what concerns all of
    them (columns that never vary, the share of jumps) raises in `finish`.

    Args:
        action_low: Smallest allowed action, shape (A,).
        action_high: Largest allowed action, shape (A,).
        allow_constant: Which of "observation", "action" and "reward" may have constant columns.
        check_continuity: Whether it is an error if rows of an episode do not follow on each other,
            or if time limits lead to what cannot be the state that was reached.
    """

    def __init__(
        self,
        action_low: torch.Tensor,
        action_high: torch.Tensor,
        allow_constant: Collection[str] = (),
        check_continuity: bool = True,
    ) -> None:
        names = allow_constant if isinstance(allow_constant, Collection) else [allow_constant]
        if isinstance(names, str) or not all(name in list(VARYING) for name in names):
            raise DatasetError(
                f"allow_constant={allow_constant!r}: expected a collection of some of "
                f"{list(VARYING)}, such as ('observation',)."
            )
        self.action_low, self.action_high = action_low, action_high
        self.allow_constant = set(names)
        self.check_continuity = check_continuity
        self.episodes = self.rows = self.pairs = self.jumps = 0
        self.first_jump = ""
        self.limits = self.zeros = 0  # time limits, and those with a next observation of zeros
        self.followed = self.restarts = 0  # time limits before an episode, and those that begin it
        self.reached: torch.Tensor | None = None  # the latest time limit's next observation
        self.low: dict[str, torch.Tensor] = {}
        self.high: dict[str, torch.Tensor] = {}

    def add(self, rows: Mapping[NestedKey, torch.Tensor], complete: bool = True) -> None:
        """Checks one episode.

        Args:
            rows: L rows for each key of the canonical form.
            complete: False where the recording cut the episode short.

        Raises:
            DatasetError: If a number is not finite, an action is out of bounds, or the episode
                does not end with done, and only there.
        """
        where = f"episode {self.episodes} (rows from {self.rows})"
        self._check_finite(rows, where)
        self._check_bounds(rows["action"], where)
        self._check_end(rows["next", "done"].squeeze(-1), where)
        self._count_jumps(rows["observation"], rows["next", "observation"])
        self._count_limits(rows, complete)
        for name, key in VARYING.items():
            low, high = rows[key].amin(0), rows[key].amax(0)
            self.low[name] = torch.minimum(self.low.get(name, low), low)
            self.high[name] = torch.maximum(self.high.get(name, high), high)
        self.episodes += 1
        self.rows += len(rows["action"])

    def finish(self) -> dict[str, Any]:
        """Checks what only all episodes together can tell.

        Returns:
            For the metadata: the constant columns that were allowed, and the number of jumps.

        Raises:
            DatasetError: If there is no episode, a column never varies, successive rows of an
                episode do not fit together, or no time limit has the state that it led to.
        """
        if not self.episodes:
            raise DatasetError("there is no episode to store: expected at least one add_episode().")
        constant = self._constant_columns()
        if self.jumps and self.check_continuity:
            raise DatasetError(
                f"{self.jumps} of {self.pairs} transitions inside episodes "
                f"({100 * self.jumps / self.pairs:.2g} %) have a next.observation that is not the "
                f"observation of the row after it; the first is {self.first_jump}. Expected equal "
                "numbers: the episodes may be cut at wrong rows. If the recording is meant to be "
                "so, pass check_continuity=False."
            )
        self._check_limits()
        return {"constant_columns": constant, "jumps": self.jumps}

    def _check_finite(self, rows: Mapping[NestedKey, torch.Tensor], where: str) -> None:
        for key in NUMBERS:
            bad = (~rows[key].isfinite()).nonzero()
            if len(bad):
                row, column = bad[0].tolist()
                raise DatasetError(
                    f"{where}: {dotted(key)} is {rows[key][row, column].item()} at step {row}, "
                    f"column {column}; expected numbers that are finite in float32."
                )

    def _check_bounds(self, action: torch.Tensor, where: str) -> None:
        bad = ((action < self.action_low) | (action > self.action_high)).nonzero()
        if len(bad):
            row, column = bad[0].tolist()
            low, high = self.action_low[column].item(), self.action_high[column].item()
            raise DatasetError(
                f"{where}: the action is {action[row, column].item()} at step {row}, column "
                f"{column}; expected a number in [{low}, {high}]. Pass the action_bounds of the "
                "environment, or store actions as the environment took them."
            )

    @staticmethod
    def _check_end(done: torch.Tensor, where: str) -> None:
        ends = done.nonzero().squeeze(-1).tolist()
        last = len(done) - 1
        if ends != [last]:
            raise DatasetError(
                f"{where}: expected the last step, {last}, to be terminated or truncated and no "
                f"other, got ends at {ends[:5]}. Add one episode at a time, and mark the last step "
                "of an episode that was cut short as truncated."
            )

    def _count_jumps(self, observation: torch.Tensor, next_observation: torch.Tensor) -> None:
        reached, found = next_observation[:-1], observation[1:]
        jumps = (~torch.isclose(reached, found, rtol=RTOL, atol=ATOL)).any(-1).nonzero()
        if len(jumps) and not self.jumps:
            step = int(jumps[0])
            gap = (reached[step] - found[step]).abs().max().item()
            self.first_jump = (
                f"row {self.rows + step} (step {step} of episode {self.episodes}), off by {gap:.3g}"
            )
        self.pairs += len(reached)
        self.jumps += len(jumps)

    def _count_limits(self, rows: Mapping[NestedKey, torch.Tensor], complete: bool) -> None:
        """A time limit's next observation is bootstrapped from, and no row after it tells of it."""
        first, last = rows["observation"][0], rows["next", "observation"][-1]
        if self.reached is not None:
            self.followed += 1
            self.restarts += int(torch.equal(self.reached, first))
        limit = complete and not rows["next", "terminated"][-1]
        self.reached = last.clone() if limit else None
        self.limits += int(limit)
        self.zeros += int(limit and not last.any())

    def _check_limits(self) -> None:
        """One such observation may be chance, all of them are a recorder that wrote another one."""
        found = {
            "zeros": self.limits > 0 and self.zeros == self.limits,
            "the first observation of the episode after it": 0 < self.followed == self.restarts,
        }
        for what, everywhere in found.items():
            if everywhere and self.check_continuity:
                raise DatasetError(
                    f"at every time limit next.observation is {what}; expected the state that the "
                    "last action led to, from which values are bootstrapped. Record it before the "
                    "reset. Of a D4RL file remove `next_observations`: such rows are dropped then. "
                    "If the recording is meant to be so, pass check_continuity=False."
                )

    def _constant_columns(self) -> dict[str, list[int]]:
        constant = {
            name: (self.low[name] == self.high[name]).nonzero().squeeze(-1).tolist()
            for name in VARYING
        }
        constant = {name: columns for name, columns in constant.items() if columns}
        # A vector of which nothing varies is a recording or an import that went wrong.
        dead = [n for n, c in constant.items() if n != "reward" and len(c) == len(self.low[n])]
        if wrong := sorted({*dead, *(constant.keys() - self.allow_constant)}):
            listed = "; ".join(f"{name}: columns {constant[name]}" for name in wrong)
            advice = (
                f"Nothing of {' and '.join(dead)} varies, so the recording went wrong."
                if dead
                else f"If the environment is like that, pass allow_constant={tuple(wrong)!r}."
            )
            raise DatasetError(
                f"expected columns that vary over the {self.rows} transitions, got constant ones: "
                f"{listed}. {advice}"
            )
        return constant
