"""NC-LQL for the recipes: `make_nclql(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import torch
from pydantic import Field, model_validator
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from torchrl_aca import ACALoss
from torchrl_aca.langevin_actor import make_nclql_actor
from torchrl_aca.training.acceleration import capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import NonNegative, Optim, Positive, Section, Widths
from torchrl_aca.training.policy import PolicyBuilder


class NCLQLSettings(Section):
    """The section `nclql`."""

    num_steps: Annotated[int, Field(ge=1, le=1000)]
    steps_per_level: Annotated[int, Field(ge=1, le=1000)]
    sigma_min: Positive
    sigma_max: Positive
    step_size: Positive
    guidance_weight: NonNegative
    normalize_gradient: bool
    num_cells: Widths
    num_critics: Annotated[int, Field(ge=1, le=1000)]
    num_candidates: Annotated[int, Field(ge=1, le=10**5)]
    reward_scale: Positive

    @model_validator(mode="after")
    def _sigmas(self) -> NCLQLSettings:
        if self.sigma_max <= self.sigma_min:
            self.refuse("sigma_max", f"more than nclql.sigma_min ({self.sigma_min})")
        return self


class NCLQLOptim(Optim):
    """The section `optim` of NC-LQL."""

    lr: Positive


def nclql_policy(cfg: Any, env: EnvBase) -> PolicyBuilder:
    """The actor with the critic that it follows."""
    settings = cfg.nclql
    return PolicyBuilder.of(
        env,
        make_nclql_actor,
        num_steps=settings.num_steps,
        sigma_min=settings.sigma_min,
        sigma_max=settings.sigma_max,
        num_critics=settings.num_critics,
        num_cells=settings.num_cells,
        steps_per_level=settings.steps_per_level,
        step_size=settings.step_size,
        guidance_weight=settings.guidance_weight,
        normalize_gradient=settings.normalize_gradient,
        num_candidates=settings.num_candidates,
        deterministic_draws=cfg.eval.draws,
    )


def make_nclql(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """NC-LQL: in every update a TD step and a noise-level step, then a move of the targets."""
    builder = nclql_policy(cfg, env)
    actor = builder.build(device, compile_step=cfg.compile)
    loss = ACALoss(actor, noise_level_target="target", reward_scale=cfg.nclql.reward_scale)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    target_update = SoftUpdate(loss, tau=cfg.optim.tau)
    optimizer = make_adam(loss.qvalue_network.parameters(), cfg.optim.lr, cfg.cudagraphs)
    # The chain compiles its own step, so it is drawn before the compiled loss.
    qvalue_loss = compiled(loss.qvalue_loss, cfg.compile)
    noise_level_loss = compiled(loss.noise_level_loss, cfg.compile)

    @partial(capture, enabled=cfg.cudagraphs)
    def update(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        batch[loss.tensor_keys.next_action] = loss.sample_next_action(batch)
        metrics = descend(qvalue_loss(batch), "loss_qvalue", optimizer)
        metrics.update(descend(noise_level_loss(batch), "loss_noise_level", optimizer))
        target_update.step()
        return metrics

    state = {"loss": loss, "optimizer": optimizer}
    return Agent(loss.actor_network, update, state, policy_builder=builder)
