"""Generates an offline data set in the manner of D4RL: "D4RL-style, locally generated".

    python recipes/make_dataset.py tier=random env=halfcheetah
    python recipes/make_dataset.py tier=medium_replay env=halfcheetah

`random` has uniform actions. `medium_replay` is every transition of a SAC run
(`configs/dataset_sac.yaml`) that stops when its evaluations reach a return, and `medium` is
episodes of that run's final policy, actions sampled. Every key is in `configs/make_dataset.yaml`.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

import renderer  # noqa: F401
from agents import without_methods
from data.describe import summary
from data.generate import GeneratorConfig, make_dataset
from torchrl_aca.errors import DatasetError, RunError
from torchrl_aca.training.config import checked


@hydra.main(version_base="1.3", config_path="configs", config_name="make_dataset")
def main(cfg: DictConfig) -> None:
    """Generates a data set and says what it holds; an error is told in one message."""
    try:
        kept = without_methods(cfg, GeneratorConfig.model_fields)
        print(summary(make_dataset(checked(GeneratorConfig, kept))))
    except (DatasetError, RunError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit(
            "stopped: no data set was made. The same command makes it; a SAC run goes on from its "
            "newest checkpoint."
        ) from None


if __name__ == "__main__":
    main()
