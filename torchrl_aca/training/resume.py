"""The configuration of a run that goes on: its own, with the few keys that may change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import read_checkpoint
from torchrl_aca.training.config import RunConfig
from torchrl_aca.training.due import has_reached
from torchrl_aca.training.files import read_csv
from torchrl_aca.training.run_dir import DONE

MAY_CHANGE_ON_RESUME = (
    "optim.total_updates",
    "num_threads",
    "logger",
    "checkpoint",
    "video",
    "eval.stop_return",
)
ENDS = ("optim.total_updates", "eval.stop_return")  # where a run ends
NOT_COMPARED = (*MAY_CHANGE_ON_RESUME, "resume", "run_dir", "existing")


def resumed_config(cfg: DictConfig, overrides: Iterable[str]) -> tuple[DictConfig, dict[str, Any]]:
    """Returns the configuration of the run in `cfg.resume` and its newest checkpoint.

    The checkpoint knows how its networks were built, so the configuration is read from there;
    config.yaml is compared with it where it can be read, because it may have been edited since.

    Args:
        cfg: The configuration that was composed for this call.
        overrides: What the user typed, such as "optim.total_updates=2000".

    Raises:
        RunError: If there is no run, or an override would change what the run is.
    """
    run_dir = Path(cfg.resume)
    checkpoint = read_checkpoint(run_dir)
    run = OmegaConf.create(checkpoint["config"])
    _require_same_recipe(cfg, run, run_dir)
    stored = read_config(run_dir)
    if stored is not None:
        require_equal(stored, run, stored, f"{run_dir / 'config.yaml'}")
        for key in MAY_CHANGE_ON_RESUME:
            OmegaConf.update(run, key, OmegaConf.select(stored, key))
    apply_overrides(run, cfg, overrides)
    run.resume = str(run_dir)
    return run, checkpoint


def continued_config(cfg: DictConfig, stored: DictConfig) -> DictConfig:
    """Returns the configuration with which the command of a new run goes on with an old one.

    All of the command's settings are compared, typed or not.

    Args:
        cfg: The configuration that was composed for this call.
        stored: That of the run in `cfg.run_dir`.

    Raises:
        RunError: If the run is another one.
    """
    run = stored.copy()
    if OmegaConf.select(run, "pretrained"):  # the offline updates are those of the other run
        cfg = cfg.copy()
        cfg.optim.offline_updates = run.optim.offline_updates
    require_equal(cfg, run, run, f"the command for run_dir={cfg.run_dir}")
    for key in MAY_CHANGE_ON_RESUME:
        value = OmegaConf.select(cfg, key)
        if key != "optim.total_updates" or value is not None:  # null follows from what is compared
            OmegaConf.update(run, key, value)
    run.resume = cfg.run_dir
    return run


def is_finished(run_dir: Path, cfg: Any) -> bool:
    """Tells whether the run in a directory has ended by itself, where `cfg` has its end or later.

    Args:
        run_dir: The run's directory; it may be missing.
        cfg: A configuration with `optim.total_updates` and `eval.stop_return`.
    """
    return (run_dir / DONE).exists() and has_ended(read_evaluations(run_dir), cfg)


def has_ended(evaluations: Sequence[Mapping[str, float]], cfg: Any) -> bool:
    """Tells whether these evaluations reach the end that a configuration has."""
    updates = evaluations[-1]["updates"] if evaluations else 0
    return updates >= cfg.optim.total_updates or has_reached(evaluations, cfg.eval.stop_return)


def read_evaluations(run_dir: Path) -> list[dict[str, float]]:
    """Returns the rows of a run's eval.csv; none where it has not evaluated yet."""
    path = run_dir / "eval.csv"
    if not path.is_file():
        return []
    _, rows = read_csv(path)
    return [{name: float(value) for name, value in row.items()} for row in rows]


def read_config(run_dir: Path) -> DictConfig | None:
    """Returns a run directory's config.yaml, or None where it is missing, empty or damaged."""
    return read_yaml(run_dir / "config.yaml")


def read_yaml(path: Path) -> DictConfig | None:
    """Returns what a YAML file holds by name, or None where it is missing, empty or damaged."""
    try:
        stored = OmegaConf.load(path)
    except Exception:  # what a YAML parser raises depends on the foreign bytes
        return None
    return stored if isinstance(stored, DictConfig) and stored else None


def apply_overrides(run: DictConfig, cfg: DictConfig, overrides: Iterable[str]) -> None:
    """Brings what the user typed into a run's configuration.

    Args:
        run: The run's configuration; changed in place.
        cfg: The configuration that was composed with the overrides.
        overrides: What the user typed, such as "optim.total_updates=2000".

    Raises:
        RunError: If an override would change what the run is.
    """
    typed = {override.split("=")[0].lstrip("+~") for override in overrides} - {"resume"}
    if "algo" in typed:  # which chooses a method's own sections as well
        for key in sorted(_sections(run) & _sections(cfg) - RunConfig.model_fields.keys()):
            where = "what algo=... chooses"
            mend = "leave algo=... out, or type the run's settings beside it"
            require_equal(cfg, run, cfg[key], where, f"{key}.", mend)
    for key in sorted(typed):
        part = OmegaConf.create({})
        OmegaConf.update(part, key, OmegaConf.select(cfg, key))
        require_equal(part, run, part, "the command line")
        OmegaConf.update(run, key, OmegaConf.select(cfg, key))


def _sections(cfg: DictConfig) -> set[str]:
    return {
        str(key) for key, value in OmegaConf.to_container(cfg).items() if isinstance(value, dict)
    }


def _require_same_recipe(cfg: DictConfig, run: DictConfig, run_dir: Path) -> None:
    """Raises `RunError` where a recipe has keys, sections aside, that the run has not, or less."""
    # A key with a default has come later: runs of before it go on without.
    later = {key for key, field in RunConfig.model_fields.items() if not field.is_required()}
    if other := sorted((cfg.keys() ^ run.keys()) - later - _sections(cfg) - _sections(run)):
        raise RunError(
            f"{run_dir} is a run of another recipe, or of an earlier version of this one: only one "
            f"of the two has the key {other[0]}. Go on with the script that made it."
        )


def require_equal(
    new: DictConfig,
    run: DictConfig,
    keys: DictConfig,
    where: str,
    prefix: str = "",
    mend: str = "leave that out",
) -> None:
    """Compares the entries of `keys` in two configurations, but for those that may change.

    Raises:
        RunError: Naming the first key that `run` has otherwise than `new`, which is from `where`.
    """
    for name in keys:
        key = f"{prefix}{name}"
        if any(key == free or key.startswith(f"{free}.") for free in NOT_COMPARED):
            continue
        value = OmegaConf.select(new, key)
        if isinstance(value, DictConfig):
            require_equal(new, run, value, where, f"{key}.", mend)
        elif value != OmegaConf.select(run, key):
            raise RunError(
                f"{where} has {key}={value}, but the run to resume has "
                f"{key}={OmegaConf.select(run, key)}. Only {', '.join(MAY_CHANGE_ON_RESUME)} may "
                f"change: {mend}, or start a new run without resume=."
            )
