"""The offline half of a recipe's minibatches: where it is, whether it fits, what the card says."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf.errors import OmegaConfBaseException
from torchrl.envs import EnvBase

from agents import without_methods
from data.generate import GeneratorConfig, make_dataset
from torchrl_aca.errors import RunError
from torchrl_aca.offline import OfflineDataset, reference_scores
from torchrl_aca.offline.layout import METADATA_FILE, sha256
from torchrl_aca.offline.registry import ROOT
from torchrl_aca.offline.scores import Scores
from torchrl_aca.replay import TRANSITION_KEYS, MixedReplayBuffer, make_replay_buffer
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import checked
from torchrl_aca.training.envs import task_name


def dataset_path(cfg: Any) -> Path:
    """The directory of the data set that `cfg.dataset` names.

    Raises:
        RunError: If none is named, or one that only TorchRL's own readers know.
    """
    if cfg.dataset is None:
        use = f"algo={cfg.algo.name} has an offline phase, which learns from it"
        without = "or learn without: offline_fraction=0"
        raise RunError(
            "dataset=null: expected the directory of a data set, or aca:NAME. Make one with "
            f"recipes/make_dataset.py; {use if makes_offline_phase(cfg) else without}."
        )
    prefix, colon, name = cfg.dataset.partition(":")
    if not colon or Path(cfg.dataset).is_dir():
        return Path(cfg.dataset)
    if prefix == "aca":  # what `load_dataset("aca:NAME")` of `register_datasets` reads
        return Path(ROOT) / name
    raise RunError(
        f"dataset={cfg.dataset}: expected a directory, or aca:NAME for datasets/NAME. Bring other "
        "data in with recipes/import_dataset.py first. TorchRL's own readers are not used, because "
        "those of 0.14.1 give wrong rows: zeros for Minari's data, and for D4RL's a next "
        "observation of zeros at each time limit."
    )


def needs_data(cfg: Any) -> bool:
    """Whether there are minibatches with rows of the data set, in the online phase or before."""
    return bool(cfg.offline_fraction or makes_offline_phase(cfg))


def makes_offline_phase(cfg: Any) -> bool:
    """Whether there are updates on the data alone, which no other run has made."""
    return bool(cfg.optim.offline_updates and cfg.pretrained is None)


def generate_missing(cfg: Any) -> None:
    """Makes the data set where there is none and `cfg.generate` says how.

    It draws from the global random streams, so a run is seeded afterwards.

    Raises:
        DatasetError: See `make_dataset`.
        RunError: See `make_dataset`; or if `generate` has a key that this does not have.
    """
    if cfg.generate is None or not needs_data(cfg) or dataset_path(cfg).exists():
        return
    if own := {"path", "env"} & cfg.generate.keys():
        raise RunError(
            f"generate={cfg.generate}: expected keys of make_dataset.yaml but {sorted(own)}, which "
            "follow from dataset and env. Leave them out."
        )
    recipe = hydra.compose("make_dataset", [f"env.name={cfg.env.name}"])
    try:
        recipe.merge_with(cfg.generate)
    except OmegaConfBaseException as error:
        message = str(error).splitlines()[0]
        raise RunError(f"generate: {message}; expected keys of make_dataset.yaml.") from None
    recipe.path = str(dataset_path(cfg))
    print(f"generating {recipe.path}", flush=True)
    make_dataset(checked(GeneratorConfig, without_methods(recipe, GeneratorConfig.model_fields)))


def prepare_data(cfg: Any) -> None:
    """Makes the data set of a run to come, or sees that it is there, without reading its rows.

    Raises:
        DatasetError: If there is none, or a file of it is missing.
        RunError: As in `generate_missing`.
    """
    generate_missing(cfg)
    if needs_data(cfg):
        OfflineDataset.load(dataset_path(cfg))


def load_offline_data(cfg: Any, env: EnvBase) -> OfflineDataset | None:
    """The data set, or None where neither phase has a minibatch with a part of it.

    Raises:
        DatasetError: If there is none, or it is damaged.
        RunError: If it was made in another environment than `env`.
    """
    if not needs_data(cfg):
        return None
    dataset = OfflineDataset.load(dataset_path(cfg), verify=True)
    require_fit(cfg, dataset.metadata, env)
    return dataset


def require_fit(cfg: Any, metadata: Mapping[str, Any], env: EnvBase) -> None:
    """Raises `RunError` unless task, sizes and actions of a data set are those of `env`."""
    actions = env.action_spec_unbatched
    source, name = metadata["env_id"], f"dataset={cfg.dataset}"
    if source is not None and task_name(source) != task_name(cfg.env.name):
        raise RunError(
            f"{name} is of {source}; expected data of {cfg.env.name}. Choose that environment with "
            "env=... , or another data set."
        )
    got = {key: metadata[f"{key}_dim"] for key in ("observation", "action")}
    sizes = (env.observation_spec["observation"].shape[-1], actions.shape[-1])
    if (expected := dict(zip(got, sizes, strict=True))) != got:
        raise RunError(
            f"{name} has rows of other sizes than {cfg.env.name}: expected {expected}, got {got}. "
            "Choose the environment that the data are of with env=... ."
        )
    low, high = (torch.tensor(metadata["action_bounds"][side]) for side in ("low", "high"))
    if (low < actions.space.low).any() or (high > actions.space.high).any():
        raise RunError(
            f"{name} has action_bounds {low.tolist()} and {high.tolist()}; expected them within "
            f"{actions.space.low.tolist()} and {actions.space.high.tolist()}, which {cfg.env.name} "
            "takes. Import the data with the environment's action_bounds, or rescale the actions."
        )


def require_whole_episodes(cfg: Any, metadata: Mapping[str, Any]) -> None:
    """Raises `RunError` if no episode of a data set has an end of its own."""
    if len(metadata["incomplete_episodes"]) == metadata["episodes"]:
        raise RunError(
            f"dataset={cfg.dataset} has no episode with an end of its own, so what came after its "
            f"rows is unknown; algo={cfg.algo.name} needs returns to go. Import the data with "
            "their terminals and time limits, or take algo=cql."
        )


def task_scores(cfg: Any) -> Scores | None:
    """The returns that count as 0 and 100: the data set's, or else those known for the task.

    A data set may be named without taking rows from it, so that a control has the same scale.
    """
    if cfg.dataset is not None and dataset_path(cfg).is_dir():
        own = OfflineDataset.load(dataset_path(cfg)).metadata["reference_scores"]
        if own is not None:
            return own["min"], own["max"]
    return reference_scores(cfg.env.name)


def make_mixture(cfg: Any, dataset: OfflineDataset | None, agent: Agent) -> MixedReplayBuffer:
    """The buffer that minibatches are drawn from. The loss scales the rewards of both halves.

    Raises:
        RunError: If the agent needs whole episodes, and the recording has cut every one.
    """
    if dataset is not None and agent.offline_rows:
        require_whole_episodes(cfg, dataset.metadata)
    return MixedReplayBuffer(
        None if dataset is None else agent.offline_rows_of(dataset.data),
        make_replay_buffer(cfg.buffer.capacity, cfg.optim.batch_size),
        offline_fraction=cfg.offline_fraction,
        batch_size=cfg.optim.batch_size,
        keys=(*TRANSITION_KEYS, *agent.extra_keys),
        seed=cfg.seed,
    )


def offline_facts(dataset: OfflineDataset | None, buffer: MixedReplayBuffer) -> dict[str, object]:
    """Rows for the card: which data, and how much of a minibatch they are."""
    if dataset is None:
        return {"offline data": "none"}
    metadata = dataset.metadata
    text = f"{metadata['name']}, {metadata['transitions']} transitions"
    if metadata["returns"]:
        text += f", mean return {metadata['returns']['mean']:.1f}"
    return {
        "offline data": text,
        f"SHA-256 of its {METADATA_FILE}": sha256(dataset.path / METADATA_FILE),
        "offline rows of a minibatch": f"{buffer.num_offline(buffer.batch_size)} of "
        f"{buffer.batch_size}",
    }
