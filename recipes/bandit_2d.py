"""The paper's 2D bandit study: ways to draw actions from a critic or a policy, on eight modes.

    python recipes/bandit_2d.py
    python recipes/bandit_2d.py methods=all
    python recipes/bandit_2d.py data=uniform seeds=[0]
    python recipes/bandit_2d.py --config-name bandit_2d_ablation

- aca (Diffusion-Q_t): denoising, guided by a critic that knows the noise level;
- diffusion_q: the same chain, guided by a plain critic Q(s, a);
- langevin_q: Langevin steps along the plain critic's gradient;
- sdac, qsm, dacer, dipo: diffusion policies that learn from the plain critic (bandit/rivals.py).

Actions are in the modes' own units, in which a_T ~ N(0, I) lies about their circle: the actors get
no spec, so that nothing is scaled. N = 1, and no exploration noise in what is measured: what counts
is the chain alone.
"""

from __future__ import annotations

import multiprocessing
import pickle
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl import logger as torchrl_logger
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ValueOperator
from tqdm import tqdm

from bandit import rivals, tables
from bandit.collect import make_collector
from bandit.config import RIVALS, BanditConfig, variants
from bandit.env import mode_shares, reward
from bandit.figures import draw_figures
from bandit.tables import Row
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic
from torchrl_aca.baselines import DiffusionPolicy
from torchrl_aca.errors import RunError
from torchrl_aca.replay import make_replay_buffer, transitions
from torchrl_aca.training.config import checked
from torchrl_aca.training.randomness import seed_everything
from torchrl_aca.training.report import versions
from torchrl_aca.training.run_dir import make_run_dir

Task = tuple[BanditConfig, str, int]  # settings, method, training seed
Actor = CriticGuidedDenoisingActor | DiffusionPolicy


def make_actor(cfg: BanditConfig, method: str) -> CriticGuidedDenoisingActor:
    """The method's sampler on a fresh critic of its own."""
    chain, num_cells = cfg.chain, cfg.critic.num_cells
    if method == "aca":
        critic = NoiseLevelCritic(
            1, 2, num_steps=chain.num_steps, num_critics=cfg.critic.num_critics, num_cells=num_cells
        )
    else:  # a value network that reads no noise level
        critic = ValueOperator(
            MLP(3, cfg.critic.num_critics, num_cells=num_cells, activation_class=torch.nn.Mish),
            in_keys=["observation", "action"],
        )
    return CriticGuidedDenoisingActor(
        critic,
        chain.make_schedule(chain.schedule),
        action_dim=2,
        guidance_weight=cfg.collector.guidance_weight[method],
        num_candidates=1,
        normalize_gradient=chain.normalize_gradient,
        clip_denoised=chain.clip_denoised,
        sampler="langevin" if method == "langevin_q" else "denoising",
        langevin_step_size=chain.langevin_step_size,
        exploration_noise=0.0,
        deterministic_draws="fresh",
    )


def train(cfg: BanditConfig, method: str, seed: int) -> CriticGuidedDenoisingActor:
    """Trains the method's critic on random actions, or on those that the method draws itself."""
    seed_everything(seed)
    actor, collection = make_actor(cfg, method), cfg.collector
    # Every episode ends with its first step, so the target is the reward and nothing bootstraps.
    loss = ACALoss(actor, reward_scale=1.0, delay_qvalue=False)
    optimizer = torch.optim.Adam(actor.critic.parameters(), lr=cfg.optim.lr)
    num_updates = collection.frames // collection.frames_per_batch * cfg.optim.updates_per_batch
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_updates)
    buffer = make_replay_buffer(collection.frames, cfg.optim.batch_size)
    collector = make_collector(cfg, actor)
    for data in collector:
        buffer.extend(transitions(data))
        for _ in range(cfg.optim.updates_per_batch):
            batch = buffer.sample()
            batch["next_action"] = batch["action"]  # the last step needs none: spare the chain
            objective = loss.qvalue_loss(batch)["loss_qvalue"]
            if method == "aca":
                objective = objective + loss.noise_level_loss(batch)["loss_noise_level"]
            optimizer.zero_grad()
            objective.backward()
            optimizer.step()
            scheduler.step()
    collector.shutdown()
    return actor


@torch.no_grad()
def draw(actor: Actor, num_samples: int) -> torch.Tensor:
    """Samples of shape (num_samples, 2), from fresh chains without exploration noise."""
    states = TensorDict({"observation": torch.zeros(num_samples, 1)}, batch_size=[num_samples])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return actor(states)["action"]


def measure(actions: torch.Tensor) -> Row:
    """The numbers of the paper's table, and the rewards' mean and standard deviation."""
    shares, rewards = mode_shares(actions), reward(actions)
    moments = {"reward_mean": rewards.mean().item(), "reward_std": rewards.std().item()}
    return {**shares, "sum": sum(shares.values()), **moments}


def sweep(cfg: BanditConfig, actor: CriticGuidedDenoisingActor) -> list[Row]:
    """Measures every guidance weight, and leaves the actor with the most rewarding one."""
    rows = []
    for weight in cfg.sweep.weights:
        actor.guidance_weight = weight
        rows.append({"weight": weight, **measure(draw(actor, cfg.sweep.num_samples))})
    actor.guidance_weight = max(rows, key=lambda row: row["reward_mean"])["weight"]
    return rows


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
    """Runs all methods and seeds; writes the tables and, where asked for, the figures."""
    tasks = [(cfg, method, seed) for method in cfg.methods for seed in cfg.seeds]
    reported, swept, actors = [], [], {}
    for (_, method, _), (rows, sweep_rows, actor) in zip(
        tasks, run_all(tasks, cfg.num_workers), strict=True
    ):
        reported += rows
        swept += sweep_rows
        actors.setdefault(method, pickle.loads(actor))
    table = tables.summary(reported)
    for name, rows in (("seeds", reported), ("sweep", swept), ("table", table)):
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


def begin(cfg: BanditConfig) -> Path:
    """Makes the directory of this study alone, and writes its configuration there."""
    run_dir = make_run_dir(cfg.run_dir, "bandit_2d")
    try:
        with open(run_dir / "config.yaml", "x") as file:
            file.write(OmegaConf.to_yaml(OmegaConf.create(cfg.model_dump(exclude_unset=True))))
    except FileExistsError:
        raise RunError(
            f"run_dir={run_dir} already holds a study; expected a new directory. Give another one."
        ) from None
    return run_dir


@hydra.main(version_base="1.3", config_path="configs", config_name="bandit_2d")
def main(composed: DictConfig) -> None:
    """Runs the study or its ablation into a new directory; an error is told in one message."""
    try:
        cfg = checked(BanditConfig, composed)
        variants(cfg)  # for their mistakes
        run_dir = begin(cfg)
    except RunError as error:
        raise SystemExit(f"error: {error}") from None
    start, info = time.perf_counter(), versions()
    (ablate if cfg.ablation.training else study)(cfg, run_dir)
    minutes = round((time.perf_counter() - start) / 60, 1)
    command = " ".join(["python", *sys.argv])
    tables.write_card(run_dir, {"command": command, "wall-clock time": f"{minutes} min", **info})
    print(f"run directory: {run_dir}")


if __name__ == "__main__":
    main()
