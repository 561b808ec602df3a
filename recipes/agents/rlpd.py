"""RLPD for the recipes: many critic steps for each step of actor and temperature."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torchrl.envs import EnvBase

from agents.ensemble import EnsembleSACSettings, initialised, make_critics, policy_builder
from agents.ensemble_steps import DelayedActor, EnsembleSteps, actor_interval
from torchrl_aca.baselines import EnsembleSACLoss
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Count, Optim, Positive


class RLPDSettings(EnsembleSACSettings):
    """The section `rlpd`."""

    section: ClassVar[str] = "rlpd"

    actor_interval: Count | None
    num_actor_batches: Count | None


class RLPDOptim(Optim):
    """The section `optim` of RLPD."""

    lr: Positive
    actor_lr: Positive
    alpha_lr: Positive


def make_rlpd(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """RLPD; a call of its update is one critic step, on one batch.

    At every `rlpd.actor_interval`-th update follows a step of actor and temperature, on the states
    of the last `rlpd.num_actor_batches` batches: one in the original, all since the actor's last
    step in WSRL's version. WSRL's code has the offline rows of a round in half of its critic steps
    and the online rows in the other half, because of the order in which it joins them; here every
    critic step takes a batch as the loop has sampled it.
    """
    settings = cfg.rlpd
    builder = policy_builder(settings, env)
    loss = EnsembleSACLoss(
        initialised(builder.build(device), settings),
        make_critics(settings, env, device),
        **settings.of_loss(),
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    steps = EnsembleSteps(loss, cfg)
    interval = actor_interval(settings.actor_interval, cfg.optim.utd_ratio)
    update = DelayedActor(
        steps.critic_step(loss.qvalue_loss),
        steps.actor_step(),
        interval,
        settings.num_actor_batches or interval,
        device,
    )
    state = {**steps.state, **update.state}
    return Agent(loss.actor_network, update, state, policy_builder=builder)
