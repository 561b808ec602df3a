"""IQL for the recipes: no action that is not in the data is evaluated."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate

from agents.ensemble import (
    EnsembleSettings,
    actor_mlp,
    initialised,
    make_critics,
    policy_builder,
)
from torchrl_aca.baselines import EnsembleIQLLoss, make_clipped_gaussian_policy, make_mlp
from torchrl_aca.training.acceleration import capture, compiled, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Optim, Positive
from torchrl_aca.training.policy import PolicyBuilder


class IQLSettings(EnsembleSettings):
    """The section `iql`."""

    section: ClassVar[str] = "iql"

    actor_last_hidden_gain: Positive
    expectile: Annotated[float, Field(gt=0, lt=1)]
    temperature: Positive
    max_weight: Positive


class IQLOptim(Optim):
    """The section `optim` of IQL."""

    lr: Positive


def make_iql(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """IQL; an update is a step of value, critics and actor on one batch, in both phases.

    The three losses have no parameter in common, so one backward pass through their sum gives each
    part its own gradient, all from the parameters before the step, as in WSRL's code.
    """
    builder = policy_builder(cfg.iql, env, make_clipped_gaussian_policy)
    loss = make_iql_loss(cfg, builder, env, device)
    target_update = SoftUpdate(loss, tau=cfg.optim.tau)
    optimizer = make_adam(loss.parameters(), cfg.optim.lr, cfg.cudagraphs)
    evaluate_loss = compiled(loss, cfg.compile)

    @partial(capture, enabled=cfg.cudagraphs)
    def update(batch: TensorDictBase) -> TensorDictBase:
        losses = evaluate_loss(batch.copy())
        (losses["loss_value"] + losses["loss_qvalue"] + losses["loss_actor"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
        return losses.detach()

    state = {"loss": loss, "optimizer": optimizer}
    return Agent(loss.actor_network, update, state, offline_update=update, policy_builder=builder)


def make_iql_loss(
    cfg: Any, builder: PolicyBuilder, env: EnvBase, device: torch.device
) -> EnsembleIQLLoss:
    """The policy, the critics, the state value and their loss."""
    settings = cfg.iql
    policy = initialised(builder.build(device), settings, settings.actor_last_hidden_gain)
    value = make_mlp(builder.observation_dim, 1, **actor_mlp(settings), device=device)
    value = initialised(value, settings)
    loss = EnsembleIQLLoss(
        policy,
        make_critics(settings, env, device),
        ValueOperator(value, in_keys=["observation"]),
        expectile=settings.expectile,
        temperature=settings.temperature,
        max_weight=settings.max_weight,
        subset_size=settings.subset_size,
        subset_with_replacement=settings.subset_with_replacement,
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss
