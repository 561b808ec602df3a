"""What the agents with an ensemble of critics share: settings, networks, steps of their loss."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field, model_validator
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import SoftUpdate

from agents.gaussian_policy import make_gaussian_policy
from torchrl_aca.baselines import EnsembleMLP, EnsembleSACLoss
from torchrl_aca.training.acceleration import Step, capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Stateful, Update
from torchrl_aca.training.checkpoint import Counters
from torchrl_aca.training.config import Count, Positive, Section, Widths

INITIALISERS = {"xavier_uniform": nn.init.xavier_uniform_, "orthogonal": nn.init.orthogonal_}


class EnsembleSettings(Section):
    """The networks, and how many critics make a target."""

    section: ClassVar[str]

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

    @model_validator(mode="after")
    def _sizes(self) -> EnsembleSettings:
        if self.subset_size > self.num_qvalue_nets:
            expected = f"at most {self.section}.num_qvalue_nets ({self.num_qvalue_nets})"
            self.refuse("subset_size", expected)
        if self.log_std_max < self.log_std_min:
            expected = f"at least {self.section}.log_std_min ({self.log_std_min})"
            self.refuse("log_std_max", expected)
        return self


class EnsembleSACSettings(EnsembleSettings):
    """And the soft actor-critic on them."""

    entropy_backup: bool
    actor_value: Literal["mean", "min"]
    alpha_init: Positive
    target_entropy_scale: float
    temperature: Literal["exp", "softplus"]

    def of_loss(self) -> dict[str, Any]:
        """Returns the keywords of `EnsembleSACLoss`."""
        names = (
            "subset_size",
            "subset_with_replacement",
            "actor_value",
            "entropy_backup",
            "target_entropy_scale",
            "alpha_init",
            "temperature",
        )
        return {name: getattr(self, name) for name in names}


# --- networks -------------------------------------------------------------------------------------


def make_network(
    settings: EnsembleSettings,
    num_in: int,
    num_out: int,
    last_hidden_gain: float,
    device: torch.device,
) -> MLP:
    """A network of the actor's kind."""
    norm = {}
    if settings.actor_layer_norm:
        kwargs = [{"normalized_shape": cells, "eps": 1e-6} for cells in settings.num_cells]
        norm = {"norm_class": nn.LayerNorm, "norm_kwargs": kwargs}
    network = MLP(
        num_in,
        num_out,
        num_cells=settings.num_cells,
        activation_class=nn.ReLU,
        device=device,
        **norm,
    )
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.zeros_(layer.bias)
    initialise([layer.weight.unsqueeze(0) for layer in layers], settings, last_hidden_gain)
    return network


def make_policy(
    settings: EnsembleSettings, env: EnvBase, device: torch.device
) -> ProbabilisticActor:
    """The tanh-squashed Gaussian."""
    spec = env.action_spec_unbatched
    num_in = env.observation_spec["observation"].shape[-1]
    gain = settings.last_hidden_gain
    network = make_network(settings, num_in, 2 * spec.shape[-1], gain, device)
    return make_gaussian_policy(network, spec, settings.log_std_min, settings.log_std_max, device)


def make_critics(settings: EnsembleSettings, env: EnvBase, device: torch.device) -> ValueOperator:
    """The ensemble of critics."""
    network = EnsembleMLP(
        env.observation_spec["observation"].shape[-1] + env.action_spec_unbatched.shape[-1],
        settings.num_qvalue_nets,
        num_cells=settings.num_cells,
        layer_norm=settings.critic_layer_norm,
        device=device,
    )
    initialise(network.weights, settings, settings.last_hidden_gain)
    return ValueOperator(network, in_keys=["observation", "action"])


def initialise(
    weights: list[torch.Tensor], settings: EnsembleSettings, last_hidden_gain: float
) -> None:
    """Draws stacks of weights, first layer to last; the last hidden one has a gain of its own."""
    fill = INITIALISERS[settings.init]
    for layer, weight in enumerate(weights):
        gain = last_hidden_gain if layer == len(weights) - 2 else settings.gain
        for member in weight:
            fill(member, gain=gain)


