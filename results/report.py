"""Numbers and figures of a study, from the directories of its runs, its CSV, or several of these.

    python results/report.py runs/studies/table2 results/table2
    python results/report.py results/table2/evaluations.csv results/table2 --at 50000 100000
    python results/report.py results/table2/evaluations.csv runs/studies/table2 results/table2
    python results/report.py runs/studies/offline_to_online OUT --x frames --value normalized_score

Writes one tidy CSV with every evaluation, a card with the tables, and a figure for each question:
how fast (curves.png), how good over all tasks (aggregate.png), how many runs are how good
(profiles.png), is one method better than another (improvement.png). What stands below "## Notes" in
an old card is kept. A run that several sources have counts once, as the last of them has it: so new
runs join a table whose own are gone. Needs SciPy and the `recipes` extra.

Scores are values on a scale of each task: 0 is the mean before training, 1 the best mean of a
method in this study. Methods are compared at the same updates or frames: on each task the last at
which all its runs were evaluated, or `--at`; scores are of the place that is given last.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from curves import draw_legends, draw_marks, draw_mean, make_panels
from evaluations import (
    COLUMNS,
    Row,
    Scores,
    by_run,
    by_seed,
    last_shared,
    names,
    read_csv,
    read_studies,
    scores,
    values_at,
    viewed,
)
from figures import draw_points, draw_profiles
from intervals import interquartile_mean, interval, mean, probability_of_improvement
from torchrl_aca.training.files import write_csv

PAPER = Path(__file__).parent / "paper.csv"
Lines = dict[str, dict[str, float]]  # of each task: names and values


# --- tables ---------------------------------------------------------------------------------------


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, numbers to the right."""
    ruler = "|---|" + "--:|" * (len(header) - 1)
    return "\n".join(["| " + " | ".join(header) + " |", ruler, *map(_line, lines)])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def number(value: float, like: float | None = None) -> str:
    """A return as the paper writes it, one below 100 with a decimal; or as `like` has them."""
    return f"{value:.{int(abs(value if like is None else like) < 100)}f}"


def ranged(value: float, found: tuple[float, float] | None) -> str:
    """A score with its interval."""
    return f"{value:.2f}" + (f" [{found[0]:.2f}, {found[1]:.2f}]" if found else "")


def cell(values: np.ndarray) -> str:
    """Mean, interval and number of seeds."""
    if not len(values):
        return ""
    found = interval(mean, [values])
    band = f" [{number(found[0])}, {number(found[1])}]" if found else ""
    return f"{number(values.mean())}{band} (n={len(values)})"


def task_table(rows: Sequence[Row], places: Sequence[float], unit: str, beside: bool) -> str:
    """The paper's table: tasks by methods at some places, the last shared one where none is given.

    `beside` puts the paper's own numbers below those at the same updates. What follows an
    underscore in a method's name is a variant: `aca_n4` stands above the paper's `aca`.
    """
    methods, lines = names(rows, "method"), []
    for task in names(rows, "task"):
        for place in sorted(places) or [last_shared(rows, task)]:
            values = [cell(values_at(rows, task, method, place)) for method in methods]
            if not any(values):
                continue
            lines.append([f"{task}, {place:,.0f} {unit}", *values])
            if told := paper(task, place) if beside else {}:
                theirs = [
                    told.get(m.split("_")[0], "") * bool(v)
                    for m, v in zip(methods, values, strict=True)
                ]
                lines.append(["*paper*", *theirs])
    if not lines:
        raise SystemExit(
            f"error: no run was evaluated at {list(places)} {unit}. Compare elsewhere with --at."
        )
    return markdown(["", *methods], lines)


def paper(task: str, updates: float) -> dict[str, str]:
    """What the paper's table 2 says of each method."""
    return {
        row["method"]: f"{number(row['return_mean'])} ± {number(row['half_width'])}"
        for row in read_csv(PAPER)
        if (row["task"], row["updates"]) == (task, updates)
    }


def runs_table(rows: Sequence[Row]) -> str:
    """A row for each run: how far it came, what it took, and the version that made it."""
    lines = []
    for own in by_run(rows).values():
        first, row = own[0], own[-1]
        offline = max(0, -first["updates"])
        updates = f"{offline:,.0f} + {row['updates']:,.0f}" if offline else f"{row['updates']:,.0f}"
        minutes = f"{row['seconds'] / 60:.0f}" if row["seconds"] != "" else ""
        frames = f"{row['frames']:,.0f}" if row["frames"] != "" else ""
        made = number(row["return_mean"])
        if row["return_std"] != "":
            made += " ± " + number(row["return_std"], row["return_mean"])
        counts = [f"{row['seed']:.0f}", updates, frames, made, minutes]
        lines.append([row["task"], row["method"], *counts, row["commit"][:7]])
    header = ["task", "method", "seed", "updates", "frames", "return", "minutes", "commit"]
    return markdown(header, lines)


def aggregate_table(rows: Sequence[Row], found: Scores) -> str:
    """Interquartile mean and mean over all tasks, speed and size."""
    lines = []
    for method, tasks in found.items():
        cells = [
            ranged(float(statistic(*tasks)), interval(statistic, tasks))
            for statistic in (interquartile_mean, mean)
        ]
        own = [row for row in rows if row["method"] == method]
        speeds = [row["updates_per_second"] for row in own if row["updates_per_second"] != ""]
        sizes = sorted({int(row["parameters"]) for row in own if row["parameters"] != ""})
        size = " to ".join(f"{n:,}" for n in dict.fromkeys([*sizes[:1], *sizes[-1:]]))
        lines.append([method, *cells, f"{np.median(speeds):.2f}" if speeds else "", size])
    return markdown(["method", "interquartile mean", "mean", "updates/s", "parameters"], lines)


