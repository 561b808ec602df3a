"""ACA for the recipes: `make_aca(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field, PlainSerializer, WrapValidator, model_validator
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

import torchrl_aca
from agents.learning_rate import DecayOptim, linear_decay
from torchrl_aca import make_aca_actor
from torchrl_aca.chain import check_levels
from torchrl_aca.make import ACAParts
from torchrl_aca.training.acceleration import Step, capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import Counters
from torchrl_aca.training.config import (
    Count,
    NonNegative,
    Positive,
    Section,
    Widths,
)
from torchrl_aca.training.policy import PolicyBuilder

Candidates = Annotated[int, Field(ge=1, le=10**5)]


# A number, or "auto"; a union of the two would tell a mistake twice.
Weight = Annotated[
    NonNegative,
    WrapValidator(lambda value, number: value if value == "auto" else number(value)),
    PlainSerializer(lambda value: value),
]


class ACASettings(Section):
    """The section `aca`."""

    num_steps: Annotated[int, Field(ge=1, le=1000)]
    num_inference_steps: Annotated[int, Field(ge=1, le=1000)]
    inference_levels: list[int] | None
    schedule: Literal["cosine", "linear", "vp"]
    num_cells: Widths
    num_critics: Annotated[int, Field(ge=1, le=1000)]
    first_level: Annotated[int, Field(ge=0, le=1)]
    target_value: Literal["best", "soft"]
    temperature: Positive
    guidance_weight: Weight
    guidance_weight_init: Positive
    guidance_weight_lr: Positive
    num_candidates: Candidates
    num_target_candidates: Candidates
    exploration_noise: Annotated[float, Field(ge=0, le=1e3)]  # of actions in [-1, 1]
    alpha_init: Positive
    noise_level_target: Literal["mean", "self"]
    noise_level_interval: Count
    alpha_interval: Count
    target_entropy_scale: float
    reward_scale: Positive

    @model_validator(mode="after")
    def _levels(self) -> ACASettings:
        if self.num_inference_steps > self.num_steps:
            self.refuse("num_inference_steps", f"at most aca.num_steps ({self.num_steps})")
        if self.inference_levels is not None:
            self._check_levels(self.inference_levels)
        if self.auto_guidance and self.num_target_candidates < 2:
            self.refuse("num_target_candidates", "at least 2 beside aca.guidance_weight=auto")
        return self

    @property
    def auto_guidance(self) -> bool:
        """Whether the guidance weight tunes itself."""
        return self.guidance_weight == "auto"

    def _check_levels(self, levels: list[int]) -> None:
        """They replace `num_inference_steps`, which then holds its default or their number."""
        try:
            check_levels(levels, self.num_steps)
        except ValueError:
            expected = f"rising integers from 1 to aca.num_steps ({self.num_steps}), both included"
            self.refuse("inference_levels", expected)
        if self.num_inference_steps not in (self.num_steps, len(levels)):
            number = f"{len(levels)}, the number of aca.inference_levels"
            self.refuse("num_inference_steps", f"aca.num_steps ({self.num_steps}) or {number}")


class ACAOptim(DecayOptim):
    """The section `optim` of ACA."""

    lr_end: NonNegative
    alpha_lr: Positive


def actor_settings(cfg: Any) -> dict[str, Any]:
    """The keywords of `make_aca_actor`."""
    settings, levels, auto = cfg.aca, cfg.aca.inference_levels, cfg.aca.auto_guidance
    return {
        "num_steps": settings.num_steps,
        "schedule": settings.schedule,
        "num_critics": settings.num_critics,
        "num_cells": settings.num_cells,
        "first_level": settings.first_level,
        "guidance_weight": settings.guidance_weight_init if auto else settings.guidance_weight,
        "num_candidates": settings.num_candidates,
        "num_inference_steps": settings.num_inference_steps if levels is None else None,
        "inference_levels": levels,
        "exploration_noise": settings.exploration_noise,
        "alpha_init": settings.alpha_init,
        "deterministic_draws": cfg.eval.draws,
    }


def loss_settings(cfg: Any) -> dict[str, Any]:
    """The keywords of `ACALoss`."""
    settings = cfg.aca
    return {
        "target_value": settings.target_value,
        "temperature": settings.temperature,
        "guidance_weight": "auto" if settings.auto_guidance else "fixed",
        "guidance_weight_lr": settings.guidance_weight_lr,
        "noise_level_target": settings.noise_level_target,
        "target_entropy_scale": settings.target_entropy_scale,
        "reward_scale": settings.reward_scale,
    }


def make_aca_parts(cfg: Any, env: EnvBase, device: torch.device) -> ACAParts:
    """Loss, targets and optimisers."""
    return torchrl_aca.make_aca(
        env,
        **actor_settings(cfg),
        compile_step=cfg.compile,
        num_target_candidates=cfg.aca.num_target_candidates,
        loss=loss_settings(cfg),
        gamma=cfg.optim.gamma,
        tau=cfg.optim.tau,
        lr=cfg.optim.lr,
        alpha_lr=cfg.optim.alpha_lr,
        make_optimizer=partial(make_adam, cudagraphs=cfg.cudagraphs),
        device=device,
    )


class Steps(NamedTuple):
    """What an update consists of: functions of a batch alone, each captured as a CUDA graph."""

    td: Step
    noise_level: Step
    target: Step
    alpha: Step


def make_steps(cfg: Any, aca: ACAParts) -> Steps:
    """The four steps of ACA's update, compiled and captured where that is enabled."""
    loss, captured = aca.loss, partial(capture, enabled=cfg.cudagraphs)
    # The chain compiles its own step, so it is drawn before the compiled loss.
    qvalue_loss = compiled(loss.qvalue_loss, cfg.compile)
    noise_level_loss = compiled(loss.noise_level_loss, cfg.compile)

    def td(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        batch[loss.tensor_keys.next_action] = loss.sample_next_action(batch)
        metrics = descend(qvalue_loss(batch), "loss_qvalue", aca.optimizer)
        if cfg.aca.auto_guidance:
            metrics.update(loss.step_guidance_weight(batch))
        return metrics

    def noise_level(batch: TensorDictBase) -> TensorDictBase:
        return descend(noise_level_loss(batch), "loss_noise_level", aca.optimizer)

    def target(batch: TensorDictBase) -> None:
        aca.target_update.step()

    def alpha(batch: TensorDictBase) -> TensorDictBase:
        return descend(loss.alpha_loss(), "loss_alpha", aca.alpha_optimizer)

    return Steps(*map(captured, (td, noise_level, target, alpha)))


def make_aca(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """ACA, in the official code's order: a TD step, then at even updates a noise-level step.

    What changes from update to update, which steps to take and the learning rate, stays outside of
    the steps.
    """
    settings, aca, progress = cfg.aca, make_aca_parts(cfg, env, device), Counters()
    # The decay counts steps of the optimiser, of which an update takes one or two.
    scheduler = linear_decay(aca.optimizer, cfg.optim, cfg.optim.lr, cfg.optim.lr_end)
    step = make_steps(cfg, aca)

    def update(batch: TensorDictBase) -> TensorDictBase:
        metrics = step.td(batch)
        scheduler.step()
        if progress.updates % settings.noise_level_interval == 0:
            metrics.update(step.noise_level(batch))
            scheduler.step()
        step.target(batch)
        if progress.updates % settings.alpha_interval == 0:
            metrics.update(step.alpha(batch))
        progress.updates += 1
        return metrics

    return Agent(
        aca.actor,
        update,
        state={
            "loss": aca.loss,
            "optimizer": aca.optimizer,
            "alpha_optimizer": aca.alpha_optimizer,
            "scheduler": scheduler,
            "progress": progress,
        },
        policy_builder=PolicyBuilder.of(env, make_aca_actor, **actor_settings(cfg)),
    )
