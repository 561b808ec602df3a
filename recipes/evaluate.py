"""Evaluates the policies of runs over many episodes, and films them.

    python recipes/evaluate.py run=runs/<directory>
    python recipes/evaluate.py run=[runs/<one>,runs/<another>] episodes=200 random=true
    python recipes/evaluate.py run=runs/<directory> checkpoint=best video=true

Prints mean return, standard error, 95 % interval and, where D4RL's reference returns are known, the
normalised score, and adds a row to `evaluations.csv` in the run directory. Every key is in
`configs/evaluate.yaml`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import hydra
import torch
from omegaconf import DictConfig
from pydantic import Field
from torchrl.modules import RandomPolicy

import renderer  # noqa: F401
from torchrl_aca.errors import RunError
from torchrl_aca.offline.scores import normalized_score, reference_scores
from torchrl_aca.training.config import Count, Device, Env, Eval, Section, Seed, Threads, checked
from torchrl_aca.training.evaluation import evaluate, make_eval_env, record_video
from torchrl_aca.training.launch import find_device
from torchrl_aca.training.logging import CsvTable
from torchrl_aca.training.policy import build_policy, read_policy
from torchrl_aca.training.report import standard_error

NORMAL_QUANTILE = 1.96  # of 95 %, both sides


class EvaluateConfig(Section):
    """`evaluate.yaml`."""

    run: str | Annotated[list[str], Field(min_length=1)]
    checkpoint: int | str | None
    episodes: Annotated[int, Field(ge=2, le=10**4)]  # one has no standard error
    seed: Seed
    random: bool
    video: bool
    max_steps: Count | None
    device: Device
    num_threads: Threads


def evaluate_runs(cfg: EvaluateConfig) -> list[dict[str, Any]]:
    """Evaluates the policy of each run, then films each; the rows that were written.

    Raises:
        RunError: If a run has no such policy, or its table or film cannot be made. Rows that were
            written before stay.
    """
    device = find_device(cfg.device, cfg.num_threads)
    run_dirs = [Path(run) for run in ([cfg.run] if isinstance(cfg.run, str) else cfg.run)]
    stored = {run_dir: read_policy(run_dir, cfg.checkpoint) for run_dir in run_dirs}
    rows = []
    for run_dir, content in stored.items():
        for row in evaluate_run(cfg, content, device):
            print(f"{run_dir}, {told(row)}", flush=True)  # first: it may not be ours to write there
            add_row(run_dir, row)
            rows.append(row)
    if cfg.video:
        for run_dir, content in stored.items():
            path = run_dir / f"video_{name_of(cfg, content)}.mp4"
            policy, task = build_policy(content, device), checked(Env, content["config"]["env"])
            limit = settings_of(cfg, content["config"]).max_steps
            record_video(policy, task, path, cfg.seed, device, max_steps=limit)
            print(f"video: {path}")
    return rows


def evaluate_run(
    cfg: EvaluateConfig, content: dict[str, Any], device: torch.device
) -> list[dict[str, Any]]:
    """Returns a row for the policy and, if it is asked for, one for random actions."""
    config = content["config"]
    require_other_seeds(cfg, config)
    env = make_eval_env(checked(Env, config["env"]), settings_of(cfg, config))
    policies = [(name_of(cfg, content), build_policy(content, device), device)]
    if cfg.random:
        policies.append(("random", RandomPolicy(env.action_spec), torch.device("cpu")))
    scores = reference_scores(config["env"]["name"])
    rows = []
    for name, policy, place in policies:
        result = evaluate(policy, env, cfg.seed, place)
        updates = "" if name == "random" else content["updates"]
        rows.append({"checkpoint": name, "updates": updates, **summary(result, scores, cfg.seed)})
    env.close()
    return rows


def settings_of(cfg: EvaluateConfig, config: Mapping[str, Any]) -> Eval:
    """The run's own settings of an evaluation, with what is asked for here."""
    asked = {"episodes": cfg.episodes, "seed": cfg.seed}
    if cfg.max_steps is not None:
        asked["max_steps"] = cfg.max_steps
    return checked(Eval, {**config["eval"], **asked})


def summary(
    result: dict[str, float], scores: tuple[float, float] | None, seed: int
) -> dict[str, Any]:
    """Adds standard error and interval to what `evaluate` returned; the columns of the table."""
    mean, error = result["return_mean"], standard_error(result)
    return {
        "episodes": int(result["num_episodes"]),
        "seed": seed,
        "return_mean": mean,
        "return_std": result["return_std"],
        "standard_error": error,
        "interval_low": mean - NORMAL_QUANTILE * error,
        "interval_high": mean + NORMAL_QUANTILE * error,
        "episode_length": result["episode_length"],
        "normalized_score": normalized_score(mean, scores) if scores else "",
    }


def told(row: dict[str, Any]) -> str:
    """A row in a line."""
    policy = "random actions" if row["checkpoint"] == "random" else f"{row['updates']} updates"
    score = row["normalized_score"]
    return (
        f"{policy}: return {row['return_mean']:.1f} ± {row['standard_error']:.1f} "
        f"(mean ± standard error of {row['episodes']} episodes), 95 % interval "
        f"{row['interval_low']:.1f} to {row['interval_high']:.1f}"
        + (f", normalised score {score:.1f}" if score != "" else "")
    )


def name_of(cfg: EvaluateConfig, content: dict[str, Any]) -> str:
    """The policy in the table and in the film's name: "best", or its updates."""
    return "best" if cfg.checkpoint == "best" else str(content["updates"])


def require_other_seeds(cfg: EvaluateConfig, config: dict[str, Any]) -> None:
    """Raises `RunError` if an episode would begin as one that the run was trained on."""
    first, last = config["seed"], config["seed"] + config["collector"]["num_envs"] - 1
    if cfg.seed <= last and cfg.seed + cfg.episodes > first:
        raise RunError(
            f"seed={cfg.seed}: expected {cfg.episodes} seeds apart from the training's {first} to "
            f"{last}. Set it with seed=... ."
        )


def add_row(run_dir: Path, row: dict[str, Any]) -> None:
    """Adds a row to the table of a run, after those of earlier evaluations."""
    try:
        CsvTable(run_dir / "evaluations.csv", until={}).append(row)
    except OSError as error:
        raise RunError(f"{run_dir} cannot be written: {error}. Mend that.") from error


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    """Evaluates; an error is told in one message."""
    try:
        evaluate_runs(checked(EvaluateConfig, cfg))
    except RunError as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("stopped: the rows that were printed are in the tables.") from None


if __name__ == "__main__":
    main()
