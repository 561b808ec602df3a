"""SAC for the recipes, through TorchRL's loss: `make_sac(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from pydantic import model_validator
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_aca.baselines import make_gaussian_policy, make_mlp
from torchrl_aca.training.acceleration import capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Activation, Optim, Positive, Section, Widths
from torchrl_aca.training.policy import PolicyBuilder


class SACSettings(Section):
    """The section `sac`."""

    num_cells: Widths
    activation: Activation
    alpha_init: Positive
    log_std_min: float
    log_std_max: float
    squash_correction: bool
    target_entropy_scale: float
    reward_scale: Positive

    @model_validator(mode="after")
    def _bounds(self) -> SACSettings:
        if self.log_std_max < self.log_std_min:
            self.refuse("log_std_max", f"at least sac.log_std_min ({self.log_std_min})")
        return self


class SACOptim(Optim):
    """The section `optim` of SAC."""

    lr: Positive


def make_sac(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """SAC with a tanh-squashed Gaussian, two critics and a learned temperature."""
    builder = PolicyBuilder.of(
        env,
        make_gaussian_policy,
        **network_settings(cfg.sac),
        log_std_min=cfg.sac.log_std_min,
        log_std_max=cfg.sac.log_std_max,
        squash_correction=cfg.sac.squash_correction,
        rescaled=True,
    )
    policy, optim = builder.build(device), cfg.optim
    loss = make_loss(cfg, policy, builder, device)
    target_update = SoftUpdate(loss, tau=optim.tau)
    policy_params = [*loss.actor_network_params.parameters(), loss.log_alpha]
    optimizer = make_adam(loss.qvalue_network_params.parameters(), optim.lr, cfg.cudagraphs)
    actor_optimizer = make_adam(policy_params, optim.lr, cfg.cudagraphs)
    critics_loss = compiled(partial(qvalue_loss, loss), cfg.compile)
    actor_loss = compiled(partial(policy_loss, loss), cfg.compile)

    @partial(capture, enabled=cfg.cudagraphs)
    def update(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        batch["next", "reward"] = cfg.sac.reward_scale * batch["next", "reward"]
        metrics = descend(critics_loss(batch), "loss_qvalue", optimizer)
        target_update.step()
        metrics.update(descend(actor_loss(batch), "loss_policy", actor_optimizer))
        return metrics.exclude("loss_policy")

    state = {"loss": loss, "optimizer": optimizer, "actor_optimizer": actor_optimizer}
    return Agent(policy, update, state, policy_builder=builder)


def make_loss(
    cfg: Any, policy: ProbabilisticActor, builder: PolicyBuilder, device: torch.device
) -> SACLoss:
    """TorchRL's loss on the policy and two critics."""
    settings, action_dim = cfg.sac, builder.spec.shape[-1]
    num_in, mlp = builder.observation_dim + action_dim, network_settings(settings)
    critics = [
        ValueOperator(make_mlp(num_in, 1, **mlp, device=device), in_keys=["observation", "action"])
        for _ in range(2)
    ]
    loss = SACLoss(
        policy,
        critics,
        loss_function="l2",
        alpha_init=settings.alpha_init,
        target_entropy=-settings.target_entropy_scale * action_dim,
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def network_settings(settings: SACSettings) -> dict[str, Any]:
    """What actor and critics have in common: keywords of `make_mlp`."""
    return {"num_cells": settings.num_cells, "activation": settings.activation}


def qvalue_loss(loss: SACLoss, batch: TensorDictBase) -> TensorDict:
    """The critics' part of the loss."""
    return TensorDict(loss_qvalue=loss.qvalue_v2_loss(batch)[0])


def policy_loss(loss: SACLoss, batch: TensorDictBase) -> TensorDict:
    """The part of actor and temperature; no parameter is in both terms of `loss_policy`."""
    loss_actor, metadata = loss.actor_loss(batch)
    log_prob = metadata["log_prob"]
    loss_alpha = loss.alpha_loss(log_prob).mean()
    return TensorDict(
        loss_policy=loss_actor + loss_alpha,
        loss_actor=loss_actor,
        loss_alpha=loss_alpha,
        alpha=loss.log_alpha.detach().exp(),
        entropy=-log_prob.mean(),
    )
