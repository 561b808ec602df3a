"""RLPD for the recipes: many critic steps for each step of actor and temperature."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import SoftUpdate

from agents.gaussian_policy import make_gaussian_policy
from torchrl_aca.baselines import EnsembleMLP, EnsembleSACLoss
from torchrl_aca.training.acceleration import capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Agent
from torchrl_aca.training.checkpoint import Counters
from torchrl_aca.training.config import Count, Optim, Positive, Section, Widths

INITIALISERS = {"xavier_uniform": nn.init.xavier_uniform_, "orthogonal": nn.init.orthogonal_}


class RLPDSettings(Section):
    """The section `rlpd`."""

    num_cells: Widths
    num_qvalue_nets: Annotated[int, Field(ge=1, le=1000)]
    critic_layer_norm: bool
    actor_layer_norm: bool
    init: Literal["xavier_uniform", "orthogonal"]
    gain: Positive
    last_hidden_gain: Positive
    log_std_min: float
    log_std_max: float
    subset_size: Count
    subset_with_replacement: bool
    entropy_backup: bool
    actor_value: Literal["mean", "min"]
    actor_interval: Count | None
    num_actor_batches: Count | None
    alpha_init: Positive
    target_entropy_scale: float
    temperature: Literal["exp", "softplus"]

    @model_validator(mode="after")
    def _sizes(self) -> RLPDSettings:
        if self.subset_size > self.num_qvalue_nets:
            self.refuse("subset_size", f"at most rlpd.num_qvalue_nets ({self.num_qvalue_nets})")
        if self.log_std_max < self.log_std_min:
            self.refuse("log_std_max", f"at least rlpd.log_std_min ({self.log_std_min})")
        return self


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
    settings, optim = cfg.rlpd, cfg.optim
    loss = make_rlpd_loss(cfg, env, device)
    target_update = SoftUpdate(loss, tau=optim.tau)
    optimizer = make_adam(loss.qvalue_network_params.parameters(), optim.lr, cfg.cudagraphs)
    actor_optimizer = make_adam(loss.actor_network.parameters(), optim.actor_lr, cfg.cudagraphs)
    alpha_optimizer = make_adam([loss.raw_alpha], optim.alpha_lr, cfg.cudagraphs)
    # One actor step for each step of the environment, or for each update where those are rarer.
    actor_interval = settings.actor_interval or max(1, round(optim.utd_ratio))
    recent = RecentStates(settings.num_actor_batches or actor_interval, device)
    progress = Counters()
    qvalue_loss = compiled(loss.qvalue_loss, cfg.compile)
    actor_loss = compiled(loss.actor_loss, cfg.compile)

    @partial(capture, enabled=cfg.cudagraphs)
    def critic_step(batch: TensorDictBase) -> TensorDictBase:
        metrics = descend(qvalue_loss(batch), "loss_qvalue", optimizer)
        target_update.step()
        return metrics

    @partial(capture, enabled=cfg.cudagraphs)
    def actor_step(states: TensorDictBase) -> TensorDictBase:
        states = states.copy()
        metrics = descend(actor_loss(states), "loss_actor", actor_optimizer)
        return metrics.update(descend(loss.alpha_loss(states), "loss_alpha", alpha_optimizer))

    def update(batch: TensorDictBase) -> TensorDictBase:
        metrics = critic_step(batch)
        recent.add(batch)
        progress.updates += 1
        if progress.updates % actor_interval == 0:
            metrics.update(actor_step(recent.joined()))
        return metrics

    return Agent(
        loss.actor_network,
        update,
        state={
            "loss": loss,
            "optimizer": optimizer,
            "actor_optimizer": actor_optimizer,
            "alpha_optimizer": alpha_optimizer,
            "recent_states": recent,
            "progress": progress,
        },
    )


class RecentStates:
    """The observations of the last few batches, for the actor's step and for checkpoints."""

    def __init__(self, num_batches: int, device: torch.device) -> None:
        """Keeps so many batches."""
        self.batches: deque[torch.Tensor] = deque(maxlen=num_batches)
        self.device = device

    def add(self, batch: TensorDictBase) -> None:
        """Takes a batch of transitions, and forgets the oldest one that is too many."""
        self.batches.append(batch["observation"])

    def joined(self) -> TensorDict:
        """Returns all rows that are kept."""
        rows = torch.cat(tuple(self.batches))
        return TensorDict({"observation": rows}, batch_size=rows.shape[:1])

    def state_dict(self) -> dict[str, Any]:
        """Returns the batches."""
        return {"batches": list(self.batches)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.batches.clear()
        self.batches.extend(batch.to(self.device) for batch in state_dict["batches"])


def make_rlpd_loss(cfg: Any, env: EnvBase, device: torch.device) -> EnsembleSACLoss:
    """The policy, the critics and their loss."""
    settings = cfg.rlpd
    loss = EnsembleSACLoss(
        make_policy(settings, env, device),
        make_critics(settings, env, device),
        subset_size=settings.subset_size,
        subset_with_replacement=settings.subset_with_replacement,
        actor_value=settings.actor_value,
        entropy_backup=settings.entropy_backup,
        target_entropy_scale=settings.target_entropy_scale,
        alpha_init=settings.alpha_init,
        temperature=settings.temperature,
    ).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return loss


def make_policy(settings: RLPDSettings, env: EnvBase, device: torch.device) -> ProbabilisticActor:
    """The tanh-squashed Gaussian."""
    action_spec = env.action_spec_unbatched
    num_cells = settings.num_cells
    norm = {}
    if settings.actor_layer_norm:
        kwargs = [{"normalized_shape": cells, "eps": 1e-6} for cells in num_cells]
        norm = {"norm_class": nn.LayerNorm, "norm_kwargs": kwargs}
    network = MLP(
        env.observation_spec["observation"].shape[-1],
        2 * action_spec.shape[-1],
        num_cells=num_cells,
        activation_class=nn.ReLU,
        device=device,
        **norm,
    )
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.zeros_(layer.bias)
    initialise([layer.weight.unsqueeze(0) for layer in layers], settings)
    return make_gaussian_policy(
        network, action_spec, settings.log_std_min, settings.log_std_max, device
    )


def make_critics(settings: RLPDSettings, env: EnvBase, device: torch.device) -> ValueOperator:
    """The ensemble of critics."""
    network = EnsembleMLP(
        env.observation_spec["observation"].shape[-1] + env.action_spec_unbatched.shape[-1],
        settings.num_qvalue_nets,
        num_cells=settings.num_cells,
        layer_norm=settings.critic_layer_norm,
        device=device,
    )
    initialise(network.weights, settings)
    return ValueOperator(network, in_keys=["observation", "action"])


def initialise(weights: list[torch.Tensor], settings: RLPDSettings) -> None:
    """Draws stacks of weights, first layer to last; the last hidden one has a gain of its own."""
    fill = INITIALISERS[settings.init]
    for layer, weight in enumerate(weights):
        gain = settings.last_hidden_gain if layer == len(weights) - 2 else settings.gain
        for member in weight:
            fill(member, gain=gain)
