"""How faithful a short chain is: its actions beside those of the whole chain, on trained critics.

    python recipes/chain_fidelity.py runs/<directory> ... --updates 5000 20000

For each checkpoint, and each spacing and number of levels, on the newest states that the run has
seen: the mean value of the actions, the spread of a state's candidates, and a permutation test of
the energy distance on each of a few states. Writes fidelity.csv and fidelity.png, and prints the
table; border.csv tells how much of the clean estimate the clip moves at each level, where the chain
is free to skip. The critic was trained with the chain of its own run; every chain here runs on that
critic.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import renderer  # noqa: F401
from fidelity.figure import draw, print_table
from fidelity.measures import border_shares, energy_distance_test, spread
from fidelity.spacings import PACKAGE, SPACINGS, levels_of
from torchrl_aca import CriticGuidedDenoisingActor
from torchrl_aca.errors import RunError
from torchrl_aca.training.checkpoint import list_checkpoints, read_checkpoint, updates_of
from torchrl_aca.training.policy import build_policy, read_policy

CANDIDATES, TEST_SAMPLES, PERMUTATIONS = 128, 2000, 199  # of a state


def measure_checkpoint(
    actor: CriticGuidedDenoisingActor, policy: dict[str, Any], states: Tensor, args: Any
) -> Iterator[dict[str, Any]]:
    """Yields a row for each chain; the first is the whole chain against itself, on other draws."""
    config = policy["config"]
    tested = states[:: max(len(states) // args.tested_states, 1)][: args.tested_states]
    num_steps = actor.schedule.num_steps
    about = {
        "task": config["env"]["name"],
        "schedule": config["aca"]["schedule"],
        "num_steps": num_steps,
        "normalized": not args.raw_gradient,
    }
    whole = _Chain(actor, list(range(1, num_steps + 1)), args)
    reference = whole.sample(states, CANDIDATES), whole.sample(tested, TEST_SAMPLES)
    chains = [("all", num_steps)]
    shorter = [steps for steps in args.steps if steps < num_steps]
    chains += [(spacing, steps) for spacing in (PACKAGE, *SPACINGS) for steps in shorter]
    for spacing, steps in chains:
        chain = whole
        if spacing != "all":
            chain = _Chain(actor, levels_of(spacing, actor.schedule, steps), args)
        samples = chain.sample(states, CANDIDATES), chain.sample(tested, TEST_SAMPLES)
        yield {
            **about,
            "spacing": spacing,
            "gradients": len(chain.levels) - 1,
            "levels": " ".join(map(str, chain.levels)),
            **compare(actor, (states, tested), reference, samples),
        }


class _Chain:
    """The actor's chain on some of its levels."""

    def __init__(
        self, actor: CriticGuidedDenoisingActor, levels: list[int], args: argparse.Namespace
    ) -> None:
        self.levels = levels
        self.actor = CriticGuidedDenoisingActor(
            actor.critic,
            actor.schedule,
            guidance_weight=float(actor.guidance_weight),
            inference_levels=levels,
            normalize_gradient=not args.raw_gradient,
        )

    @torch.no_grad()
    def sample(self, states: Tensor, num_candidates: int) -> Tensor:
        """Returns actions of shape `(N, states, A)`, in critic units, from fresh draws."""
        shape = (len(self.levels) + 1, num_candidates, len(states), self.actor.action_dim)
        return self.actor.denoise(states, torch.randn(shape))


@torch.no_grad()
def compare(
    actor: CriticGuidedDenoisingActor,
    states: tuple[Tensor, Tensor],
    reference: tuple[Tensor, Tensor],
    samples: tuple[Tensor, Tensor],
) -> dict[str, float]:
    """The measures of one chain: candidates of many states, and many samples of a few states."""
    features = actor.encode(states[0], states[0].shape[:-1])
    level = torch.zeros((), dtype=torch.long)
    expected, values = (
        actor.critic.evaluate(features, actions, level).mean(-1)
        for actions in (reference[0], samples[0])
    )
    generator = torch.Generator().manual_seed(0)
    tests = [
        energy_distance_test(reference[1][:, k], samples[1][:, k], PERMUTATIONS, generator)
        for k in range(len(states[1]))
    ]
    return {
        "value": float(values.mean()),
        "value_spread": spread(expected),
        "value_difference": float((values - expected).mean()) / spread(expected),
        "std": spread(samples[0]),
        "std_ratio": spread(samples[0]) / spread(reference[0]),
        "energy_distance": sum(distance for distance, _ in tests) / len(tests),
        "rejected": sum(p < 0.05 for _, p in tests) / len(tests),
    }


