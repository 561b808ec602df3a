"""ACA in TorchRL's :class:`~torchrl.trainers.Trainer`: one update in the official code's order."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch.nn.utils import clip_grad_norm_, clip_grad_value_
from torch.optim import Optimizer
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_aca.checks import check_at_least

__all__ = ["ACAOptimizationStepper"]


class ACAOptimizationStepper(OptimizationStepper):
    """The update of ACA for ``Trainer(optimization_stepper=...)``, in the official code's order.

    A TD step, and one of a guidance weight that tunes itself; at even updates a step of the same
    optimiser on the noise-level loss, at the parameters after the first; at every 250th a step on
    alpha. The trainer's ``clip_norm`` clips each step's gradients by their norm, or by value with
    ``clip_grad_norm=False``; its ``target_net_updater`` moves the targets after each update.

    Args:
        critic_optimizer: of the critic's parameters.
        alpha_optimizer: of ``loss.log_alpha``.
        noise_level_interval: updates between two steps on the noise-level loss.
        alpha_interval: updates between two steps on alpha.

    Raises:
        ValueError: if an interval is below 1.

    Examples:
        >>> import torch
        >>> from torchrl_aca import ACALoss, CriticGuidedDenoisingActor
        >>> from torchrl_aca import NoiseLevelCritic, NoiseSchedule
        >>> from torchrl_aca.trainer import ACAOptimizationStepper
        >>> critic = NoiseLevelCritic(observation_dim=3, action_dim=1)
        >>> loss = ACALoss(CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(20)))
        >>> stepper = ACAOptimizationStepper(
        ...     torch.optim.Adam(critic.parameters(), lr=1e-3),
        ...     torch.optim.Adam([loss.log_alpha], lr=3e-2),
        ... )
    """

    def __init__(
        self,
        critic_optimizer: Optimizer,
        alpha_optimizer: Optimizer,
        *,
        noise_level_interval: int = 2,
        alpha_interval: int = 250,
    ) -> None:
        check_at_least(1, noise_level_interval=noise_level_interval, alpha_interval=alpha_interval)
        self.critic_optimizer, self.alpha_optimizer = critic_optimizer, alpha_optimizer
        self.noise_level_interval, self.alpha_interval = noise_level_interval, alpha_interval
        self.updates = 0
        self._latest: dict[str, TensorDictBase] = {}

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Make one update on a batch of transitions, with ``trainer.loss_module``.

        Returns:
            The latest losses and metrics of each of its steps, detached: the trainer averages over
            updates, and wants the same names from each.
        """
        loss = trainer.loss_module
        self._descend(trainer, "qvalue", loss.qvalue_loss(sub_batch), self.critic_optimizer)
        if loss.auto_guidance:
            self._latest["guidance_weight"] = loss.step_guidance_weight(sub_batch)
        if self.updates % self.noise_level_interval == 0:
            losses = loss.noise_level_loss(sub_batch)
            self._descend(trainer, "noise_level", losses, self.critic_optimizer)
        if self.updates % self.alpha_interval == 0:
            self._descend(trainer, "alpha", loss.alpha_loss(), self.alpha_optimizer)
        self.updates += 1
        metrics = TensorDict({}, batch_size=[])
        for losses in self._latest.values():
            metrics.update(losses)
        return metrics

    def _descend(
        self, trainer: Trainer, name: str, losses: TensorDictBase, optimizer: Optimizer
    ) -> None:
        optimizer.zero_grad()
        losses[f"loss_{name}"].backward()
        if trainer.clip_norm is not None:
            clip = clip_grad_norm_ if trainer.clip_grad_norm else clip_grad_value_
            clip(
                [p for group in optimizer.param_groups for p in group["params"]], trainer.clip_norm
            )
        optimizer.step()
        self._latest[name] = losses.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return the number of updates, both optimisers and the latest losses."""
        return {
            "updates": self.updates,
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "alpha_optimizer": self.alpha_optimizer.state_dict(),
            "latest": {name: losses.to_dict() for name, losses in self._latest.items()},
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.updates = state_dict["updates"]
        self.critic_optimizer.load_state_dict(state_dict["critic_optimizer"])
        self.alpha_optimizer.load_state_dict(state_dict["alpha_optimizer"])
        latest = state_dict["latest"].items()
        self._latest = {name: TensorDict(losses, batch_size=[]) for name, losses in latest}
