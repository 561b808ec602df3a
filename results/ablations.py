"""The paper's ablations: the return by guidance weight and by number of noise levels.

    python results/ablations.py

Writes guidance_weight/ablation.png and num_steps/ablation.png from the CSV of the two studies
(`study=guidance_weight`, `study=num_steps`), with a panel for each task and a point for each seed
at the last evaluation that all runs of the task have. The paper's setting is marked.
"""

from __future__ import annotations

from pathlib import Path

from curves import make_panels
from evaluations import by_setting, names, read_study
from figures import draw_settings

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


def main() -> None:
    """Draws both figures."""
    for study, (method, xlabel, default) in ABLATIONS.items():
        rows = read_study(HERE / study / "evaluations.csv")
        figure, panels = make_panels(names(rows, "task"), xlabel)
        for task, axes in panels.items():
            axes.set_xscale("log")
            axes.axvline(default, color="C3", linewidth=6, alpha=0.2)
            axes.minorticks_off()
            draw_settings(axes, by_setting(rows, task, method))
            axes.xaxis.set_major_formatter("{x:.0f}")
        figure.savefig(HERE / study / "ablation.png", dpi=120)


if __name__ == "__main__":
    main()
