"""QVPO for the recipes: `make_qvpo(cfg, env, device) -> Agent`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from agents.diffusion import Candidates, DiffusionSettings, make_steps, policy_builder
from torchrl_aca.baselines import DiffusionPolicy, QVPOLoss
from torchrl_aca.baselines.qvpo import entropy_coefficient
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Count, NonNegative


class QVPOSettings(DiffusionSettings):
    """The section `qvpo`."""

    num_candidates: Candidates
    num_target_candidates: Candidates
    weight: Literal["advantage", "cutoff"]
    num_uniform: Annotated[int, Field(ge=0, le=10**4)]
    first_entropy_coefficient: NonNegative | None
    entropy_coefficient: NonNegative
    entropy_coefficient_end: NonNegative
    entropy_updates: Count

    @model_validator(mode="after")
    def _candidates(self) -> QVPOSettings:
        if self.weight == "advantage" and self.num_candidates < 2:
            self.refuse("num_candidates", "at least 2, as one has no advantage over itself")
        return self

    def coefficient(self, update: int) -> float:
        """Returns the weight of uniform actions at an update."""
        if update == 0 and self.first_entropy_coefficient is not None:
            return self.first_entropy_coefficient
        ends = self.entropy_coefficient, self.entropy_coefficient_end
        return entropy_coefficient(update, *ends, self.entropy_updates)


def make_qvpo_loss(cfg: Any, policy: DiffusionPolicy) -> QVPOLoss:
    """The loss of the policy and its critics."""
    settings = cfg.qvpo
    loss = QVPOLoss(
        policy,
        weight=settings.weight,
        num_uniform=settings.num_uniform,
        num_target_candidates=settings.num_target_candidates,
        reward_scale=settings.reward_scale,
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_qvpo(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """QVPO: a step of the critics, then one of the policy with the new critics."""
    settings = cfg.qvpo
    builder = policy_builder(cfg, settings, env, num_candidates=settings.num_candidates)
    loss = make_qvpo_loss(cfg, builder.build(device, compile_step=cfg.compile))
    keys = loss.tensor_keys

    def prepare_actor(batch: TensorDictBase) -> None:
        action, weight = loss.sample_policy_action(batch)
        batch[keys.policy_action], batch[keys.policy_weight] = action, weight

    steps = make_steps(cfg, loss, prepare_actor)

    def update(batch: TensorDictBase) -> TensorDictBase:
        updates = steps.progress.updates
        metrics = steps.critics(batch)
        if updates % settings.actor_interval == 0:
            loss.entropy_coefficient.fill_(settings.coefficient(updates))
            metrics.update(steps.actor(batch))
        if updates % settings.target_interval == 0:
            steps.targets(batch)
        steps.progress.updates += 1
        return metrics

    return Agent(loss.average_actor_network, update, state=steps.state, policy_builder=builder)
