"""What the importers share: the loop over episodes, errors of damaged files, provenance."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torchrl_aca.errors import DatasetError
from torchrl_aca.offline.layout import sha256
from torchrl_aca.offline.writer import DatasetWriter


def write_episodes(
    writer: DatasetWriter, episodes: Iterator[dict[str, Any]], total: int, progress: bool
) -> None:
    """Adds episodes, given as arguments of `add_episode`, behind a progress bar of `total` rows."""
    from tqdm import tqdm

    with tqdm(total=total, unit="row", desc=str(writer.path), disable=not progress) as bar:
        for episode in episodes:
            writer.add_episode(**episode)
            bar.update(len(episode["reward"]))


@contextmanager
def reading(source: str | Path) -> Iterator[None]:
    """Turns what HDF5 raises for damaged files into a `DatasetError`."""
    try:
        yield
    except (OSError, KeyError, RuntimeError) as error:
        raise DatasetError(
            f"{source} cannot be read to its end ({error}). It is damaged or was cut short: copy "
            "or download it again."
        ) from error


def provenance_of(importer: str, name: str, file: Path, package: str) -> dict[str, Any]:
    """Returns what the metadata say about an import, with the checksum of its source."""
    return {
        "importer": importer,
        "source": name,
        "source_sha256": sha256(file) if file.is_file() else None,
        "versions": {each: version(each) for each in ("torchrl-aca", package)},
    }
