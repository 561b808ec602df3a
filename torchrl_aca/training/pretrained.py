"""The agent at the end of an offline phase: written by one run, taken over by others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_aca.errors import RunError
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import list_checkpoints, read_content, restore, write_content

PRETRAINED_FILE = "pretrained.pt"


def save_pretrained(
    run_dir: Path, parts: Mapping[str, Any], config: dict[str, Any], facts: Mapping[str, object]
) -> None:
    """Writes the agent's parts and the counters to `pretrained.pt`, with what they came from."""
    kept = {name: part for name, part in parts.items() if name.startswith("agent.")}
    kept["counters"] = parts["counters"]
    told = {name: str(fact) for name, fact in facts.items()}
    write_content(run_dir / PRETRAINED_FILE, kept, config, facts=told)


def read_pretrained(run_dir: Path) -> dict[str, Any]:
    """Reads what a run's offline phase ended with.

    Returns:
        A dict with "config", "facts" and "parts".

    Raises:
        RunError: If the run has not come to the end of an offline phase, or the file is damaged.
    """
    path = run_dir / PRETRAINED_FILE
    if not path.exists():
        raise RunError(f"pretrained={run_dir}: {_why_missing(run_dir)}")
    content, fault = read_content(path)
    if fault:
        raise RunError(f"pretrained={run_dir}: {path.name} {fault}. Train it again.")
    return content


def _why_missing(run_dir: Path) -> str:
    """Why a directory has no pretrained agent."""
    checkpoints = list_checkpoints(run_dir / "checkpoints")
    content = read_content(checkpoints[-1])[0] if checkpoints else {}
    if not content:
        return (
            "expected the directory of a run with an offline phase, found none. Give one that a "
            "run printed when it started, or leave pretrained out: then this run makes the phase."
        )
    done = content["parts"]["counters"]["offline_updates"]
    whole = content["config"]["optim"]["offline_updates"]
    if not whole:
        return (
            "that run had no offline phase, so its agent was not trained on data alone. Leave "
            "pretrained out, or give a run with offline_updates above 0."
        )
    return (
        f"its offline phase has made {done} of {whole} updates; expected all. Go on with it first: "
        f"resume={run_dir}."
    )


def take_over(agent: Agent, pretrained: Mapping[str, Any]) -> int:
    """Restores an agent from what `read_pretrained` returned; the number of offline updates.

    Parts that the offline phase of the other run did not have stay as they are.

    Raises:
        RunError: If a part does not fit.
    """
    parts = {f"agent.{name}": part for name, part in agent.state.items()}
    stored = pretrained["parts"]
    restore({name: part for name, part in parts.items() if name in stored}, stored)
    return stored["counters"]["offline_updates"]