# --- steps ----------------------------------------------------------------------------------------


class EnsembleSteps:
    """The optimisers of an ensemble SAC's loss, and its steps: functions of a batch alone.

    Attributes:
        state: The loss and the optimisers, for checkpoints.
    """

    def __init__(self, loss: EnsembleSACLoss, cfg: Any) -> None:
        """Takes the loss and a configuration with `optim.lr`, `.actor_lr` and `.alpha_lr`."""
        optim, graphs = cfg.optim, cfg.cudagraphs
        self.loss, self.compile, self.graphs = loss, cfg.compile, graphs
        self.target_update = SoftUpdate(loss, tau=optim.tau)
        self.optimizer = make_adam(loss.qvalue_network_params.parameters(), optim.lr, graphs)
        self.actor_optimizer = make_adam(loss.actor_network.parameters(), optim.actor_lr, graphs)
        self.alpha_optimizer = make_adam([loss.raw_alpha], optim.alpha_lr, graphs)
        self.state: dict[str, Stateful] = {
            "loss": loss,
            "optimizer": self.optimizer,
            "actor_optimizer": self.actor_optimizer,
            "alpha_optimizer": self.alpha_optimizer,
        }

    def critic_step(self, qvalue_loss: Step) -> Step:
        """A step of the critics down `qvalue_loss`, and of their targets."""
        qvalue_loss = compiled(qvalue_loss, self.compile)

        @partial(capture, enabled=self.graphs)
        def critic_step(batch: TensorDictBase) -> TensorDictBase:
            metrics = descend(qvalue_loss(batch.copy()), "loss_qvalue", self.optimizer)
            self.target_update.step()
            return metrics

        return critic_step

    def actor_step(self) -> Step:
        """A step of actor and temperature on a batch with `observation`."""
        loss, actor_loss = self.loss, compiled(self.loss.actor_loss, self.compile)

        @partial(capture, enabled=self.graphs)
        def actor_step(states: TensorDictBase) -> TensorDictBase:
            states = states.copy()
            metrics = descend(actor_loss(states), "loss_actor", self.actor_optimizer)
            alpha_loss = loss.alpha_loss(states)
            return metrics.update(descend(alpha_loss, "loss_alpha", self.alpha_optimizer))

        return actor_step


class DelayedActor:
    """An update that is a step of the critics; every so often a step of the actor follows.

    Attributes:
        state: The states that wait for the actor, and the count of updates, for checkpoints.
    """

    def __init__(
        self,
        critic_step: Step,
        actor_step: Step,
        interval: int,
        num_batches: int,
        device: torch.device,
    ) -> None:
        """Takes the two steps.

        Args:
            critic_step: On a batch of transitions.
            actor_step: On a batch of states.
            interval: Updates for each step of the actor.
            num_batches: The latest batches, whose states the actor's step sees.
            device: Where these are.
        """
        self.critic_step, self.actor_step, self.interval = critic_step, actor_step, interval
        self.recent, self.progress = RecentStates(num_batches, device), Counters()
        self.state: dict[str, Stateful] = {
            "recent_states": self.recent,
            "progress": self.progress,
        }

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Makes one update."""
        metrics = self.critic_step(batch)
        self.recent.add(batch)
        self.progress.updates += 1
        if self.progress.updates % self.interval == 0:
            metrics.update(self.actor_step(self.recent.joined()))
        return metrics


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


def actor_interval(chosen: int | None, utd_ratio: float) -> int:
    """One actor step for each step of the environment, or for each update where those are rarer."""
    return chosen or max(1, round(utd_ratio))


def both(first: Step, second: Step) -> Update:
    """An update that makes one step after the other on the same batch."""

    def update(batch: TensorDictBase) -> TensorDictBase:
        return first(batch).update(second(batch.select("observation")))

    return update
