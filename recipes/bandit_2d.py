"""The paper's 2D bandit study: ways to draw actions from a critic or a policy, on eight modes.

    python recipes/bandit_2d.py
    python recipes/bandit_2d.py methods=all
    python recipes/bandit_2d.py data=uniform seeds=[0]
    python recipes/bandit_2d.py --config-name bandit_2d_ablation

- aca (Diffusion-Q_t): denoising, guided by a critic that knows the noise level;
- diffusion_q: the same chain, guided by a plain critic Q(s, a);
- langevin_q: Langevin steps along the plain critic's gradient;
- nclql: annealed Langevin steps along a critic that knows the noise level;
- sdac, qsm, dacer, dipo: diffusion policies that learn from the plain critic (bandit/rivals.py).

Actions are in the modes' own units, in which a_T ~ N(0, I) lies about their circle: the actors get
no spec, so that nothing is scaled. N = 1, and no exploration noise in what is measured: what counts
is the chain alone.
"""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from torchrl import logger as torchrl_logger
from tqdm import tqdm

from bandit import rivals, tables
from bandit.config import RIVALS, BanditConfig, variants
from bandit.figures import draw_figures
from bandit.guided import draw, measure, sweep, train
from bandit.launch import launch
from bandit.tables import Row

Task = tuple[BanditConfig, str, int]  # settings, method, training seed


def run(task: Task) -> tuple[list[Row], list[Row], bytes]:
    """Reported rows, the sweeps' rows, and the actor: as bytes, to leave a worker process."""
    cfg, method, seed = task
    torch.set_num_threads(cfg.num_threads)
    torchrl_logger.setLevel("WARNING")  # its notes about storages would break the progress bar
    if method in RIVALS:
        return run_rival(cfg, method, seed)
    actor = train(cfg, method, seed)
    reported, swept = [], []
    for changed in cfg.ablation.samplings():
        for name, value in changed.items():
            setattr(actor, name, value)
        label = {"method": method, "seed": seed, **changed}
        swept += [{**label, **row} for row in sweep(cfg, actor)]
        fresh = measure(draw(actor, cfg.report.num_samples))
        reported.append({**label, "weight": float(actor.guidance_weight), **fresh})
    return reported, swept, pickle.dumps(actor)


def run_rival(cfg: BanditConfig, method: str, seed: int) -> tuple[list[Row], list[Row], bytes]:
    """As `run`; the rewards choose a setting of a rival's training, so there is no sweep."""
    actor = rivals.train(cfg, method, seed)
    chosen = next(iter(cfg.rivals[method].chosen.values()), None)
    row = {"method": method, "seed": seed, "weight": chosen}
    return [{**row, **measure(draw(actor, cfg.report.num_samples))}], [], pickle.dumps(actor)


def run_all(
    tasks: Sequence[Task], num_workers: int
) -> Iterator[tuple[list[Row], list[Row], bytes]]:
    """Yields the results of all tasks in order, behind a progress bar."""
    bar = partial(tqdm, total=len(tasks), unit="run", desc="train, sweep, sample")
    if num_workers == 1:
        yield from bar(map(run, tasks))
    else:
        with multiprocessing.get_context("spawn").Pool(num_workers) as pool:
            yield from bar(pool.imap(run, tasks))


def study(cfg: BanditConfig, run_dir: Path) -> None:
    """Runs what the configuration asks for: all methods as they are, or an ablation of them."""
    (ablate if cfg.ablation.wanted() else compare)(cfg, run_dir)


def compare(cfg: BanditConfig, run_dir: Path) -> None:
    """Runs all methods and seeds; writes the tables and, where asked for, the figures."""
    tasks = [(cfg, method, seed) for method in cfg.methods for seed in cfg.seeds]
    reported, swept, actors = [], [], {}
    for (_, method, _), (rows, sweep_rows, actor) in zip(
        tasks, run_all(tasks, cfg.num_workers), strict=True
    ):
        reported += rows
        swept += sweep_rows
        actors.setdefault(method, pickle.loads(actor))
        tables.write_csv(run_dir / "seeds.csv", reported)  # as they come: they take minutes each
    table = tables.summary(reported)
    for name, rows in (("sweep", swept), ("table", table)):
        if rows:
            tables.write_csv(run_dir / f"{name}.csv", rows)
    print(tables.as_text(table))
    if cfg.figures:
        draw_figures(run_dir, actors, reported, swept)


def ablate(cfg: BanditConfig, run_dir: Path) -> None:
    """One row for each combination of the ablation's values, each method and each seed."""
    pairs = list(product(cfg.methods, cfg.seeds))
    tasks = [(variant, *pair) for _, variant in variants(cfg) for pair in pairs]
    settings = [changed for changed, _ in variants(cfg) for _ in pairs]
    table = []
    for changed, (rows, *_) in zip(settings, run_all(tasks, cfg.num_workers), strict=True):
        table += [{**changed, **row} for row in rows]
        tables.write_csv(run_dir / "ablation.csv", table)
    compact = tables.side_by_side(table, [*cfg.ablation.training, *cfg.ablation.samplings()[0]])
    tables.write_csv(run_dir / "ablation_table.csv", compact)
    print(tables.as_text(compact))


@hydra.main(version_base="1.3", config_path="configs", config_name="bandit_2d")
def main(composed: DictConfig) -> None:
    """Runs the study or its ablation."""
    launch(composed, BanditConfig, "bandit_2d", study)


if __name__ == "__main__":
    main()
