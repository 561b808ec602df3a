"""The samplers that a critic guides in the bandit study: trained, drawn from, measured."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ValueOperator

from bandit.collect import make_collector
from bandit.config import BanditConfig
from bandit.env import mode_shares, reward
from bandit.tables import Row
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic
from torchrl_aca.baselines import DiffusionPolicy
from torchrl_aca.langevin_actor import AnnealedLangevinActor
from torchrl_aca.replay import make_replay_buffer, transitions
from torchrl_aca.schedule import VarianceExplodingSchedule
from torchrl_aca.training.acceleration import make_adam
from torchrl_aca.training.randomness import seed_everything

Actor = CriticGuidedDenoisingActor | DiffusionPolicy


def make_actor(cfg: BanditConfig, method: str) -> CriticGuidedDenoisingActor:
    """The method's sampler on a fresh critic of its own."""
    chain, num_cells = cfg.chain, cfg.critic.num_cells
    if method == "nclql":
        return make_nclql(cfg)
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


def make_nclql(cfg: BanditConfig) -> AnnealedLangevinActor:
    """NC-LQL's sampler with its own noise and steps, in the box of the random actions."""
    chain, half_width = cfg.chain, cfg.collector.half_width
    num_steps = chain.num_steps - 1  # its chain visits level 0 too
    critic = NoiseLevelCritic(
        1,
        2,
        num_steps=num_steps,
        num_critics=cfg.critic.num_critics,
        num_cells=cfg.critic.num_cells,
    )
    return AnnealedLangevinActor(
        critic,
        VarianceExplodingSchedule(num_steps),
        spec=Bounded(-half_width, half_width, shape=(2,)),
        guidance_weight=cfg.collector.guidance_weight["nclql"],
        normalize_gradient=chain.normalize_gradient,
        deterministic_draws="fresh",
    )


def train(
    cfg: BanditConfig,
    method: str,
    seed: int,
    after_update: Callable[[ACALoss, TensorDictBase, int], None] = lambda *_: None,
    **settings: Any,
) -> CriticGuidedDenoisingActor:
    """Trains the method's critic on random actions, or on those that the method draws itself.

    Args:
        cfg: The study's settings.
        method: One of the samplers.
        seed: Of the training.
        after_update: Called with the loss, the batch and the number of updates before it.
        settings: More arguments of the loss.
    """
    seed_everything(seed)
    actor, collection = make_actor(cfg, method), cfg.collector
    # Every episode ends with its first step, so the target is the reward and nothing bootstraps.
    loss = ACALoss(actor, delay_qvalue=False, **{"reward_scale": 1.0, **settings})
    optimizer = make_adam(actor.critic.parameters(), cfg.optim.lr, cudagraphs=False)
    num_updates = collection.frames // collection.frames_per_batch * cfg.optim.updates_per_batch
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_updates)
    buffer = make_replay_buffer(collection.frames, cfg.optim.batch_size)
    updates = itertools.count()
    collector = make_collector(cfg, actor)
    for data in collector:
        buffer.extend(transitions(data))
        for _ in range(cfg.optim.updates_per_batch):
            batch = buffer.sample()
            batch["next_action"] = batch["action"]  # the last step needs none: spare the chain
            objective = loss.qvalue_loss(batch)["loss_qvalue"]
            if method in ("aca", "nclql"):
                objective = objective + loss.noise_level_loss(batch)["loss_noise_level"]
            optimizer.zero_grad()
            objective.backward()
            optimizer.step()
            scheduler.step()
            after_update(loss, batch, next(updates))
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
