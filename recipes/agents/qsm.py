"""QSM for the recipes: `make_qsm(cfg, env, device) -> Agent`."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from agents.diffusion import Candidates, DiffusionSettings, make_steps, policy_builder
from torchrl_aca.baselines import QSMLoss
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import NonNegative, Positive
from torchrl_aca.training.policy import PolicyBuilder


class QSMSettings(DiffusionSettings):
    """The section `qsm`."""

    sampler: Literal["langevin", "denoising"]
    num_candidates: Candidates
    num_target_candidates: Candidates
    exploration_noise: NonNegative
    score_scale: Positive
    gradient_of: Literal["min", "mean"]


def qsm_policy(cfg: Any, env: EnvBase) -> PolicyBuilder:
    """The policy: annealed Langevin steps along a score, or a chain of DDPM."""
    settings = cfg.qsm
    how = {
        "num_candidates": settings.num_candidates,
        "exploration_noise": settings.exploration_noise,
        "clip_action": True,
    }
    if settings.sampler == "langevin":
        steps = settings.num_steps
        sizes, network = [1 - step / steps for step in range(steps)], {"embedding": "none"}
        return policy_builder(cfg, settings, env, schedule=sizes, network=network, **how)
    # The authors' chain: variance beta, and the action itself clipped rather than its estimate.
    how.update(clip_denoised=False, clip_step=True, variance="beta")
    return policy_builder(cfg, settings, env, **how)


def make_qsm(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """QSM: a step of the critics, then one of the policy with the new critics."""
    settings, builder = cfg.qsm, qsm_policy(cfg, env)
    loss = QSMLoss(
        builder.build(device, compile_step=cfg.compile),
        score_scale=settings.score_scale,
        gradient_of=settings.gradient_of,
        num_target_candidates=settings.num_target_candidates,
        reward_scale=settings.reward_scale,
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    steps = make_steps(cfg, loss)

    def update(batch: TensorDictBase) -> TensorDictBase:
        metrics = steps.critics(batch)
        if steps.progress.updates % settings.actor_interval == 0:
            metrics.update(steps.actor(batch))
        if steps.progress.updates % settings.target_interval == 0:
            steps.targets(batch)
        steps.progress.updates += 1
        return metrics

    return Agent(loss.actor_network, update, state=steps.state, policy_builder=builder)
