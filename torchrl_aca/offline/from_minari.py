"""Imports Minari data sets, episode by episode."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchrl_aca.errors import DatasetError, require
from torchrl_aca.offline.arguments import as_scores
from torchrl_aca.offline.dataset import OfflineDataset
from torchrl_aca.offline.importing import provenance_of, reading, write_episodes
from torchrl_aca.offline.writer import DatasetWriter


def import_minari(
    source: str | Path,
    path: str | Path,
    *,
    name: str | None = None,
    env_id: str | None = None,
    reference_scores: tuple[float, float] | None = None,
    progress: bool = True,
    **options: Any,
) -> OfflineDataset:
    """Imports a Minari data set that is on this machine; nothing is downloaded.

    Observations and actions have to be vectors (`Box` spaces of rank 1). An episode that is neither
    terminated nor truncated at its end is stored as truncated and listed under
    `incomplete_episodes`.

    Args:
        source: Id of a data set in Minari's folder (`MINARI_DATASETS_PATH`, or
            `~/.minari/datasets`), or the directory of one.
        path: Directory of the new data set; must not exist.
        name: What to call the data set; by default its id.
        env_id: Gymnasium id of the environment; by default the one that the data set names.
        reference_scores: Returns that count as 0 and 100; by default those of the data set.
        progress: Whether to show a progress bar.
        **options: `action_bounds`, `allow_constant`, `check_continuity` of `DatasetWriter`. The
            action bounds are those of the action space, if they are not given.

    Returns:
        The data set, loaded from `path`.

    Raises:
        DatasetError: If there is no such data set, it cannot be read to its end, its spaces are no
            vectors, or the data fail a check. Nothing is at `path` then.
    """
    dataset = _open(source)
    observation_dim, action_dim = (
        _vector_length(space, kind, source)
        for space, kind in (
            (dataset.observation_space, "observation"),
            (dataset.action_space, "action"),
        )
    )
    options.setdefault("action_bounds", (dataset.action_space.low, dataset.action_space.high))
    scores = _scores(dataset) if reference_scores is None else reference_scores
    as_scores(scores)  # before the work
    file = Path(dataset.storage.data_path) / "main_data.hdf5"
    with DatasetWriter(path, observation_dim, action_dim, **options) as writer:
        write_episodes(writer, _episodes(dataset, source), dataset.total_steps, progress)
        return writer.finish(
            name=name or dataset.id,
            env_id=env_id or (dataset.env_spec and dataset.env_spec.id),
            reference_scores=scores,
            provenance=provenance_of("import_minari", dataset.id, file, "minari"),
        )


def _open(source: str | Path) -> Any:
    minari = require("minari", "import_minari", "offline", DatasetError)

    directory = Path(source)
    try:
        if not directory.is_dir():
            return minari.load_dataset(str(source))
        inner = directory / "data"
        return minari.MinariDataset(inner if inner.is_dir() else directory)
    except (OSError, ValueError, KeyError, AssertionError) as error:
        missing = isinstance(error, FileNotFoundError)
        reason = "nothing found" if missing else repr(error)
        raise DatasetError(
            f"{source} is no Minari data set on this machine ({reason}); expected an id that "
            "`minari list local` shows, or the directory of a data set, which has `data/` in it."
        ) from error


def _scores(dataset: Any) -> tuple[float, float] | None:
    described = dataset.storage.metadata
    low, high = described.get("ref_min_score"), described.get("ref_max_score")
    return None if low is None or high is None else (low, high)


def _vector_length(space: Any, kind: str, source: str | Path) -> int:
    from gymnasium.spaces import Box

    if not isinstance(space, Box) or len(space.shape) != 1:
        raise DatasetError(
            f"{source}: the {kind} space is {space}; expected a Box of rank 1. Make vectors of it "
            "and write the episodes with DatasetWriter."
        )
    return space.shape[0]


def _episodes(dataset: Any, source: str | Path) -> Iterator[dict[str, Any]]:
    """Yields the arguments of `add_episode`."""
    with reading(source):
        for episode in dataset:
            steps, observed = len(episode.actions), len(episode.observations)
            if observed != steps + 1:
                raise DatasetError(
                    f"{source}: episode {episode.id} has {observed} observations for {steps} "
                    f"actions; expected {steps + 1}, the last reached one included."
                )
            if not steps:
                raise DatasetError(
                    f"{source}: episode {episode.id} has no step; expected at least one. Leave "
                    "such episodes out when the data set is made."
                )
            truncated = episode.truncations.copy()
            complete = bool(episode.terminations[-1] or truncated[-1])
            truncated[-1] |= not complete
            yield {
                "observation": episode.observations[:-1],
                "action": episode.actions,
                "next_observation": episode.observations[1:],
                "reward": episode.rewards,
                "terminated": episode.terminations,
                "truncated": truncated,
                "complete": complete,
            }
