"""NC-LQL for the recipes: `make_nclql(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import torch
from pydantic import Field, model_validator
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from torchrl_aca import ACALoss, NoiseLevelCritic
from torchrl_aca.langevin_actor import AnnealedLangevinActor
from torchrl_aca.schedule import VarianceExplodingSchedule
from torchrl_aca.training.acceleration import capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import NonNegative, Optim, Positive, Section, Widths


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


def make_nclql_loss(cfg: Any, env: EnvBase, device: torch.device) -> ACALoss:
    """The critic, the actor that follows it, and ACA's loss with what differs."""
    settings, action_spec = cfg.nclql, env.action_spec_unbatched
    critic = NoiseLevelCritic(
        env.observation_spec["observation"].shape[-1],
        action_spec.shape[-1],
        num_steps=settings.num_steps,
        num_critics=settings.num_critics,
        num_cells=settings.num_cells,
        device=device,
    )
    actor = AnnealedLangevinActor(
        critic,
        VarianceExplodingSchedule(settings.num_steps, settings.sigma_min, settings.sigma_max),
        spec=action_spec,
        steps_per_level=settings.steps_per_level,
        step_size=settings.step_size,
        guidance_weight=settings.guidance_weight,
        normalize_gradient=settings.normalize_gradient,
        num_candidates=settings.num_candidates,
        deterministic_draws=cfg.eval.draws,
        compile_step=cfg.compile,
    ).to(device)
    loss = ACALoss(actor, noise_level_target="target", reward_scale=settings.reward_scale)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_nclql(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """NC-LQL: in every update a TD step and a noise-level step, then a move of the targets."""
    loss = make_nclql_loss(cfg, env, device)
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

    return Agent(loss.actor_network, update, state={"loss": loss, "optimizer": optimizer})