# --- figures --------------------------------------------------------------------------------------


def draw_curves(rows: Sequence[Row], path: Path, labels: tuple[str, str], lines: Lines) -> None:
    """A panel for each task: the mean over seeds and its interval."""
    figure, panels = make_panels(names(rows, "task"), *labels)
    for task, axes in panels.items():
        for index, method in enumerate(names(rows, "method")):
            if runs := list(by_seed(rows, task, method).values()):
                draw_mean(axes, f"{method}, n={len(runs)}", runs, f"C{index}")
        draw_marks(axes, lines.get(task, {}))
    draw_legends(figure)
    figure.savefig(path, dpi=120)


# --- the report -----------------------------------------------------------------------------------


def write_report(rows: Sequence[Row], out: Path, args: argparse.Namespace) -> str:
    """Writes the CSV, the figures and the card, and returns the card."""
    shown = viewed(rows, args.x, args.value)
    beside = (args.x, args.value) == ("updates", "return_mean")
    table = task_table(shown, args.at, args.x, beside)
    tasks, found = scores(shown, args.at[-1] if args.at else None)
    lines = parse_lines(args.line)
    out.mkdir(parents=True, exist_ok=True)  # from here on nothing is refused any more
    write_csv(out / "evaluations.csv", COLUMNS, rows)
    named = {"return_mean": "mean return", "normalized_score": "normalised score"}[args.value]
    draw_curves(shown, out / "curves.png", (args.x, named), lines)
    parts = [
        f"# {out.name}\n",
        f"{named.capitalize()} and 95 % bootstrap interval over n seeds; the paper's ± is a 95 % "
        "interval.\n",
        table,
        "\n![curves](curves.png)",
    ]
    if len(found) > 1:
        parts += [aggregates(shown, tasks, found, out)]
    parts += [
        "\n## Runs\n",
        runs_table(rows),
        f"\nTables and figures again: `{command(out, args)}`",
    ]
    card = "\n".join(parts) + "\n" + notes(out / "card.md")
    (out / "card.md").write_text(card)
    return card


def command(out: Path, args: argparse.Namespace) -> str:
    """The command that makes a report anew from its CSV."""
    words = ["python", "results/report.py", str(out / "evaluations.csv"), str(out)]
    words += ["--x", args.x] * (args.x != "updates")
    words += ["--value", args.value] * (args.value != "return_mean")
    words += ["--at", *(f"{place:.15g}" for place in args.at)] * bool(args.at)
    words += [word for line in args.line for word in ("--line", line)]
    return shlex.join(words)


def notes(card: Path) -> str:
    """What somebody has written below a card, from its heading on."""
    text = card.read_text() if card.exists() else ""
    _, heading, rest = text.partition("\n## Notes\n")
    return heading + rest


def parse_lines(texts: Sequence[str]) -> Lines:
    """What `--line TASK:NAME=VALUE` says, by task."""
    lines: Lines = {}
    for text in texts:
        task, _, rest = text.partition(":")
        name, _, value = rest.partition("=")
        try:
            lines.setdefault(task, {})[name] = float(value)
        except ValueError:
            raise SystemExit(
                f"error: --line {text!r}: expected TASK:NAME=VALUE with a number."
            ) from None
    return lines


def aggregates(rows: Sequence[Row], tasks: Sequence[str], found: Scores, out: Path) -> str:
    """The part of the card that compares several methods over all tasks, and its figures."""
    statistic = interquartile_mean
    points = {m: (float(statistic(*t)), interval(statistic, t)) for m, t in found.items()}
    draw_points(out / "aggregate.png", "interquartile mean of the scores", points)
    draw_profiles(found, out / "profiles.png")
    text = (
        f"\nScores over {', '.join(tasks)}: 0 is the mean before training, 1 the best method's "
        f"mean. Intervals are stratified over tasks.\n\n{aggregate_table(rows, found)}\n\n"
        "![aggregate](aggregate.png)\n\n![profiles](profiles.png)\n\n![improvement](improvement.png)"
    )
    first, *others = reversed(found)
    pairs = {f"{first} > {other}": [*found[first], *found[other]] for other in others}
    improvement = probability_of_improvement
    points = {k: (float(improvement(*t)), interval(improvement, t)) for k, t in pairs.items()}
    draw_points(out / "improvement.png", "probability of improvement", points)
    return text


def main() -> None:
    """Parses the command line, writes the report and prints the card."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "study", type=Path, nargs="+", help="a folder of runs, or an evaluations.csv"
    )
    parser.add_argument("out", type=Path, help="the folder of the report")
    parser.add_argument("--x", choices=("updates", "frames"), default="updates")
    parser.add_argument(
        "--value", choices=("return_mean", "normalized_score"), default="return_mean"
    )
    parser.add_argument("--at", type=float, nargs="+", default=[], help="where to compare")
    parser.add_argument("--line", action="append", default=[], help="TASK:NAME=VALUE, drawn dashed")
    arguments = parser.parse_args()
    print(write_report(read_studies(arguments.study), arguments.out, arguments))


if __name__ == "__main__":
    main()