def checkpoints(args: argparse.Namespace) -> Iterator[tuple[str, int, dict[str, Any], Tensor]]:
    """Yields every checkpoint that is asked for: run, updates, policy, and the newest states."""
    for run_dir in args.runs:
        kept = [updates_of(path) for path in list_checkpoints(run_dir / "checkpoints")]
        for updates in args.updates or kept[-1:] or [None]:
            checkpoint = read_checkpoint(run_dir, updates)
            states = newest_states(checkpoint["parts"]["buffer"], args.states)
            yield run_dir.name, updates, read_policy(run_dir, updates), states


def newest_states(buffer: Mapping[str, Any], number: int) -> Tensor:
    """The last observations that went into a buffer, of a mixture into its online half."""
    online = buffer.get("online", buffer)
    if "observation" not in online["rows"]:
        raise RunError("a checkpoint without a frame has no states. Give --updates of a later one.")
    return online["rows"]["observation"].roll(-online["writer"]["_cursor"], 0)[-number:]


def guided(policy: dict[str, Any]) -> CriticGuidedDenoisingActor:
    """The actor of a policy's file."""
    actor, name = build_policy(policy), policy["config"]["algo"]["name"]
    if name != "aca":
        raise RunError(f"algo={name} has no chain to shorten. Give runs of algo=aca.")
    return actor


def measure_runs(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for each chain of every checkpoint."""
    for run, updates, policy, states in checkpoints(args):
        for row in measure_checkpoint(guided(policy), policy, states, args):
            print(f"{run} {updates}: {row['spacing']} {row['levels']}", flush=True)
            yield {"run": run, "updates": updates, **row}


def measure_borders(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for each level of the whole chain of every checkpoint."""
    for run, updates, policy, states in checkpoints(args):
        actor = guided(policy)
        whole = _Chain(actor, list(range(1, actor.schedule.num_steps + 1)), args)
        for level, share in enumerate(border_shares(whole.actor, states, 8), start=1):
            yield {"run": run, "updates": updates, "level": level, "clipped": share}


def write(rows: Iterator[dict[str, Any]], path: Path) -> list[dict[str, Any]]:
    """Writes each row as it comes: an interrupt leaves those so far, no row the old table."""
    written: list[dict[str, Any]] = []
    if (first := next(rows, None)) is None:
        return written
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, first.keys())
        writer.writeheader()
        for row in itertools.chain([first], rows):
            writer.writerow({k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()})
            file.flush()
            written.append(row)
    return written


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run directories with checkpoints")
    parser.add_argument("--updates", nargs="+", type=int, help="checkpoints; default: the newest")
    parser.add_argument("--steps", nargs="+", type=int, default=[4, 5, 6, 7, 8, 10, 12])
    parser.add_argument("--states", type=int, default=256, help="newest states of the buffer")
    parser.add_argument("--tested-states", type=int, default=16, help="states of the distance test")
    parser.add_argument("--raw-gradient", action="store_true", help="do not normalise gradients")
    parser.add_argument("--out", type=Path, default=Path("results/chain_fidelity"))
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    args = parse(arguments)
    torch.manual_seed(0)
    try:
        write(measure_borders(args), args.out / "border.csv")
        rows = write(measure_runs(args), args.out / "fidelity.csv")
    except RunError as error:
        sys.exit(f"error: {error}")
    draw(rows, args.out / "fidelity.png")
    print_table(rows)


if __name__ == "__main__":
    main()
