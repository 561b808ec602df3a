"""What a run leaves for the reader: versions, card and learning curve."""

from __future__ import annotations

import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from torchrl_aca.training.files import write_text

UPDATES = ("updates", "offline_updates")  # columns of the tables
PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "mujoco", "numpy", "hydra-core")


def versions() -> dict[str, Any]:
    """Returns what a result depends on besides its configuration."""
    found: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return {
        "python": platform.python_version(),
        **found,
        "commit": _commit(),
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
    }


def _commit() -> str | None:
    """The commit of this package; None where it is installed, be it inside another repository."""
    here = Path(__file__)
    if not _git(here.parent, "ls-files", here.name):
        return None
    return _git(here.parent, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints in a folder, or None."""
    command = ["git", *arguments]
    try:
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]} x {len(names)}" if names else platform.processor()


def write_card(
    run_dir: Path,
    config: Mapping[str, Any],
    axes: Mapping[str, int],
    evaluations: Sequence[Mapping[str, Any]],
    seconds: float,
    facts: Mapping[str, object],
) -> None:
    """Writes card.md: what was run, how far, on what, what came out, and whatever `facts` adds."""
    last = evaluations[-1]
    place = f" after {last['updates']} updates" * (int(last["updates"]) != axes["updates"])
    info = _stored_versions(run_dir)
    score = last.get("normalized_score")
    scores = {} if score is None else {"normalised score": f"{float(score):.1f}"}
    rows = {
        "environment": config["env"]["name"],
        "algorithm": config["algo"]["name"],
        "seed": config["seed"],
        "updates": axes["updates"],
        "environment frames": f"{axes['frames']} (warm-up included)",
        f"last return{place}": _told(last),
        **scores,
        **facts,
        "wall-clock time": f"{seconds / 60:.1f} min",
        **{name: value for name, value in info.items() if value is not None},
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    text = (
        f"# {rows['algorithm']} on {rows['environment']}, seed {rows['seed']}\n\n"
        f"| | |\n|---|---|\n{table}\n\n"
        "Run again: the whole configuration is in `config.yaml`, the evaluations are in "
        "`eval.csv`, the training metrics in `metrics.csv`.\n\n![learning curve](curve.png)\n"
    )
    write_text(run_dir / "card.md", text)


def _told(evaluation: Mapping[str, Any]) -> str:
    """An evaluation's mean, with its standard error where there are several episodes."""
    mean, episodes = (float(evaluation[name]) for name in ("return_mean", "num_episodes"))
    if episodes < 2:
        return f"{mean:.1f} (one episode)"
    error = standard_error(evaluation)
    return f"{mean:.1f} ± {error:.1f} (mean ± standard error of {episodes:.0f} episodes)"


def _stored_versions(run_dir: Path) -> dict[str, Any]:
    """What a run began with; nothing where the file has been lost since."""
    try:
        return json.loads((run_dir / "versions.json").read_text())
    except (OSError, ValueError):
        return {"versions": "lost: versions.json is missing or damaged"}


def standard_error(evaluation: Mapping[str, Any]) -> float:
    """Returns the standard error of `return_mean` over two episodes or more, unbiased.

    `return_std` is the spread of these very episodes, and so that over the root of n - 1.
    """
    return float(evaluation["return_std"]) / (float(evaluation["num_episodes"]) - 1) ** 0.5


def plot_curve(run_dir: Path, title: str, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draws the evaluation return over the updates of both phases to curve.png."""
    from matplotlib.figure import Figure

    frames, mean, std = (
        [float(row[name]) for row in evaluations]
        for name in ("frames", "return_mean", "return_std")
    )
    updates = [sum(float(row.get(n) or 0) for n in UPDATES) for row in evaluations]
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(updates, mean, marker="o", markersize=3)
    low = [m - s for m, s in zip(mean, std, strict=True)]
    high = [m + s for m, s in zip(mean, std, strict=True)]
    axes.fill_between(updates, low, high, alpha=0.2)
    if (offline := float(evaluations[-1].get("offline_updates") or 0)) > 0:
        axes.axvline(offline, color="black", linestyle=":", label="end of the offline phase")
        axes.legend()
    axes.set(title=title, xlabel=f"updates ({frames[-1]:.0f} frames at the end)", ylabel="return")
    axes.grid(alpha=0.3)
    figure.savefig(run_dir / "curve.png", dpi=120)


def plot_returns(path: Path, returns: Sequence[float], title: str) -> None:
    """Draws the distribution of the returns of a data set's whole episodes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.hist(returns, bins=50)
    if returns:
        axes.axvline(fmean(returns), color="black", linestyle="--", label="mean")
        axes.legend()
    axes.set(title=title, xlabel="return of an episode", ylabel="episodes")
    figure.savefig(path, dpi=120)
