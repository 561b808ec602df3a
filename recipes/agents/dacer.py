"""DACER for the recipes: `make_dacer(cfg, env, device) -> Agent`."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field, model_validator
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from agents.diffusion import DiffusionOptim, DiffusionSettings, make_steps, policy_builder
from torchrl_aca.baselines import DACERLoss, DiffusionPolicy
from torchrl_aca.training.acceleration import descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Count, NonNegative, Positive
from torchrl_aca.training.policy import PolicyBuilder


class DACERSettings(DiffusionSettings):
    """The section `dacer`."""

    exploration_noise: NonNegative
    alpha_init: Positive
    alpha_interval: Count
    target_entropy_scale: float
    num_entropy_samples: Annotated[int, Field(ge=1, le=10**5)]
    num_components: Annotated[int, Field(ge=1, le=1000)]

    @model_validator(mode="after")
    def _samples(self) -> DACERSettings:
        if self.num_entropy_samples < self.num_components:
            expected = f"at least dacer.num_components ({self.num_components})"
            self.refuse("num_entropy_samples", expected)
        return self


class DACEROptim(DiffusionOptim):
    """The section `optim` of DACER."""

    alpha_lr: Positive


def dacer_policy(cfg: Any, env: EnvBase) -> PolicyBuilder:
    """The policy, with critics that tell mean and standard deviation."""
    settings = cfg.dacer
    return policy_builder(
        cfg,
        settings,
        env,
        critic={"num_outputs": 2},
        exploration_noise=settings.exploration_noise,
        alpha_init=settings.alpha_init,
        clip_action=True,
    )


def make_dacer_loss(cfg: Any, policy: DiffusionPolicy) -> DACERLoss:
    """The loss of the critics and of the policy that climbs them."""
    settings = cfg.dacer
    loss = DACERLoss(
        policy,
        target_entropy_scale=settings.target_entropy_scale,
        num_entropy_samples=settings.num_entropy_samples,
        num_components=settings.num_components,
        scale_tau=cfg.optim.tau,
        reward_scale=settings.reward_scale,
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_dacer(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """DACER, in its authors' order: the policy climbs the critics as they were before."""
    settings, builder = cfg.dacer, dacer_policy(cfg, env)
    loss = make_dacer_loss(cfg, builder.build(device, compile_step=cfg.compile))
    steps = make_steps(cfg, loss)
    alpha_optimizer = make_adam([loss.log_alpha], cfg.optim.alpha_lr, cfg.cudagraphs)

    # So rare that a graph of it would not pay.
    def alpha_step(batch: TensorDictBase) -> TensorDictBase:
        return descend(loss.alpha_loss(batch), "loss_alpha", alpha_optimizer)

    def update(batch: TensorDictBase) -> TensorDictBase:
        updates, metrics = steps.progress.updates, batch.empty()
        if updates % settings.actor_interval == 0:
            metrics = steps.actor(batch)
        metrics = steps.critics(batch).update(metrics)
        loss.step_scale()
        if updates % settings.target_interval == 0:
            steps.targets(batch)
        if updates % settings.alpha_interval == 0:
            metrics.update(alpha_step(batch))
        steps.progress.updates += 1
        return metrics

    state = {**steps.state, "alpha_optimizer": alpha_optimizer}
    return Agent(loss.actor_network, update, state=state, policy_builder=builder)
