"""SDAC for the recipes: `make_sdac(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from agents.diffusion import (
    Candidates,
    DiffusionOptim,
    DiffusionSettings,
    make_steps,
    policy_builder,
)
from torchrl_aca.baselines import DiffusionPolicy, SDACLoss
from torchrl_aca.training.acceleration import capture, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Count, NonNegative, Positive
from torchrl_aca.training.policy import PolicyBuilder


class SDACSettings(DiffusionSettings):
    """The section `sdac`."""

    num_candidates: Candidates
    num_target_candidates: Candidates
    num_proposals: Candidates
    inverse_temperature: NonNegative
    exploration_noise: NonNegative
    alpha_init: Positive
    alpha_interval: Count
    target_entropy_scale: float


class SDACOptim(DiffusionOptim):
    """The section `optim` of SDAC."""

    alpha_lr: Positive


def sdac_policy(cfg: Any, env: EnvBase) -> PolicyBuilder:
    """The policy, whose exploration noise follows the temperature."""
    settings = cfg.sdac
    return policy_builder(
        cfg,
        settings,
        env,
        num_candidates=settings.num_candidates,
        exploration_noise=settings.exploration_noise,
        alpha_init=settings.alpha_init,
    )


def make_sdac_loss(cfg: Any, policy: DiffusionPolicy) -> SDACLoss:
    """The loss of the policy and its critics."""
    settings = cfg.sdac
    loss = SDACLoss(
        policy,
        num_proposals=settings.num_proposals,
        inverse_temperature=settings.inverse_temperature,
        target_entropy_scale=settings.target_entropy_scale,
        num_target_candidates=settings.num_target_candidates,
        reward_scale=settings.reward_scale,
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_sdac(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """SDAC, in its authors' order: the policy learns from the critics as they were before."""
    settings, builder = cfg.sdac, sdac_policy(cfg, env)
    loss = make_sdac_loss(cfg, builder.build(device, compile_step=cfg.compile))
    keys = loss.tensor_keys

    def prepare_actor(batch: TensorDictBase) -> None:
        batch[keys.policy_action] = loss.sample_policy_action(batch)

    steps = make_steps(cfg, loss, prepare_actor)
    alpha_optimizer = make_adam([loss.log_alpha], cfg.optim.alpha_lr, cfg.cudagraphs)

    @partial(capture, enabled=cfg.cudagraphs)
    def alpha_step(batch: TensorDictBase) -> TensorDictBase:
        return descend(loss.alpha_loss(), "loss_alpha", alpha_optimizer)

    def update(batch: TensorDictBase) -> TensorDictBase:
        updates, metrics = steps.progress.updates, batch.empty()
        if updates % settings.actor_interval == 0:
            metrics = steps.actor(batch)
        metrics = steps.critics(batch).update(metrics)
        if updates % settings.target_interval == 0:
            steps.targets(batch)
        if updates % settings.alpha_interval == 0:
            metrics.update(alpha_step(batch))
        steps.progress.updates += 1
        return metrics

    state = {**steps.state, "alpha_optimizer": alpha_optimizer}
    return Agent(loss.average_actor_network, update, state=state, policy_builder=builder)
