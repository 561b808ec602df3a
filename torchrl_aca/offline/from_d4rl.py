"""Imports HDF5 files in D4RL's layout, in pieces that fit in little memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_aca.errors import DatasetError, require
from torchrl_aca.offline.arguments import as_scores
from torchrl_aca.offline.dataset import OfflineDataset
from torchrl_aca.offline.importing import provenance_of, reading, write_episodes
from torchrl_aca.offline.scores import reference_scores as known_scores
from torchrl_aca.offline.writer import DatasetWriter

RANKS = {"observations": 2, "actions": 2, "rewards": 1, "terminals": 1, "timeouts": 1}
BLOCK = 50_000  # rows read at a time; more only where an episode is longer


def import_d4rl(
    source: str | Path,
    path: str | Path,
    *,
    name: str | None = None,
    env_id: str | None = None,
    reference_scores: tuple[float, float] | None = None,
    progress: bool = True,
    **options: Any,
) -> OfflineDataset:
    """Imports an HDF5 file in D4RL's layout.

    The file has `observations` (n, O), `actions` (n, A), `rewards`, `terminals` and `timeouts`
    (n,), and may have `next_observations` (n, O); whatever else it has is ignored. An episode ends
    at a terminal or a timeout. If the file ends inside an episode, that one is stored as truncated
    and listed under `incomplete_episodes`.

    Without `next_observations`, the next observation of a row is the observation of the row after
    it, which the last row of an episode does not have. If that row is no terminal, the value of
    its next observation would be needed, so the row is dropped and the one before it marked
    truncated; the episode's return then lacks one reward. If it is a terminal, it is kept for its
    reward and its end: the value after it is 0 whatever the next observation, and its own
    observation stands in.

    Args:
        source: The HDF5 file.
        path: Directory of the new data set; must not exist.
        name: What to call the data set; by default the file's name without its ending.
        env_id: Gymnasium id of the environment, which the file does not tell.
        reference_scores: Returns that count as 0 and 100; by default D4RL's for `env_id`, of which
            HalfCheetah's are known here.
        progress: Whether to show a progress bar.
        **options: `action_bounds`, `allow_constant`, `check_continuity` of `DatasetWriter`.

    Returns:
        The data set, loaded from `path`.

    Raises:
        DatasetError: If the file has another layout or cannot be read to its end, or the data fail
            a check. Nothing is at `path` then.
    """
    h5py = require("h5py", "import_d4rl", "offline", DatasetError)

    scores = known_scores(env_id) if reference_scores is None else reference_scores
    as_scores(scores)  # before the work
    source = Path(source)
    if not source.is_file() or not h5py.is_hdf5(source):
        state = "is no HDF5 file" if source.is_file() else "does not exist"
        raise DatasetError(f"{source} {state}; expected an HDF5 file in D4RL's layout.")
    with reading(source):
        file = h5py.File(source, "r")
    with file:
        with reading(source):
            columns = _columns(file, source)
        size, observation_dim = columns["observations"].shape
        action_dim = columns["actions"].shape[1]
        with DatasetWriter(path, observation_dim, action_dim, **options) as writer:
            write_episodes(writer, _episodes(columns, source), size, progress)
            return writer.finish(
                name=name or source.stem,
                env_id=env_id,
                reference_scores=scores,
                provenance={
                    **provenance_of("import_d4rl", source.name, source, "h5py"),
                    "dropped_rows": size - sum(writer.lengths),
                    "next_observations": "stored" if "next_observations" in columns else "inferred",
                },
            )


def _columns(file: Any, source: Path) -> dict[str, Any]:
    """Returns the HDF5 data sets that are read, after a look at names, shapes and types."""
    if missing := RANKS.keys() - file.keys():
        raise DatasetError(
            f"{source} has no {sorted(missing)}; expected {list(RANKS)}, found "
            f"{sorted(file)}. Rename the keys, or write the episodes with DatasetWriter."
        )
    names = [*RANKS, *({"next_observations"} & file.keys())]
    columns = {name: file[name] for name in names}
    for name, column in columns.items():
        rank = RANKS.get(name, 2)
        fits = len(getattr(column, "shape", None) or ()) == rank
        if not fits or column.dtype.kind not in "biuf" or column.dtype.itemsize > 8:
            expected = "(rows, columns)" if rank == 2 else "(rows,)"
            raise DatasetError(
                f"{source}: {name!r} is {column}; expected an array of numbers of shape {expected}."
            )
    shapes = {name: tuple(column.shape) for name, column in columns.items()}
    following = shapes.get("next_observations", shapes["observations"])
    if len({shape[0] for shape in shapes.values()}) > 1 or following != shapes["observations"]:
        raise DatasetError(
            f"{source}: expected arrays of equal length, and observations and next_observations "
            f"of equal shape, got {shapes}. The file may have been written only in part."
        )
    if 0 in shapes["observations"] + shapes["actions"]:
        raise DatasetError(f"{source} is empty: expected rows and columns, got {shapes}.")
    return columns


def _episodes(columns: Mapping[str, Any], source: Path) -> Iterator[dict[str, Any]]:
    """Yields the arguments of `add_episode`, reading about `BLOCK` rows at a time."""
    with reading(source):
        size = len(columns["rewards"])
        ends = _flags(columns, "terminals", source) | _flags(columns, "timeouts", source)
        stops = (ends.nonzero()[0] + 1).tolist()
        if not stops:
            raise DatasetError(
                f"{source}: none of its {size} rows is a terminal or a timeout; expected at least "
                "one end of an episode. Set `timeouts` where the time limit cut an episode."
            )
        if stops[-1] < size:
            stops.append(size)
        start = block_start = block_stop = 0
        block: dict[str, torch.Tensor] = {}
        for stop in stops:
            if stop > block_stop:
                block_start, block_stop = start, min(max(stop, start + BLOCK), size)
                block = {
                    name: _tensor(column[block_start:block_stop])
                    for name, column in columns.items()
                }
            rows = slice(start - block_start, stop - block_start)
            episode = _episode({name: values[rows] for name, values in block.items()})
            if len(episode["reward"]):
                yield episode
            start = stop


def _tensor(values: Any) -> torch.Tensor:
    """Numbers in the byte order of this machine, whatever that of the file is."""
    return torch.as_tensor(values.astype(values.dtype.newbyteorder("=")))


def _flags(columns: Mapping[str, Any], name: str, source: Path) -> Any:
    values = columns[name][:]
    wrong = values[(values != 0) & (values != 1)]
    if len(wrong):
        raise DatasetError(f"{source}: {name!r} has a value of {wrong[0]}; expected 0 and 1 only.")
    return values != 0


def _episode(rows: dict[str, torch.Tensor]) -> dict[str, Any]:
    """Returns the arguments of `add_episode` for the rows of one episode, possibly none."""
    observation = rows["observations"]
    terminated, truncated = rows["terminals"] != 0, rows["timeouts"] != 0
    complete = bool(terminated[-1] | truncated[-1])
    kept = len(observation)
    if "next_observations" in rows:
        next_observation = rows["next_observations"]
    else:
        next_observation = torch.cat([observation[1:], observation[-1:]])
        kept -= int(not terminated[-1])
    if not terminated[-1]:
        truncated[kept - 1 : kept] = True  # a slice, which is empty where no row is left
    columns = {
        "observation": observation,
        "action": rows["actions"],
        "next_observation": next_observation,
        "reward": rows["rewards"],
        "terminated": terminated,
        "truncated": truncated,
    }
    return {**{name: values[:kept] for name, values in columns.items()}, "complete": complete}
