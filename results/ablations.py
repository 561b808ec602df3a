"""The paper's ablations: the return by guidance weight and by number of noise levels.

    python results/ablations.py
    python results/ablations.py runs/studies/guidance_weight

Writes guidance_weight/ablation.png and num_steps/ablation.png from the CSV of the two studies
(`study=guidance_weight`, `study=num_steps`), with a panel for each task and a point for each seed
at the last evaluation that all runs of the task have. The paper's setting is marked. From
guidance_weight/weights.csv it draws weights.png, the weights that tune themselves; given the runs,
it writes that table first.
"""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import OmegaConf

from curves import make_panels
from evaluations import by_setting, names, place_in_study, read_csv, read_study, rows_of_run
from figures import draw_settings
from torchrl_aca.training.files import write_csv

HERE = Path(__file__).parent
# Of each study: the names of its methods, the label of the axis, and the paper's setting.
ABLATIONS = {
    "guidance_weight": (
        r"(?P<line>w|auto)(?P<setting>\d+)",
        "guidance weight, or where it begins",
        50,
    ),
    "num_steps": (r"(?P<line>T)(?P<setting>\d+)", "noise levels", 20),
}


def draw_ablation(study: str, method: str, xlabel: str, default: float) -> None:
    """Draws the returns of a study by a setting."""
    rows = read_study(HERE / study / "evaluations.csv")
    figure, panels = make_panels(names(rows, "task"), xlabel)
    for task, axes in panels.items():
        axes.set_xscale("log")
        axes.axvline(default, color="C3", linewidth=6, alpha=0.2)
        axes.minorticks_off()
        draw_settings(axes, by_setting(rows, task, method))
        axes.xaxis.set_major_formatter("{x:.0f}")
    figure.savefig(HERE / study / "ablation.png", dpi=120)


def write_weights(study: Path) -> None:
    """Gathers the weights that tuned themselves from the runs of a study."""
    measured = ("updates", "guidance_weight", "candidate_spread", "guidance_gain")
    rows = []
    for path in sorted(study.glob("*-auto*/metrics.csv")):
        config = OmegaConf.load(path.with_name("config.yaml"))
        task, method = place_in_study(path.parent, config)
        run = {"task": task, "method": method, "seed": config.seed}
        rows += [{**run, **row} for row in rows_of_run(path)]
    if not rows:
        raise SystemExit(f"error: {study}: expected runs of methods named auto..., found none.")
    header = ("task", "method", "seed", *measured)
    write_csv(HERE / "guidance_weight/weights.csv", header, rows)


def draw_weights() -> None:
    """Draws them by updates: a line for each run, a colour for each start."""
    path = HERE / "guidance_weight/weights.csv"
    rows = read_csv(path)
    figure, panels = make_panels(names(rows, "task"), "updates", "guidance weight")
    for task, axes in panels.items():
        axes.set_yscale("log")
        for colour, method in enumerate(names(rows, "method")):
            own = [row for row in rows if (row["task"], row["method"]) == (task, method)]
            for number, seed in enumerate(names(own, "seed")):
                run = [row for row in own if row["seed"] == seed]
                x, y = ([row[key] for row in run] for key in ("updates", "guidance_weight"))
                axes.plot(x, y, color=f"C{colour}", label=None if number else method)
        axes.legend(frameon=False)
    figure.savefig(path.with_suffix(".png"), dpi=120)


def main() -> None:
    """Draws the figures."""
    if len(sys.argv) > 1:
        write_weights(Path(sys.argv[1]))
    for study, (method, xlabel, default) in ABLATIONS.items():
        draw_ablation(study, method, xlabel, default)
    draw_weights()


if __name__ == "__main__":
    main()
