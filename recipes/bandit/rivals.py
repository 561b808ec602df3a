"""The diffusion policies that the bandit study compares ACA with: one trained network each."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.objectives import SoftUpdate

from bandit.collect import make_collector
from bandit.config import BanditConfig
from torchrl_aca.baselines import (
    DACERLoss,
    DiffusionPolicy,
    DiffusionPolicyLoss,
    DIPOLoss,
    NoiseNetwork,
    QSMLoss,
    SDACLoss,
    TwinCritic,
)
from torchrl_aca.replay import make_replay_buffer, transitions, write_back
from torchrl_aca.training.acceleration import descend, make_adam
from torchrl_aca.training.randomness import seed_everything

LOSSES: dict[str, type[DiffusionPolicyLoss]] = {
    "sdac": SDACLoss,
    "qsm": QSMLoss,
    "dacer": DACERLoss,
    "dipo": DIPOLoss,
}


def make_loss(cfg: BanditConfig, method: str) -> DiffusionPolicyLoss:
    """The method's policy on fresh networks, its critic, and its loss.

    Actions are in the modes' own units; what other tasks clip to [-1, 1] is clipped to the box of
    the random actions, or not at all.
    """
    settings, num_steps = cfg.rivals[method], cfg.chain.num_steps
    clip = settings.clip_denoised
    chain: dict[str, Any] = {"clip_denoised": clip}
    if method == "qsm":  # its authors' chain
        chain = {"clip_denoised": False, "clip_step": clip, "variance": "beta"}
    policy = DiffusionPolicy(
        NoiseNetwork(1, 2, num_steps=num_steps, num_cells=settings.num_cells),
        cfg.chain.make_schedule(settings.schedule),
        critic=TwinCritic(
            1,
            2,
            num_critics=cfg.critic.num_critics,
            num_outputs=2 if method == "dacer" else 1,
            num_cells=cfg.critic.num_cells,
        ),
        exploration_noise=settings.exploration_noise,
        deterministic_draws="fresh",
        **chain,
    )
    return LOSSES[method](policy, reward_scale=1.0, **settings.loss, **settings.chosen)


def train(cfg: BanditConfig, method: str, seed: int) -> DiffusionPolicy:
    """Trains critic and policy on random actions, or on those that the policy draws itself."""
    seed_everything(seed)
    settings, collection = cfg.rivals[method], cfg.collector
    loss = make_loss(cfg, method)
    target_update = SoftUpdate(loss, tau=settings.tau)
    networks = {"loss_qvalue": loss.qvalue_network, "loss_actor": loss.policy_network}
    rates = {"loss_qvalue": cfg.optim.lr, "loss_actor": settings.lr}
    optimizers = {
        name: make_adam(network.parameters(), rates[name], cudagraphs=False)
        for name, network in networks.items()
    }
    num_updates = collection.frames // collection.frames_per_batch * settings.updates_per_batch
    schedulers = [
        torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_updates)
        for optimizer in optimizers.values()
    ]
    best = {"best_action": "action"} if method == "dipo" else {}
    buffer = make_replay_buffer(collection.frames, cfg.optim.batch_size)

    collector = make_collector(cfg, loss.actor_network)
    for data in collector:
        buffer.extend(transitions(data, rewritten=best))
        for update in range(settings.updates_per_batch):
            batch = buffer.sample()
            batch["next_action"] = batch["action"]  # the last step needs none: spare the chain
            descend(loss.qvalue_loss(batch), "loss_qvalue", optimizers["loss_qvalue"])
            if isinstance(loss, DACERLoss):
                loss.step_scale()
            if isinstance(loss, DIPOLoss):
                batch["best_action"] = loss.improve(batch)
                write_back(buffer, batch, best)
            if update % settings.actor_interval == 0:
                descend(loss.actor_loss(batch), "loss_actor", optimizers["loss_actor"])
                target_update.step()
            for scheduler in schedulers:
                scheduler.step()
    collector.shutdown()
    return loss.average_actor_network if isinstance(loss, SDACLoss) else loss.actor_network
