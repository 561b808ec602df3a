"""CQL, Cal-QL and WSRL for the recipes: one conservative offline phase, three online ones."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from agents.ensemble import EnsembleSACSettings, initialised, make_critics, policy_builder
from agents.ensemble_steps import DelayedActor, EnsembleSteps, actor_interval, both
from torchrl_aca.baselines import CalQLLoss, EnsembleCQLLoss
from torchrl_aca.offline import return_bounds
from torchrl_aca.offline.bounds import Tail, check_tail
from torchrl_aca.replay import FinishedEpisodes
from torchrl_aca.training.acceleration import Step, capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.config import Count, NonNegative, Optim, Positive, Section
from torchrl_aca.training.policy import PolicyBuilder


class CQLSettings(EnsembleSACSettings):
    """The section `cql`."""

    section: ClassVar[str] = "cql"

    weight: NonNegative
    gap_threshold: float | None
    num_actions: Annotated[int, Field(ge=1, le=10**4)]
    num_backup_actions: Annotated[int, Field(ge=1, le=10**4)]


class CalQLSettings(Section):
    """The section `calql`."""

    tail: Tail
    horizon: Count


class WSRLSettings(Section):
    """The section `wsrl`."""

    actor_interval: Count | None


class CQLOptim(Optim):
    """The section `optim` of the three."""

    lr: Positive
    actor_lr: Positive
    alpha_lr: Positive
    weight_lr: Positive


def make_cql(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """CQL; an update is a step of critics, actor and temperature on one batch, in both phases."""
    loss, builder = make_loss(EnsembleCQLLoss, cfg, env, device)
    steps = EnsembleSteps(loss, cfg)
    update = both(conservative_step(steps, cfg), steps.actor_step())
    return Agent(
        loss.actor_network, update, steps.state, offline_update=update, policy_builder=builder
    )


def make_calql(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """Cal-QL: CQL with a floor from the returns, so online only finished episodes are sampled."""
    check_tail(cfg.calql.tail, cfg.optim.gamma)
    loss, builder = make_loss(CalQLLoss, cfg, env, device)
    steps = EnsembleSteps(loss, cfg)
    update = both(conservative_step(steps, cfg), steps.actor_step())

    def with_bounds(rows: TensorDictBase) -> TensorDictBase:
        bounds = return_bounds(rows, cfg.optim.gamma, **cfg.calql.model_dump())
        return rows.copy().set("mc_return", bounds)

    finished = FinishedEpisodes(with_bounds)
    return Agent(
        loss.actor_network,
        update,
        {**steps.state, "unfinished_episodes": finished},
        offline_update=update,
        extra_keys=("mc_return",),
        rows=finished,
        offline_rows=with_bounds,
        policy_builder=builder,
    )


def make_wsrl(cfg: Any, env: EnvBase, device: torch.device) -> Agent:
    """WSRL: CQL offline; online an ensemble SAC with many critic steps for one of the actor.

    Everything goes over from one phase to the other: networks, targets, temperature and the
    moments of the optimisers. An online update is one critic step; the actor's step sees the
    states of all batches since its last one.
    """
    loss, builder = make_loss(EnsembleCQLLoss, cfg, env, device)
    steps = EnsembleSteps(loss, cfg)
    interval = actor_interval(cfg.wsrl.actor_interval, cfg.optim.utd_ratio)
    # Each phase has an actor step of its own, because their batches differ in size.
    offline_update = both(conservative_step(steps, cfg), steps.actor_step())
    update = DelayedActor(
        steps.critic_step(loss.td_loss), steps.actor_step(), interval, interval, device
    )
    state = {**steps.state, **update.state}
    return Agent(
        loss.actor_network, update, state, offline_update=offline_update, policy_builder=builder
    )


def make_loss(
    kind: type[EnsembleCQLLoss], cfg: Any, env: EnvBase, device: torch.device
) -> tuple[EnsembleCQLLoss, PolicyBuilder]:
    """The loss on a policy and critics, and how the policy is built."""
    settings, builder = cfg.cql, policy_builder(cfg.cql, env)
    loss = kind(
        initialised(builder.build(device), settings),
        make_critics(settings, env, device),
        cql_weight=settings.weight,
        num_actions=settings.num_actions,
        num_backup_actions=settings.num_backup_actions,
        gap_threshold=settings.gap_threshold,
        **settings.of_loss(),
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss, builder


def conservative_step(steps: EnsembleSteps, cfg: Any) -> Step:
    """A step of the critics down CQL's loss, with `cql.gap_threshold` one of its weight as well."""
    loss: Any = steps.loss
    if loss.gap_threshold is None:
        return steps.critic_step(loss.qvalue_loss)
    qvalue_loss = compiled(loss.qvalue_loss, cfg.compile)
    optimizer = make_adam([loss.raw_cql_weight], cfg.optim.weight_lr, cfg.cudagraphs)
    steps.state["weight_optimizer"] = optimizer

    @partial(capture, enabled=cfg.cudagraphs)
    def critic_step(batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()
        metrics = descend(qvalue_loss(batch), "loss_qvalue", steps.optimizer)
        weight_loss = loss.cql_weight_loss(batch)
        metrics.update(descend(weight_loss, "loss_cql_weight", optimizer))
        steps.target_update.step()
        return metrics

    return critic_step
