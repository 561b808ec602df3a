"""The loss of QSM: a score network that matches the action gradient of the critics."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_aca.baselines.diffusion_loss import DiffusionPolicyLoss
from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.baselines.networks import action_gradient
from torchrl_aca.checks import check_above, check_choice

__all__ = ["QSMLoss"]


class QSMLoss(DiffusionPolicyLoss):
    """Loss module of Q-score matching.

    Of *Learning a Diffusion Model Policy from Rewards via Q-Score Matching*, arXiv 2312.11752.
    With critics ``Q_i`` and the policy's network ``psi``, two losses, each to be had alone:

    - :meth:`qvalue_loss`: ``sum_i (Q_i(s, a) - y)^2``, ``y = r + gamma (1 - terminated)
      min_i Q_bar_i(s', a')``;
    - :meth:`actor_loss`: ``mean_j (psi(s, a)_j - score_scale * grad_a Q(s, a)_j)^2``, with no
      gradient through that of ``Q``.

    What ``psi`` is depends on the policy's chain. With Langevin steps, as in the code base that
    ACA's paper compares in, it is a score, and ``a`` is the action in the data. With a noise
    schedule, as in QSM's own code, it predicts noise, whose sign is the opposite: the target is
    ``-score_scale * grad_a Q(s, a_t)`` at the noised action ``a_t``, ``t`` uniform over the levels.

    Differences from the authors' code: errors are averaged over the dimensions of the action, not
    summed (Adam sees no difference); the network of the noised form is the baselines' own.

    Args:
        actor_network: the policy, with its critics.

    Keyword Args:
        score_scale: 1 with Langevin steps, 50 in the authors' code. Default: 1.
        gradient_of: the critic that is differentiated: for each row the smaller one (``"min"``) or
            the ``"mean"`` of both, as in the authors' code. Default: ``"min"``.
        kwargs: as of :class:`DiffusionPolicyLoss`.

    Raises:
        ValueError: on an unknown option, or Langevin steps with a network that sees the level.

    Examples:
        >>> from torchrl_aca.baselines import DiffusionPolicy, NoiseNetwork, QSMLoss, TwinCritic
        >>> network, critic = NoiseNetwork(3, 2, embedding="none"), TwinCritic(3, 2)
        >>> step_sizes = [1 - k / 20 for k in range(20)]
        >>> loss = QSMLoss(DiffusionPolicy(network, step_sizes, critic=critic))
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> loss.qvalue_loss(data)["loss_qvalue"].backward()  # and a step, and a soft update
        >>> loss.actor_loss(data)["loss_actor"].backward()
    """

    needs_schedule = False
    metric_names = ("pred_value", "target_value", "gradient_norm")

    def __init__(
        self,
        actor_network: DiffusionPolicy,
        *,
        score_scale: float = 1.0,
        gradient_of: Literal["min", "mean"] = "min",
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, **kwargs)
        embedding = getattr(actor_network.network, "embedding", "none")
        if actor_network.schedule is None and embedding != "none":
            raise ValueError(
                "Langevin steps use one score at all levels, and this loss trains one: expected a "
                f'network that does not see the level, got embedding="{embedding}". Build it with '
                'embedding="none", or give the policy a NoiseSchedule.'
            )
        check_above(0, score_scale=score_scale)
        check_choice(("min", "mean"), gradient_of=gradient_of)
        self.score_scale = score_scale
        self.gradient_of = gradient_of

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Score matching: regression of the network on the critics' gradient."""
        observation, action = self._rows(tensordict)
        level = torch.ones((), dtype=torch.long, device=action.device)
        sign = 1
        if self.actor_network.schedule is not None:
            action, _, level = self._forward_noise(tensordict, action)
            sign = -1
        gradient = self._gradient(observation, action)
        target = sign * self.score_scale * gradient
        error = (self._predicted(observation, action, level) - target).square().mean(-1)
        metrics = {"gradient_norm": gradient.norm(dim=-1).mean()}
        return self._weighted("loss_actor", error, tensordict, metrics)

    @torch.no_grad()
    def _gradient(self, observation: Tensor, action: Tensor) -> Tensor:
        """The critics' action gradient, ``(B, A)``."""
        critics = self.qvalue_network
        return action_gradient(critics, critics.encode(observation), action, self._of_critics)

    def _of_critics(self, values: Tensor) -> Tensor:
        """What is differentiated, ``(B, E)`` to ``(B,)``; of equals, the first."""
        return values.min(-1).values if self.gradient_of == "min" else values.mean(-1)
