"""The figures of the bandit study, as in the paper's figures 2 and 3 and its appendix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from bandit.config import GUIDED, RIVALS
from bandit.env import HIGH_MODES, MODE_STD, reward
from torchrl_aca import CriticGuidedDenoisingActor
from torchrl_aca.baselines import DiffusionPolicy

Actor = CriticGuidedDenoisingActor | DiffusionPolicy
Actors = Mapping[str, Actor]

LABELS = {
    "aca": "Diffusion-$Q_t$ (ACA)",
    "diffusion_q": "Diffusion-$Q$",
    "langevin_q": "Langevin-$Q$",
    "sdac": "SDAC",
    "qsm": "QSM",
    "dacer": "DACER",
    "dipo": "DIPO",
    "nclql": "NC-LQL",
}
COLORS = {  # Okabe and Ito
    "aca": "#0072B2",
    "diffusion_q": "#D55E00",
    "langevin_q": "#009E73",
    "nclql": "#CC79A7",
}
HALF_WIDTH = 2.3  # of all maps: the same axes everywhere
NUM_ARROWS = 200
LEVELS = (9, 6, 3, 0)
EXTENT = (-HALF_WIDTH, HALF_WIDTH, -HALF_WIDTH, HALF_WIDTH)


def draw_figures(
    run_dir: Path, actors: Actors, reported: Sequence[Mapping], swept: Sequence[Mapping]
) -> None:
    """Writes every figure that the trained methods allow, as PNG files and one GIF."""
    torch.manual_seed(0)
    paths = {method: grid_trajectory(actor) for method, actor in actors.items()}
    figures = {
        "reward": reward_map(),
        **{f"steps_{method}": all_steps(LABELS[method], path) for method, path in paths.items()},
    }
    guided, trained = (
        {m: a for m, a in actors.items() if m in which} for which in (GUIDED, RIVALS)
    )
    if guided:
        figures["samples"], figures["sensitivity"] = overview(guided, reported), sensitivity(swept)
    if trained:
        figures["samples_rivals"] = overview(trained, reported)
    if {"aca", "diffusion_q"} <= actors.keys():
        figures["value_maps"] = value_maps(actors)
    for name, figure in figures.items():
        figure.savefig(run_dir / f"{name}.png", dpi=90, bbox_inches="tight")
    for name, group in (("steps", guided), ("steps_rivals", trained)):
        if group:
            animate({method: paths[method] for method in group}, run_dir / f"{name}.gif")


def plane(num: int = 161) -> Tensor:
    """A square grid of actions, (num, num, 2), rows from the bottom."""
    line = torch.linspace(-HALF_WIDTH, HALF_WIDTH, num)
    x, y = torch.meshgrid(line, line, indexing="xy")
    return torch.stack([x, y], dim=-1)


def show_map(axes: Axes, values: Tensor, title: str, **limits: float) -> Any:
    """A value map with the high modes' circles."""
    image = axes.imshow(values, origin="lower", extent=EXTENT, cmap="viridis", **limits)
    axes.set_title(title)
    axes.set(xlim=EXTENT[:2], ylim=EXTENT[2:], xticks=(-1, 0, 1), yticks=(-1, 0, 1))
    return image


def mark_high_modes(axes: Axes) -> None:
    """Dashed circles: what counts as having reached a high mode."""
    angle = torch.linspace(0, 2 * torch.pi, 60)
    circle = MODE_STD * torch.stack([angle.cos(), angle.sin()])
    for centre in HIGH_MODES.values():
        axes.plot(*(circle + centre[:, None]), color="white", linestyle="--", linewidth=0.9)


def row_of_axes(number: int, height: float = 3.0) -> tuple[Figure, Sequence[Axes]]:
    """A figure with `number` square axes in one row."""
    figure = Figure(figsize=(2.75 * number, height), layout="constrained")
    return figure, figure.subplots(1, number, sharey=True, squeeze=False)[0]


def reward_map() -> Figure:
    """The reward over the plane."""
    figure, (axes,) = row_of_axes(1)
    figure.colorbar(show_map(axes, reward(plane()), "reward"), shrink=0.8)
    mark_high_modes(axes)
    return figure


@torch.no_grad()
def overview(actors: Actors, reported: Sequence[Mapping]) -> Figure:
    """Figures 3 and 4 of the paper: the reward, and for each method arrows from a_T to a_0."""
    figure, axes = row_of_axes(len(actors) + 1)
    show_map(axes[0], reward(plane()), "reward")
    mark_high_modes(axes[0])
    axes[0].set_xlabel("circles: within 0.3 of a high mode", fontsize=9)
    longest = max(len(actor.fixed_noise) for actor in actors.values())
    noise = torch.randn(longest, 1, NUM_ARROWS, 2)
    for ax, (method, actor) in zip(axes[1:], actors.items(), strict=True):
        path = trajectory(actor, noise[: len(actor.fixed_noise)])
        arrows(ax, path, LABELS[method])
        runs = [row for row in reported if row["method"] == method]
        mean, std, share = (
            sum(run[key] for run in runs) / len(runs)
            for key in ("reward_mean", "reward_std", "sum")
        )
        text = f"reward {mean:.2f} ± {std:.2f}, at high modes {share:.0%}"
        ax.set_xlabel(text, fontsize=9)
    return figure


