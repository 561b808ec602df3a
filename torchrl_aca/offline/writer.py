"""Writing a data set: episode by episode, in little memory, and complete or not at all."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict
from tensordict.utils import NestedKey

from torchrl_aca.errors import DatasetError
from torchrl_aca.offline.arguments import Bounds, as_bounds, as_scores, as_size
from torchrl_aca.offline.check import DatasetChecks
from torchrl_aca.offline.dataset import OfflineDataset, check_file
from torchrl_aca.offline.layout import (
    FORMAT,
    METADATA_FILE,
    dotted,
    file_name,
    row_bytes,
    row_layout,
    sha256,
)

VECTORS = ("observation", "action", ("next", "observation"))  # the others have one number a row


class DatasetWriter:
    """Writes episodes to a new data set in canonical form.

    Episodes go to `<path>.partial` as they come; `finish` checks the whole, writes the metadata and
    renames the directory to `path`. Without `finish` nothing is left::

        with DatasetWriter("datasets/mine", observation_dim=17, action_dim=6) as writer:
            for episode in episodes:
                writer.add_episode(**episode)
            dataset = writer.finish(name="mine", env_id="HalfCheetah-v4")

    Args:
        path: Directory of the new data set; must not exist.
        observation_dim: Length of an observation, O.
        action_dim: Length of an action, A.
        action_bounds: Smallest and largest action: numbers, or A numbers each.
        allow_constant: Which of "observation", "action" and "reward" may have columns that never
            vary. At least one column of observation and action has to vary in any case.
        check_continuity: Whether `finish` refuses episodes in which a next observation is not the
            observation of the following row, and time limits that lead nowhere; see
            `DatasetChecks`.

    Raises:
        DatasetError: If `path` exists, or an argument makes no sense.
    """

    def __init__(
        self,
        path: str | Path,
        observation_dim: int,
        action_dim: int,
        *,
        action_bounds: Bounds = (-1.0, 1.0),
        allow_constant: Collection[str] = (),
        check_continuity: bool = True,
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise DatasetError(
                f"{self.path} exists already; expected a new directory. Choose another path, or "
                "delete it first."
            )
        self.observation_dim = as_size("observation_dim", observation_dim)
        self.action_dim = as_size("action_dim", action_dim)
        self.layout = row_layout(self.observation_dim, self.action_dim)
        self.bounds = as_bounds(action_bounds, self.action_dim)
        self.checks = DatasetChecks(*self.bounds, allow_constant, check_continuity)
        self.staging = self.path.with_name(self.path.name + ".partial")
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.cut: list[int] = []
        self._owner, self._token = self.staging / "owner", uuid.uuid4().hex
        self._files: dict[NestedKey, Any] = {}
        self._open = ExitStack()

    def __enter__(self) -> DatasetWriter:
        if self._files:
            raise DatasetError("a writer writes one data set: make a new DatasetWriter.")
        if self._owner.is_file():  # left by a writer that was killed
            shutil.rmtree(self.staging)
        elif self.staging.exists():
            raise DatasetError(
                f"{self.staging} is in the way, and no writer has made it. Move it, or choose "
                "another path."
            )
        try:
            self.staging.mkdir(parents=True)
        except OSError as error:
            raise DatasetError(
                f"{self.path} cannot be made: {error}. Choose another path."
            ) from error
        try:
            self._owner.write_text(self._token)
            (self.staging / "next").mkdir()
            for key in self.layout:
                file = open(self.staging / file_name(key), "wb")  # noqa: SIM115
                self._files[key] = self._open.enter_context(file)
        except BaseException:  # Python leaves only what it has entered
            self._open.close()
            shutil.rmtree(self.staging)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self._open.close()  # fails where the disk is full
        finally:
            if unfinished := self._owns_staging():
                shutil.rmtree(self.staging)
        if unfinished and kind is None:
            raise DatasetError(
                f"{self.path} was not written: finish() was never called. Call it at the end of "
                "the `with` block."
            )

    def add_episode(
        self,
        observation: Any,
        action: Any,
        next_observation: Any,
        reward: Any,
        terminated: Any,
        truncated: Any,
        *,
        complete: bool = True,
    ) -> None:
        """Appends one episode of L steps, given as arrays, tensors or nested lists.

        Args:
            observation: Shape (L, O).
            action: Shape (L, A), as the environment took it.
            next_observation: What each action led to, shape (L, O); at the last step the state
                that was reached, not the first one of the next episode.
            reward: Shape (L,).
            terminated: Boolean, shape (L,): true where the value afterwards is 0.
            truncated: Boolean, shape (L,): true where the episode was cut by a time limit or by
                the end of the recording.
            complete: False for an episode that the recording cut short: it is stored, but does
                not count in the statistics of returns.

        Raises:
            DatasetError: Naming the episode and what is wrong; see `DatasetChecks`.
        """
        given = {
            "observation": observation,
            "action": action,
            ("next", "observation"): next_observation,
            ("next", "reward"): reward,
            ("next", "terminated"): terminated,
            ("next", "truncated"): truncated,
        }
        if not self._files:
            raise DatasetError("open the writer first: `with DatasetWriter(...) as writer:`.")
        rows = self._rows(given)
        self.checks.add(rows, complete)
        for key, file in self._files.items():
            file.write(rows[key].numpy().tobytes())
        if not complete:
            self.cut.append(len(self.returns))
        self.returns.append(rows["next", "reward"].double().sum().item())
        self.lengths.append(len(rows["episode"]))

    def finish(
        self,
        *,
        name: str,
        env_id: str | None = None,
        reference_scores: tuple[float, float] | None = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> OfflineDataset:
        """Checks everything, writes the metadata and moves the data set to its path.

        Args:
            name: What the data set is called in tables and figures.
            env_id: Gymnasium id of the environment, if there is one.
            reference_scores: Returns that count as 0 and as 100 in normalised scores.
            provenance: Where the data come from: command, versions, seeds, and so on. What JSON
                does not know is stored as text.

        Returns:
            The data set, loaded from its path.

        Raises:
            DatasetError: If the data fail a check, or another writer has begun with the same path;
                nothing is at the path then.
        """
        self._require_staging()
        scores, checked = as_scores(reference_scores), self.checks.finish()
        self._sync()
        low, high = (bound.tolist() for bound in self.bounds)
        metadata = {
            "format": FORMAT,
            "name": name,
            "env_id": env_id,
            "observation_dim": self.observation_dim,
            "action_dim": self.action_dim,
            "transitions": sum(self.lengths),
            "episodes": len(self.lengths),
            "incomplete_episodes": self.cut,
            "returns": _statistics(self.complete(self.returns)),
            "lengths": _statistics(self.complete(self.lengths)),
            "reference_scores": scores,
            "action_bounds": {"low": low, "high": high},
            **checked,
            "provenance": dict(provenance or {}),
            "sha256": {
                file_name(key): sha256(self.staging / file_name(key)) for key in self.layout
            },
        }
        text = json.dumps(metadata, indent=2, default=str)
        (self.staging / METADATA_FILE).write_text(text + "\n")
        self._require_staging()
        try:
            os.rename(self.staging, self.path)
        except OSError as error:
            raise DatasetError(
                f"{self.path} cannot be made ({error}); nothing was kept. Choose another path."
            ) from error
        (self.path / self._owner.name).unlink()
        return OfflineDataset.load(self.path)

    def complete(self, numbers: Sequence[float]) -> list[float]:
        """Of one number per episode, those of episodes that the recording did not cut."""
        cut = set(self.cut)
        return [number for episode, number in enumerate(numbers) if episode not in cut]

    def _owns_staging(self) -> bool:
        """Whether the staging directory is still the one that this writer has made."""
        return self._owner.is_file() and self._owner.read_text() == self._token

    def _require_staging(self) -> None:
        if not self._owns_staging():
            raise DatasetError(
                f"{self.staging} is no longer this writer's: another one has begun to write "
                f"{self.path}. Let one of them finish, or give them different paths."
            )

    def _rows(self, given: Mapping[NestedKey, Any]) -> dict[NestedKey, torch.Tensor]:
        """Returns one episode in canonical form: for each key L rows."""
        episode = len(self.lengths)
        length = len(given["observation"])
        rows = {}  # a TensorDict would double the time of short episodes
        for key, value in given.items():
            shape, dtype = self.layout[key]
            expected = (length, *shape) if key in VECTORS else (length,)
            column = _column(value, expected, dtype, f"episode {episode}: {dotted(key)}")
            rows[key] = column.reshape(length, *shape)
        rows["next", "done"] = rows["next", "terminated"] | rows["next", "truncated"]
        rows["episode"] = torch.full((length,), episode)
        return rows

    def _sync(self) -> None:
        """Brings the rows to the disk and adds what `TensorDict.load_memmap` looks for."""
        for file in self._files.values():
            file.flush()
            os.fsync(file.fileno())
        self._open.close()
        size = sum(self.lengths)
        for key, (shape, dtype) in self.layout.items():  # mapping would fill up what is missing
            check_file(self.staging / file_name(key), size * row_bytes(shape, dtype))
        mapped = {
            key: MemoryMappedTensor.from_filename(
                self.staging / file_name(key), dtype=dtype, shape=(size, *shape)
            )
            for key, (shape, dtype) in self.layout.items()
        }
        # The tensors lie where they belong already, so this only writes the meta.json files.
        TensorDict(mapped, batch_size=[size]).memmap(self.staging)


def _statistics(numbers: Sequence[float]) -> dict[str, float] | None:
    """Returns mean, standard deviation (of the population) and range; None of nothing."""
    if not numbers:
        return None
    values = torch.tensor(numbers, dtype=torch.float64)
    return {
        "mean": values.mean().item(),
        "std": values.std(correction=0).item(),
        "min": values.min().item(),
        "max": values.max().item(),
    }


def _column(value: Any, shape: tuple[int, ...], dtype: torch.dtype, what: str) -> torch.Tensor:
    tensor = torch.as_tensor(value, device="cpu").detach()
    if tuple(tensor.shape) != shape or not len(tensor):
        raise DatasetError(f"{what} has shape {tuple(tensor.shape)}; expected {shape}, not empty.")
    if dtype is torch.bool and tensor.dtype is not torch.bool:
        raise DatasetError(f"{what} has dtype {tensor.dtype}; expected booleans.")
    return tensor.to(dtype)
