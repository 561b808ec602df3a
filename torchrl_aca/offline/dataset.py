"""A stored data set: loading, replay, returns."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, TensorStorage

from torchrl_aca.errors import DatasetError
from torchrl_aca.offline.layout import (
    FORMAT,
    METADATA_FILE,
    file_name,
    row_bytes,
    row_layout,
    sha256,
)
from torchrl_aca.offline.scores import Number, normalized_score


@dataclass(frozen=True)
class OfflineDataset:
    """A data set in canonical form, mapped from disk.

    Attributes:
        path: Its directory.
        data: All transitions, shape (n,), episode after episode: `observation` (n, O), `action`
            (n, A), `next.observation` (n, O), `next.reward`, `next.done`, `next.terminated`,
            `next.truncated` (n, 1), `episode` (n,). Rows are read from disk when they are used.
            What is written to them stays in this process and never reaches the files.
        metadata: The content of `metadata.json`.
    """

    path: Path
    data: TensorDict
    metadata: dict[str, Any]

    @classmethod
    def load(
        cls, path: str | Path, *, verify: bool = False, clip_actions: float | None = None
    ) -> OfflineDataset:
        """Loads a data set that `DatasetWriter` or an importer wrote.

        Args:
            path: Its directory.
            verify: Whether to read every file and compare its checksum, which takes a second or
                so for a million transitions. Sizes are compared in any case.
            clip_actions: If a number such as 1e-5, actions are clipped to the bounds less that
                share of their half-width: to ±(1 - 1e-5) for bounds of ±1, which keeps the
                log-probabilities of squashed policies finite. The files stay as they are.

        Raises:
            DatasetError: If there is no such data set, it is of another format, or damaged.
        """
        path = Path(path)
        metadata = _read_metadata(path)
        size = metadata["transitions"]
        layout = row_layout(metadata["observation_dim"], metadata["action_dim"])
        for key, (shape, dtype) in layout.items():
            check_file(path / file_name(key), size * row_bytes(shape, dtype))
            if verify:
                _check_sum(path / file_name(key), metadata["sha256"][file_name(key)])
        data = TensorDict(batch_size=[size])
        for key, (shape, dtype) in layout.items():
            file = str(path / file_name(key))
            # A private mapping, not a shared one: no in-place operation can change the files.
            column = torch.from_file(file, shared=False, size=size * prod(shape), dtype=dtype)
            data[key] = column.view(size, *shape)
        if clip_actions is not None:
            data["action"] = _clipped(data["action"], metadata["action_bounds"], clip_actions)
        return cls(path, data, metadata)

    def replay_buffer(self, batch_size: int, **kwargs: Any) -> ReplayBuffer:
        """Returns a buffer that samples transitions uniformly, with replacement.

        Samples have the keys of `data` and nothing else, so that they can be joined with those of
        another buffer. The buffer cannot be extended.

        Args:
            batch_size: Transitions in a sample.
            **kwargs: For `torchrl.data.ReplayBuffer`, such as `transform` or `generator`.
        """
        return ReplayBuffer(
            storage=TensorStorage(self.data),
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            **kwargs,
        )

    def episode_returns(self) -> torch.Tensor:
        """Returns the undiscounted return of each episode in float64, shape (episodes,).

        Those listed as `incomplete_episodes` in the metadata were cut by the recording.
        """
        sums = torch.zeros(self.metadata["episodes"], dtype=torch.float64)
        return sums.index_add_(
            0, self.data["episode"], self.data["next", "reward"].squeeze(-1).double()
        )

    def normalized_score(self, episode_return: Number) -> Number:
        """Returns 100 (R - min) / (max - min) with the reference scores of the metadata.

        Raises:
            DatasetError: If the data set has no reference scores.
        """
        scores = self.metadata["reference_scores"]
        if scores is None:
            raise DatasetError(
                f"{self.metadata['name']!r} has no reference scores, so no return can be "
                "normalised. Give reference_scores=(min, max) when the data set is written."
            )
        return normalized_score(episode_return, (scores["min"], scores["max"]))


def returns_to_go(data: TensorDictBase, gamma: float) -> torch.Tensor:
    """Computes the discounted return from each transition to the end of its episode.

    G_t = r_t + gamma G_{t+1}, with 0 after the last step of an episode however it ended: the value
    that a truncated episode would still have had is left out.

    Args:
        data: Transitions in the order in which they were made, shape (n,), with `next.reward` and
            `next.done` of shape (n, 1). The end of the data ends the last episode.
        gamma: Discount factor in [0, 1].

    Returns:
        Shape (n, 1), in the rewards' dtype; computed in float64.

    Raises:
        ValueError: If gamma is out of range.
    """
    if not 0 <= gamma <= 1:
        raise ValueError(f"Expected gamma in [0, 1], got {gamma}.")
    reward = data["next", "reward"]
    rewards = reward.squeeze(-1).double().tolist()
    dones = data["next", "done"].squeeze(-1).tolist()
    value, values = 0.0, []
    for step, done in zip(reversed(rewards), reversed(dones), strict=True):
        value = step if done else step + gamma * value
        values.append(value)
    returns = torch.tensor(values[::-1], dtype=torch.float64, device=reward.device)
    return returns.to(reward.dtype).reshape(reward.shape)


def _read_metadata(path: Path) -> dict[str, Any]:
    if not path.is_dir():
        partial = path.with_name(path.name + ".partial")
        state = f"only {partial}, which was never finished" if partial.is_dir() else "nothing"
        raise DatasetError(
            f"{path}: expected the directory of a data set, found {state}. Import or generate it "
            "first, or correct the path."
        )
    try:
        metadata = json.loads((path / METADATA_FILE).read_text())
    except FileNotFoundError:
        raise DatasetError(
            f"{path} is no data set of torchrl_aca: it has no {METADATA_FILE}. Import it with "
            "import_d4rl or import_minari, or correct the path."
        ) from None
    except ValueError as error:
        raise DatasetError(
            f"{path / METADATA_FILE} is damaged ({error}); expected JSON. Restore it, or import "
            "the data again."
        ) from None
    found = metadata.get("format") if isinstance(metadata, dict) else None
    if found != FORMAT:
        raise DatasetError(
            f"{path} has format {found!r}; expected {FORMAT!r}. Import it with the installed "
            "version of torchrl_aca, or install the version that wrote it."
        )
    return metadata


def check_file(path: Path, size: int) -> None:
    """Raises `DatasetError` unless there is a file of so many bytes."""
    found = path.stat().st_size if path.is_file() else None
    if found != size:
        state = "is missing" if found is None else f"has {found} bytes"
        raise DatasetError(
            f"{path} {state}; expected {size} bytes. The data set is damaged: copy it again, or "
            "delete it and import it again."
        )


def _check_sum(path: Path, expected: str) -> None:
    if (found := sha256(path)) != expected:
        raise DatasetError(
            f"{path} has SHA-256 {found}; expected {expected}. Its content was changed since it "
            "was written: copy it again, or delete it and import it again."
        )


def _clipped(action: torch.Tensor, bounds: dict[str, list[float]], margin: float) -> torch.Tensor:
    if not 0 < margin < 1:
        raise DatasetError(f"clip_actions={margin}: expected a share in (0, 1), such as 1e-5.")
    low, high = torch.tensor(bounds["low"]), torch.tensor(bounds["high"])
    inset = margin * (high - low) / 2
    return action.clamp(low + inset, high - inset)
