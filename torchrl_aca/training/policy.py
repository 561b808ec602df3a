"""Policies for use: a run writes them beside its checkpoints, anyone builds them again."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from torchrl_aca.errors import RunError
from torchrl_aca.training.files import read_torch_file, replace_file

FORMAT = "torchrl-aca policy 1"
PACKAGE = "torchrl_aca"
ENTRIES = {
    "config": dict,
    "factory": str,
    "observation_dim": int,
    "low": torch.Tensor,
    "high": torch.Tensor,
    "settings": dict,
    "weights": dict,
    "updates": int,
}

Which = int | Literal["best"] | None


@dataclass(frozen=True)
class PolicyBuilder:
    """How a policy is built: a public factory of this package, and what it is called with.

    Attributes:
        factory: Is called as `factory(observation_dim, spec, device=..., **settings)`.
        observation_dim: Size of the observation vector.
        spec: Bounded spec of one environment's action, (A,).
        settings: Plain keywords: numbers, texts, and lists and dicts of them.
    """

    factory: Callable[..., TensorDictModuleBase]
    observation_dim: int
    spec: Bounded
    settings: Mapping[str, Any]

    def __post_init__(self) -> None:
        """Raises a ValueError for a factory that a file may not name."""
        if _factory(self.name) is not self.factory:
            raise ValueError(
                f"Expected a factory in the __all__ of a module of {PACKAGE}, got {self.name}: "
                "a file may name no other. Leave policy_builder out of the Agent; then the run "
                "writes checkpoints alone."
            )

    @classmethod
    def of(
        cls, env: EnvBase, factory: Callable[..., TensorDictModuleBase], **settings: Any
    ) -> PolicyBuilder:
        """Takes sizes and bounds from the specs of an environment."""
        observation_dim = env.observation_spec["observation"].shape[-1]
        return cls(factory, observation_dim, env.action_spec_unbatched, settings)

    @property
    def name(self) -> str:
        """The factory with its module."""
        return f"{self.factory.__module__}.{self.factory.__name__}"

    def build(self, device: torch.device | str = "cpu", **how: Any) -> Any:
        """Returns a new policy; `how` are keywords that change nothing of what it is."""
        return self.factory(
            self.observation_dim, self.spec.to(device), device=device, **self.settings, **how
        )


def policy_path(directory: Path, which: int | Literal["best"]) -> Path:
    """The file of the policy after so many updates, or of the best one, in `checkpoints/`."""
    return directory / f"policy_{which if which == 'best' else format(which, '010d')}.pt"


def save_policy(
    path: Path,
    builder: PolicyBuilder,
    policy: TensorDictModuleBase,
    config: Mapping[str, Any],
    updates: int,
    evaluation: Mapping[str, float] | None = None,
) -> None:
    """Writes a policy, whole or not at all.

    Args:
        path: The file; its directory is made.
        builder: Builds a policy with the same entries of its state.
        policy: Gives the weights.
        config: The run's.
        updates: After how many of both phases.
        evaluation: What it has reached, where that is known.
    """
    low, high = builder.spec.space.low, builder.spec.space.high
    content = {
        "format": FORMAT,
        "config": dict(config),
        "factory": builder.name,
        "observation_dim": builder.observation_dim,
        "low": low.cpu().clone(),
        "high": high.cpu().clone(),
        "settings": dict(builder.settings),
        # Copies: a part of a larger storage would be written with all of it.
        "weights": {k: v.detach().cpu().clone() for k, v in policy.state_dict().items()},
        "updates": updates,
        "evaluation": dict(evaluation or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, lambda file: torch.save(content, file))


def drop_newer_policies(directory: Path, updates: int) -> None:
    """Removes the policies in `checkpoints/` after more updates than a run that goes on has."""
    for kept in _kept(directory):
        if kept != "best" and kept > updates:
            policy_path(directory, kept).unlink()


def load_policy(
    run_dir: str | Path, checkpoint: Which = None, device: torch.device | str = "cpu"
) -> TensorDictModuleBase:
    """Returns the policy of a run with all its settings, without recipe, replay data or simulator.

    It is a TensorDictModule from "observation" to "action", in the environment's units, that
    follows TorchRL's exploration type; called with a tensor it returns a tensor.

    Args:
        run_dir: The run's directory.
        checkpoint: The number of updates of a kept checkpoint, or "best": the one with the highest
            return of all evaluations of the run. Default: the newest.
        device: Where the policy is put.

    Raises:
        RunError: If there is no such policy, or its file is damaged or does not fit this version.
    """
    return build_policy(read_policy(run_dir, checkpoint), device)


def read_policy(run_dir: str | Path, checkpoint: Which = None) -> dict[str, Any]:
    """Returns what a run has written of a policy: its `config`, `updates`, `evaluation`, ... .

    Raises:
        RunError: As `load_policy`.
    """
    path = _find(Path(run_dir), checkpoint)
    content, fault = read_torch_file(path, FORMAT, ENTRIES)
    if fault:
        raise RunError(
            f"{path} {fault}. Choose another checkpoint: {_kept(path.parent)}, or go on with the "
            "run, which writes a new one."
        )
    return content


def build_policy(
    content: Mapping[str, Any], device: torch.device | str = "cpu"
) -> TensorDictModuleBase:
    """Builds the policy that `read_policy` has read, in evaluation mode.

    Raises:
        RunError: If this version has no such factory, or builds another policy with it.
    """
    factory = _factory(content["factory"])
    if factory is None:
        raise RunError(
            f"the policy is built by {content['factory']!r}; expected a public factory of this "
            f"{PACKAGE}. Use the version that wrote it, which versions.json names."
        )
    low, high = content["low"], content["high"]
    spec = Bounded(low, high, shape=low.shape, dtype=low.dtype)
    builder = PolicyBuilder(factory, content["observation_dim"], spec, content["settings"])
    try:
        policy = builder.build(device)
        policy.load_state_dict(content["weights"])
    except Exception as error:  # factories are told foreign values
        raise RunError(
            f"the policy cannot be built with {builder.name}: {type(error).__name__}: {error}. Use "
            "the version that wrote it, which versions.json names."
        ) from error
    if len(policy.out_keys) > 1:  # a distribution's parameters: a caller wants the action
        policy.select_out_keys("action")
    return policy.requires_grad_(False).eval()


def best_return(directory: Path) -> float | None:
    """The evaluation of the best policy in `checkpoints/`; None where none can be read."""
    content, _ = read_torch_file(policy_path(directory, "best"), FORMAT, ENTRIES)
    return content["evaluation"]["return_mean"] if content else None


def _factory(name: str) -> Callable[..., TensorDictModuleBase] | None:
    """The function that is so called, if it is one of this package's public ones."""
    module, _, function = name.rpartition(".")
    if not module.startswith(f"{PACKAGE}."):
        return None
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError:
        return None
    return getattr(found, function) if function in getattr(found, "__all__", ()) else None


