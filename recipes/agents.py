"""The algorithms that `online_mujoco.py` can train: `make_<name>(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from gaussian_policy import make_gaussian_policy
from omegaconf import DictConfig
from rlpd import make_rlpd
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import Counters

SCHEDULES = {
    "cosine": NoiseSchedule.cosine,
    "linear": NoiseSchedule.linear,
    "vp": NoiseSchedule.vp,
}


def make_aca_loss(cfg: DictConfig, env: EnvBase, device: torch.device) -> ACALoss:
    """The critic, the actor that it guides, and their loss."""
    settings = cfg.aca
    schedule = SCHEDULES.get(settings.schedule)
    if schedule is None:
        raise ValueError(f"aca.schedule={settings.schedule}: expected one of {list(SCHEDULES)}.")
    action_spec = env.action_spec_unbatched
    critic = NoiseLevelCritic(
        env.observation_spec["observation"].shape[-1],
        action_spec.shape[-1],
        num_steps=settings.num_steps,
        num_critics=settings.num_critics,
        num_cells=list(settings.num_cells),
        first_level=settings.first_level,
        device=device,
    )
    actor = CriticGuidedDenoisingActor(
        critic,
        schedule(settings.num_steps),
        spec=action_spec,
        guidance_weight=settings.guidance_weight,
        num_candidates=settings.num_candidates,
        exploration_noise=settings.exploration_noise,
        alpha_init=settings.alpha_init,
        compile_step=cfg.compile,
    ).to(device)
    loss = ACALoss(
        actor,
        num_target_candidates=settings.num_target_candidates,
        noise_level_target=settings.noise_level_target,
        target_entropy_scale=settings.target_entropy_scale,
        reward_scale=settings.reward_scale,
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_aca(cfg: DictConfig, env: EnvBase, device: torch.device) -> Agent:
    """ACA, in the official code's order: a TD step, then at even updates a noise-level step."""
    settings, optim = cfg.aca, cfg.optim
    loss = make_aca_loss(cfg, env, device)
    target_update = SoftUpdate(loss, tau=optim.tau)
    optimizer = torch.optim.Adam(loss.qvalue_network.parameters(), lr=optim.lr)
    alpha_optimizer = torch.optim.Adam([loss.log_alpha], lr=optim.alpha_lr)
    # The decay counts steps of the optimiser, of which an update takes one or two.
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, partial(lr_factor, optim))
    progress = Counters()

    def step(losses: TensorDictBase, name: str, *steppers: Any) -> TensorDictBase:
        losses[name].backward()
        for stepper in steppers:
            stepper.step()
        loss.zero_grad()
        return losses.detach()

    def update(batch: TensorDictBase) -> TensorDictBase:
        metrics = step(loss.qvalue_loss(batch), "loss_qvalue", optimizer, scheduler)
        if progress.updates % settings.noise_level_interval == 0:
            losses = loss.noise_level_loss(batch)
            metrics.update(step(losses, "loss_noise_level", optimizer, scheduler))
        target_update.step()
        if progress.updates % settings.alpha_interval == 0:
            metrics.update(step(loss.alpha_loss(), "loss_alpha", alpha_optimizer))
        progress.updates += 1
        return metrics

    return Agent(
        loss.actor_network,
        update,
        state={
            "loss": loss,
            "optimizer": optimizer,
            "alpha_optimizer": alpha_optimizer,
            "scheduler": scheduler,
            "progress": progress,
        },
    )


def lr_factor(optim: DictConfig, step: int) -> float:
    """Returns the factor of `lr` after so many optimiser steps: linear decay to `lr_end`."""
    span = max(optim.lr_decay_end - optim.lr_decay_start, 1)
    progress = min(max((step - optim.lr_decay_start) / span, 0.0), 1.0)
    return 1 + progress * (optim.lr_end / optim.lr - 1)


def make_sac(cfg: DictConfig, env: EnvBase, device: torch.device) -> Agent:
    """SAC with a tanh-squashed Gaussian, two critics and a learned temperature."""
    settings = cfg.sac
    action_spec = env.action_spec_unbatched
    observation_dim = env.observation_spec["observation"].shape[-1]
    action_dim = action_spec.shape[-1]
    activation = getattr(nn, settings.activation, None)
    if activation is None:
        raise ValueError(f"sac.activation={settings.activation}: expected a class of torch.nn.")
    mlp = {"num_cells": list(settings.num_cells), "activation_class": activation, "device": device}
    policy = make_gaussian_policy(
        MLP(in_features=observation_dim, out_features=2 * action_dim, **mlp),
        action_spec,
        settings.log_std_min,
        settings.log_std_max,
        device,
    )
    critic = ValueOperator(
        MLP(in_features=observation_dim + action_dim, out_features=1, **mlp),
        in_keys=["observation", "action"],
    )
    loss = SACLoss(
        policy, critic, num_qvalue_nets=2, loss_function="l2", alpha_init=settings.alpha_init
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    target_update = SoftUpdate(loss, tau=cfg.optim.tau)
    optimizer = torch.optim.Adam(loss.parameters(), lr=cfg.optim.lr)
    evaluate_loss = torch.compile(loss) if cfg.compile else loss

    def update(batch: TensorDictBase) -> TensorDictBase:
        batch["next", "reward"] = settings.reward_scale * batch["next", "reward"]
        losses = evaluate_loss(batch)
        # The actor's loss sees the critics' values but not their parameters, so one backward pass
        # through the sum gives each part its own gradient.
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
        return losses.detach()

    return Agent(policy, update, state={"loss": loss, "optimizer": optimizer})


AGENTS = {"aca": make_aca, "rlpd": make_rlpd, "sac": make_sac}