def arrows(axes: Axes, path: Tensor, title: str) -> None:
    """From the first (white) to the last (yellow) actions of a path of shape (T+1, N, 2)."""
    show_map(axes, reward(plane()), title, alpha=0.85)
    start, end = path[0], path[-1]
    axes.quiver(
        *start.T, *(end - start).T, angles="xy", scale_units="xy", scale=1,
        color="white", width=0.003, alpha=0.35,
    )  # fmt: skip
    axes.scatter(*start.T, s=5, color="white", linewidths=0)
    axes.scatter(*end.T, s=9, color="#FFE119", edgecolors="black", linewidths=0.3)


def value_maps(actors: Actors) -> Figure:
    """Figure 2 of the paper: Q(., t) from noisy to clean, beside the plain critic."""
    figure, axes = row_of_axes(len(LEVELS) + 1)
    noisy, plain = actors["aca"].critic, actors["diffusion_q"].critic
    actions = plane()
    for ax, level in zip(axes, LEVELS, strict=False):
        level = min(level, actors["aca"].schedule.num_steps)
        show_map(ax, values(noisy, actions, level), f"$Q(a_t, t={level})$")
        mark_high_modes(ax)
    image = show_map(axes[-1], values(plain, actions, 0), "plain $Q(a)$")
    mark_high_modes(axes[-1])
    bar = figure.colorbar(image, ax=axes[-1], shrink=0.8, ticks=[])
    bar.set_label("low to high, each map its own", fontsize=8)
    return figure


@torch.no_grad()
def values(critic: Any, actions: Tensor, level: int) -> Tensor:
    """The critics' mean at actions of shape (H, W, 2)."""
    rows = actions.reshape(-1, 2)
    features = critic.encode(torch.zeros(len(rows), 1))
    return critic.evaluate(features, rows, torch.tensor(level)).mean(-1).view(actions.shape[:-1])


def sensitivity(swept: Sequence[Mapping]) -> Figure:
    """Sum of shares against the guidance weight: mean over the seeds, and their range."""
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for method in dict.fromkeys(row["method"] for row in swept):
        rows = [row for row in swept if row["method"] == method]
        weights = sorted({row["weight"] for row in rows})
        sums = torch.tensor(
            [[row["sum"] for row in rows if row["weight"] == weight] for weight in weights]
        )
        axes.plot(
            weights, sums.mean(-1), "o-", markersize=3, color=COLORS[method], label=LABELS[method]
        )
        low, high = sums.amin(-1), sums.amax(-1)
        axes.fill_between(weights, low, high, color=COLORS[method], alpha=0.2, linewidth=0)
    axes.set(xscale="log", xlabel="guidance weight $w$", ylabel="share of samples at high modes")
    axes.set_ylim(0, 1)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return figure


@torch.no_grad()
def grid_trajectory(actor: Actor, num: int = 17) -> Tensor:
    """Every step of chains that start on a grid, (T+1, num^2, 2)."""
    line = torch.linspace(-2, 2, num)
    start = torch.cartesian_prod(line, line)
    noise = torch.randn(len(actor.fixed_noise), 1, len(start), 2)
    noise[0] = start
    return trajectory(actor, noise)


def trajectory(actor: Actor, noise: Tensor) -> Tensor:
    """Every step of one chain for each row, (S+1, rows, 2), in the modes' units."""
    return actor.to_env(actor.trajectory(torch.zeros(noise.shape[2], 1), noise)[:, 0])


def all_steps(title: str, path: Tensor) -> Figure:
    """One panel for each of a_T .. a_0."""
    columns = 6
    rows = -(-len(path) // columns)
    figure = Figure(figsize=(2 * columns, 2.2 * rows), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
    for ax, (step, actions) in zip(panels, enumerate(path), strict=False):
        show_map(ax, reward(plane()), f"$a_{{{len(path) - 1 - step}}}$", alpha=0.85)
        ax.scatter(*actions.T, s=4, color="#FFE119", edgecolors="black", linewidths=0.2)
    for ax in list(figure.axes)[len(path) :]:
        ax.remove()
    return figure


def animate(paths: Mapping[str, Tensor], file: Path) -> None:
    """The methods side by side, one frame for each step, the last one held."""
    figure, axes = row_of_axes(len(paths), height=3.1)
    dots = []
    for ax, (method, path) in zip(axes, paths.items(), strict=True):
        show_map(ax, reward(plane()), LABELS[method], alpha=0.85)
        dots.append(
            ax.scatter(*path[0].T, s=7, color="#FFE119", edgecolors="black", linewidths=0.3)
        )
    last = max(map(len, paths.values())) - 1
    first = len(next(iter(paths.values()))) - 1  # steps of the panel that is labelled

    def frame(step: int) -> None:
        step = min(step, last)
        for dot, path in zip(dots, paths.values(), strict=True):
            dot.set_offsets(path[min(step, len(path) - 1)])
        axes[0].set_xlabel(f"$a_{{{max(first - step, 0)}}}$")

    FuncAnimation(figure, frame, frames=last + 5).save(file, PillowWriter(fps=3), dpi=80)
