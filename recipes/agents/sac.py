"""SAC for the recipes, through TorchRL's loss: `make_sac(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from pydantic import model_validator
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_aca.baselines import make_gaussian_policy, make_mlp
from torchrl_aca.training.acceleration import capture, compiled, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Optim, Positive, Section, Widths
from torchrl_aca.training.policy import PolicyBuilder


class SACSettings(Section):
    """The section `sac`."""

    num_cells: Widths
    activation: str
    alpha_init: Positive
    log_std_min: float
    log_std_max: float
    target_entropy_scale: float
    reward_scale: Positive

    @model_validator(mode="after")
    def _names(self) -> SACSettings:
        kind = getattr(nn, self.activation, None)
        if not (isinstance(kind, type) and issubclass(kind, nn.Module)):
            self.refuse("activation", "the name of an activation in torch.nn, such as ReLU")
        if self.log_std_max < self.log_std_min:
            self.refuse("log_std_max", f"at least sac.log_std_min ({self.log_std_min})")
        return self


class SACOptim(Optim):
    """The section `optim` of SAC."""

    lr: Positive


def make_sac(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """SAC with a tanh-squashed Gaussian, two critics and a learned temperature."""
    settings = cfg.sac
    mlp = {"num_cells": settings.num_cells, "activation": settings.activation}
    bounds = {"log_std_min": settings.log_std_min, "log_std_max": settings.log_std_max}
    builder = PolicyBuilder.of(env, make_gaussian_policy, **mlp, **bounds)
    policy, action_dim = builder.build(device), builder.spec.shape[-1]
    critic = ValueOperator(
        make_mlp(builder.observation_dim + action_dim, 1, **mlp, device=device),
        in_keys=["observation", "action"],
    )
    loss = SACLoss(
        policy,
        critic,
        num_qvalue_nets=2,
        loss_function="l2",
        alpha_init=settings.alpha_init,
        # The policy's density is of actions in env units; the target is meant for [-1, 1].
        target_entropy=-settings.target_entropy_scale * action_dim + log_half_range(builder.spec),
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    target_update = SoftUpdate(loss, tau=cfg.optim.tau)
    optimizer = make_adam(loss.parameters(), cfg.optim.lr, cfg.cudagraphs)
    evaluate_loss = compiled(loss, cfg.compile)

    @partial(capture, enabled=cfg.cudagraphs)
    def update(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        batch["next", "reward"] = settings.reward_scale * batch["next", "reward"]
        losses = evaluate_loss(batch)
        # The actor's loss sees the critics' values but not their parameters, so one backward pass
        # through the sum gives each part its own gradient.
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
        return losses.detach()

    state = {"loss": loss, "optimizer": optimizer}
    return Agent(policy, update, state, policy_builder=builder)


def log_half_range(action_spec: Bounded) -> float:
    """Returns what the entropy in env units is above that of the same actions in [-1, 1]."""
    return ((action_spec.space.high - action_spec.space.low) / 2).log().sum().item()
