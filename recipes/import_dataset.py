"""Imports a data set in D4RL's or Minari's form.

    python recipes/import_dataset.py source=FILE.hdf5 format=d4rl path=datasets/NAME
    python recipes/import_dataset.py source=ID format=minari path=datasets/NAME

Every key is in `configs/import_dataset.yaml`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import hydra
from omegaconf import DictConfig
from pydantic import Field

from data.describe import summary
from torchrl_aca.errors import DatasetError, RunError
from torchrl_aca.offline import OfflineDataset, import_d4rl, import_minari
from torchrl_aca.training.config import Section, checked

IMPORTERS = {"d4rl": import_d4rl, "minari": import_minari}
Name = Annotated[str, Field(coerce_numbers_to_str=True, strict=False)]  # 2024 may be one


class ImporterConfig(Section):
    """`import_dataset.yaml`; what has `Any` is checked by the importer."""

    source: Name
    format: Literal["d4rl", "minari"]
    path: Name
    name: str | None
    env_id: str | None
    reference_scores: Any
    action_bounds: Any
    allow_constant: list[Literal["observation", "action", "reward"]]
    check_continuity: bool


def import_dataset(cfg: DictConfig) -> OfflineDataset:
    """Imports what the configuration names.

    Raises:
        DatasetError: If the import fails.
        RunError: If a key is missing or wrong.
    """
    keywords = checked(ImporterConfig, cfg).model_dump()
    importer = IMPORTERS[keywords.pop("format")]
    if keywords["action_bounds"] is None:
        del keywords["action_bounds"]
    return importer(**keywords)


@hydra.main(version_base="1.3", config_path="configs", config_name="import_dataset")
def main(cfg: DictConfig) -> None:
    """Imports a data set and says what it holds; an error is told in one message."""
    try:
        print(summary(import_dataset(cfg)))
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("stopped: nothing was imported. The same command begins anew.") from None


if __name__ == "__main__":
    main()
