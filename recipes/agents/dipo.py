"""DIPO for the recipes: `make_dipo(cfg, env, device) -> Agent`."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from agents.diffusion import DiffusionOptim, DiffusionSettings, make_steps, policy_builder
from torchrl_aca.baselines import DiffusionPolicy, DIPOLoss
from torchrl_aca.training.acceleration import capture
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Count, Positive


class DIPOSettings(DiffusionSettings):
    """The section `dipo`."""

    num_gradient_steps: Count
    action_lr: Positive
    action_max_norm: Positive
    target_policy_interval: Count


class DIPOOptim(DiffusionOptim):
    """The section `optim` of DIPO."""

    max_grad_norm: Positive


def make_dipo_loss(cfg: Any, policy: DiffusionPolicy) -> DIPOLoss:
    """The loss of the critics and of the policy that imitates improved actions."""
    settings = cfg.dipo
    loss = DIPOLoss(
        policy,
        num_gradient_steps=settings.num_gradient_steps,
        action_lr=settings.action_lr,
        action_max_norm=settings.action_max_norm,
        compile_step=cfg.compile,
        reward_scale=settings.reward_scale,
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_dipo(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """DIPO: a step of the critics; then, with the new critics, better actions; then the policy's.

    The better actions go into the batch, from where the loop writes them to the rows in the buffer.
    """
    settings = cfg.dipo
    network = {"embedding": "sinusoidal", "embedding_dim": 32}
    builder = policy_builder(cfg, settings, env, network=network)
    loss = make_dipo_loss(cfg, builder.build(device, compile_step=cfg.compile))
    best_action = loss.tensor_keys.best_action
    steps = make_steps(cfg, loss)
    max_norm = cfg.optim.max_grad_norm
    cut_gradients(steps.state["optimizer"], max_norm, stacked=True)
    cut_gradients(steps.state["actor_optimizer"], max_norm, stacked=False)

    @partial(capture, enabled=cfg.cudagraphs)
    def improve(batch: TensorDictBase) -> TensorDictBase:
        return TensorDict({best_action: loss.improve(batch)}, batch_size=batch.batch_size)

    def move(name: str) -> None:
        """Moves the targets of one network, which SoftUpdate would do for both."""
        source = getattr(loss, f"{name}_params").data
        getattr(loss, f"target_{name}_params").data.lerp_(source, cfg.optim.tau)

    def update(batch: TensorDictBase) -> TensorDictBase:
        updates = steps.progress.updates
        metrics = steps.critics(batch)
        batch.update(improve(batch))
        if updates % settings.actor_interval == 0:
            metrics.update(steps.actor(batch))
        if updates % settings.target_interval == 0:
            move("qvalue_network")
        if updates % settings.target_policy_interval == 0:
            move("policy_network")
        steps.progress.updates += 1
        return metrics

    return Agent(
        loss.actor_network,
        update,
        state=steps.state,
        rewrites={best_action: "action"},
        policy_builder=builder,
    )


def cut_gradients(optimizer: torch.optim.Optimizer, max_norm: float, stacked: bool) -> None:
    """Cuts the length of the gradient at `max_norm` before each step of an optimiser.

    Args:
        optimizer: Its parameters are cut.
        max_norm: The largest length.
        stacked: Whether the parameters are stacks of networks, each to be cut alone.
    """
    parameters = optimizer.param_groups[0]["params"]

    def cut(*_: Any) -> None:
        gradients = [p.grad if stacked else p.grad.unsqueeze(0) for p in parameters]
        rows = torch.cat([gradient.flatten(1) for gradient in gradients], dim=1)
        factor = (max_norm / torch.linalg.vector_norm(rows, dim=1)).clamp(max=1)
        for gradient in gradients:
            gradient.mul_(factor.view(-1, *[1] * (gradient.ndim - 1)))

    optimizer.register_step_pre_hook(cut)
