"""Steps of an ensemble SAC's loss, and the updates that the agents make of them."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import SoftUpdate

from torchrl_aca.baselines import EnsembleSACLoss
from torchrl_aca.training.acceleration import Step, capture, compiled, descend, make_adam
from torchrl_aca.training.agent import Stateful, Update
from torchrl_aca.training.checkpoint import Counters


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
