"""SAC for the recipes, through TorchRL's loss: `make_sac(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from pydantic import model_validator
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator
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
    settings, optim = cfg.sac, cfg.optim
    mlp = {"num_cells": settings.num_cells, "activation": settings.activation}
    density = {
        "log_std_min": settings.log_std_min,
        "log_std_max": settings.log_std_max,
        "squash_correction": settings.squash_correction,
    }
    builder = PolicyBuilder.of(env, make_gaussian_policy, **mlp, **density)
    policy, action_dim = builder.build(device), builder.spec.shape[-1]
    num_in = builder.observation_dim + action_dim
    critics = [
        ValueOperator(make_mlp(num_in, 1, **mlp, device=device), in_keys=["observation", "action"])
        for _ in range(2)
    ]
    target_entropy = -settings.target_entropy_scale * action_dim
    if settings.squash_correction:  # the density is of actions in env units; the target is not
        target_entropy += log_half_range(builder.spec)
    loss = SACLoss(
        policy,
        critics,
        loss_function="l2",
        alpha_init=settings.alpha_init,
        target_entropy=target_entropy,
    ).to(device)
    loss.make_value_estimator(gamma=optim.gamma)
    target_update = SoftUpdate(loss, tau=optim.tau)
    policy_params = [*loss.actor_network_params.parameters(), loss.log_alpha]
    optimizer = make_adam(loss.qvalue_network_params.parameters(), optim.lr, cfg.cudagraphs)
    actor_optimizer = make_adam(policy_params, optim.lr, cfg.cudagraphs)

    @partial(compiled, enabled=cfg.compile)
    def qvalue_loss(batch: TensorDictBase) -> TensorDict:
        return TensorDict(loss_qvalue=loss.qvalue_v2_loss(batch)[0])

    @partial(compiled, enabled=cfg.compile)
    def policy_loss(batch: TensorDictBase) -> TensorDict:
        loss_actor, metadata = loss.actor_loss(batch)
        log_prob = metadata["log_prob"]
        loss_alpha = loss.alpha_loss(log_prob).mean()
        alpha = loss.log_alpha.detach().exp()
        return TensorDict(
            loss_policy=loss_actor + loss_alpha,  # one of the actor, one of log alpha
            loss_actor=loss_actor,
            loss_alpha=loss_alpha,
            alpha=alpha,
            entropy=-log_prob.mean(),
        )

    @partial(capture, enabled=cfg.cudagraphs)
    def update(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        batch["next", "reward"] = settings.reward_scale * batch["next", "reward"]
        metrics = descend(qvalue_loss(batch), "loss_qvalue", optimizer)
        target_update.step()
        metrics.update(descend(policy_loss(batch), "loss_policy", actor_optimizer))
        return metrics.exclude("loss_policy")

    state = {"loss": loss, "optimizer": optimizer, "actor_optimizer": actor_optimizer}
    return Agent(policy, update, state, policy_builder=builder)


def log_half_range(action_spec: Bounded) -> float:
    """Returns what the entropy in env units is above that of the same actions in [-1, 1]."""
    return ((action_spec.space.high - action_spec.space.low) / 2).log().sum().item()