def _kept(directory: Path) -> list[int | Literal["best"]]:
    """The policies in a directory: their updates, oldest first, then the best one."""
    numbered = sorted(directory.glob("policy_[0-9]*.pt"))
    best: list[Literal["best"]] = ["best"] if policy_path(directory, "best").exists() else []
    return [*(int(path.stem.rpartition("_")[2]) for path in numbered), *best]


def _find(run_dir: Path, checkpoint: Which) -> Path:
    """The file of a policy."""
    directory = run_dir / "checkpoints"
    kept = _kept(directory)
    if not kept:
        raise RunError(
            f"{run_dir}: expected a run directory with checkpoints/policy_*.pt, found none. Give "
            "the directory that the run printed when it started. A run of an earlier version "
            "writes one with its next checkpoint: go on with it with resume=."
        )
    if checkpoint is None:
        numbered = [which for which in kept if which != "best"]
        checkpoint = numbered[-1] if numbered else "best"  # type: ignore[assignment]
    if checkpoint not in kept:
        raise RunError(
            f"{run_dir}: expected checkpoint to be one of {kept}, got {checkpoint!r}. "
            "checkpoint.keep_last and checkpoint.keep_best say which ones a run keeps."
        )
    assert checkpoint is not None
    return policy_path(directory, checkpoint)
