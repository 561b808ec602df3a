"""Imports a data set in D4RL's or Minari's form.

    python recipes/import_dataset.py source=FILE.hdf5 format=d4rl path=datasets/NAME
    python recipes/import_dataset.py source=ID format=minari path=datasets/NAME

Every key is in `configs/import_dataset.yaml`.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig, OmegaConf

from torchrl_aca.offline import DatasetError, OfflineDataset, import_d4rl, import_minari

IMPORTERS = {"d4rl": import_d4rl, "minari": import_minari}


def import_dataset(cfg: DictConfig) -> OfflineDataset:
    """Imports what the configuration names.

    Raises:
        DatasetError: If a key is missing or the import fails.
    """
    needed = ("format", "path", "source")
    missing = [key for key in needed if OmegaConf.is_missing(cfg, key) or cfg[key] is None]
    if missing:
        raise DatasetError(f"expected values for {missing}: set them with {missing[0]}=... .")
    if cfg.format not in IMPORTERS:
        raise DatasetError(f"format={cfg.format}: expected one of {list(IMPORTERS)}.")
    keywords = OmegaConf.to_container(cfg)
    keywords.update({key: str(keywords[key]) for key in ("source", "path")})  # a number is a name
    importer = IMPORTERS[keywords.pop("format")]
    if keywords["action_bounds"] is None:
        del keywords["action_bounds"]
    return importer(**keywords)


def summary(dataset: OfflineDataset) -> str:
    """What a user wants to see of a new data set."""
    metadata = dataset.metadata
    text = (
        f"{dataset.path}: {metadata['transitions']} transitions in {metadata['episodes']} episodes"
    )
    if returns := metadata["returns"]:
        text += (
            f"\nreturns: mean {returns['mean']:.1f}, std {returns['std']:.1f}, "
            f"range {returns['min']:.1f} to {returns['max']:.1f}"
        )
        if metadata["reference_scores"]:
            text += (
                f"\nnormalised score of the mean: {dataset.normalized_score(returns['mean']):.1f}"
            )
    return text


@hydra.main(version_base="1.3", config_path="configs", config_name="import_dataset")
def main(cfg: DictConfig) -> None:
    try:
        print(summary(import_dataset(cfg)))
    except DatasetError as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("stopped: nothing was imported. The same command begins anew.") from None


if __name__ == "__main__":
    main()
