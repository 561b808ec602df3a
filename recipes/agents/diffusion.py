"""What the diffusion-policy baselines share: settings, policy, and the steps of an update."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import Field
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from agents.learning_rate import DecayOptim, linear_decay
from torchrl_aca.baselines import DiffusionPolicyLoss, make_diffusion_policy
from torchrl_aca.training.acceleration import Step, capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Stateful
from torchrl_aca.training.checkpoint import Counters
from torchrl_aca.training.config import (
    Activation,
    Count,
    NonNegative,
    Positive,
    Section,
    Widths,
)
from torchrl_aca.training.policy import PolicyBuilder

Candidates = Annotated[int, Field(ge=1, le=10**5)]


class DiffusionSettings(Section):
    """What the section of every diffusion-policy baseline has."""

    num_steps: Annotated[int, Field(ge=1, le=1000)]
    schedule: Literal["cosine", "linear", "vp"]
    linear_scale: Annotated[float, Field(gt=0, le=1)]
    initial_scale: Positive
    num_cells: Widths
    activation: Activation
    reward_scale: Positive
    actor_interval: Count
    target_interval: Count


class DiffusionOptim(DecayOptim):
    """The section `optim` of the diffusion-policy baselines; the policy's rate decays."""

    actor_lr: Positive
    actor_lr_end: NonNegative


def policy_builder(
    cfg: Any, settings: DiffusionSettings, env: EnvBase, **more: Any
) -> PolicyBuilder:
    """How the policy, its network and its critics are built.

    Args:
        cfg: The whole configuration.
        settings: The method's own section.
        env: Tells sizes and bounds.
        more: Other keywords of `make_diffusion_policy`.
    """
    shared = {
        "num_steps": settings.num_steps,
        "schedule": settings.schedule,
        "linear_scale": settings.linear_scale,
        "num_cells": settings.num_cells,
        "activation": settings.activation,
        "initial_scale": settings.initial_scale,
        "deterministic_draws": cfg.eval.draws,
    }
    return PolicyBuilder.of(env, make_diffusion_policy, **{**shared, **more})


@dataclass
class Steps:
    """The steps that an update is made of; each takes a batch and returns detached metrics.

    The critics' and the policy's are functions of the batch alone, so that each can be captured as
    a CUDA graph; what changes from update to update, which of them to take and the learning rate,
    stays outside.

    Attributes:
        critics: A step down the TD loss.
        actor: A step down the policy's loss, and of its learning rate's decay.
        targets: Moves all targets.
        progress: Counts updates.
        state: What a checkpoint holds of them.
    """

    critics: Step
    actor: Step
    targets: Step
    progress: Counters
    state: dict[str, Stateful]


def make_steps(
    cfg: Any,
    loss: DiffusionPolicyLoss,
    prepare_actor: Callable[[TensorDictBase], object] | None = None,
) -> Steps:
    """Builds the steps of a loss, with an optimiser for the critics and one for the policy.

    Args:
        cfg: The whole configuration.
        loss: The method's loss, with its value estimator.
        prepare_actor: Writes to a batch the draws that the policy's loss needs of a chain. Chains
            compile their own steps, so they run before the compiled loss.
    """
    optim = cfg.optim
    target_update = SoftUpdate(loss, tau=optim.tau)
    optimizer = make_adam(loss.qvalue_network.parameters(), optim.lr, cfg.cudagraphs)
    actor_optimizer = make_adam(loss.policy_network.parameters(), optim.actor_lr, cfg.cudagraphs)
    scheduler = linear_decay(actor_optimizer, optim, optim.actor_lr, optim.actor_lr_end)
    qvalue_loss = compiled(loss.qvalue_loss, cfg.compile)
    actor_loss = compiled(loss.actor_loss, cfg.compile)

    @partial(capture, enabled=cfg.cudagraphs)
    def critics(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        batch[loss.tensor_keys.next_action] = loss.sample_next_action(batch)
        return descend(qvalue_loss(batch), "loss_qvalue", optimizer)

    @partial(capture, enabled=cfg.cudagraphs)
    def descend_actor(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        if prepare_actor is not None:
            prepare_actor(batch)
        return descend(actor_loss(batch), "loss_actor", actor_optimizer)

    def actor(batch: TensorDictBase) -> TensorDictBase:
        metrics = descend_actor(batch)
        scheduler.step()
        return metrics

    @partial(capture, enabled=cfg.cudagraphs)
    def targets(batch: TensorDictBase) -> None:
        target_update.step()

    progress = Counters()
    state = {
        "loss": loss,
        "optimizer": optimizer,
        "actor_optimizer": actor_optimizer,
        "scheduler": scheduler,
        "progress": progress,
    }
    return Steps(critics, actor, targets, progress, state)
