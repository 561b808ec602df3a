"""DIPO: a diffusion policy that imitates actions, which the critics improve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_aca.baselines.diffusion_loss import DiffusionPolicyLoss
from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.baselines.networks import action_gradient
from torchrl_aca.chain import StepRunner
from torchrl_aca.checks import check_above, check_at_least

__all__ = ["DIPOLoss", "improve_actions"]

_EAGER = StepRunner(compiled=False)


class DIPOLoss(DiffusionPolicyLoss):
    """Loss module of DIPO (*Policy Representation via Diffusion ...*, arXiv 2305.13122).

    Each row of the replay buffer holds its best action so far, ``b``, which begins as the action
    taken. Two losses, each to be had alone:

    - :meth:`qvalue_loss`: the critics', with ``a'`` from the moving average of the policy;
    - :meth:`actor_loss`: ``1/2 mean (eps_theta(s, b_t, t) - eps)^2``: the policy imitates the best
      actions. ``1/2`` counts where the gradient's length is cut.

    :meth:`improve` makes the best actions better, after the critics' step; who owns the buffer
    writes them back to the rows that they are of, and :meth:`actor_loss` reads them.

    How it differs from its authors' code: the best actions lie in the rows of the one replay
    buffer, where theirs are in a second one that is sampled on its own; time limits do not stop the
    bootstrap, there they do.

    Args:
        actor_network: the policy, with its critics.

    Keyword Args:
        num_gradient_steps: steps of :meth:`improve`. Default: 30.
        action_lr: their learning rate, in [-1, 1] units. Default: 0.03.
        action_max_norm: the largest length of the batch's action gradient. Default: 0.16.
        action_bound: actions climb within ``[-action_bound, action_bound]``. Default: 1.
        compile_step: run a step of :meth:`improve` through ``torch.compile``. Default: False.
        kwargs: those of :class:`DiffusionPolicyLoss`, without ``average_policy``.

    Raises:
        ValueError: if a number is out of range.

    Examples:
        >>> from torchrl_aca.baselines import DIPOLoss, DiffusionPolicy, NoiseNetwork, TwinCritic
        >>> network = NoiseNetwork(3, 2, num_steps=100, embedding="sinusoidal", embedding_dim=32)
        >>> policy = DiffusionPolicy(network, NoiseSchedule.cosine(100), critic=TwinCritic(3, 2))
        >>> loss = DIPOLoss(policy)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> loss.qvalue_loss(data)["loss_qvalue"].backward()  # and a step
        >>> data["best_action"] = loss.improve(data)
        >>> loss.actor_loss(data)["loss_actor"].backward()  # and a step, and a soft update
    """

    @dataclass
    class _AcceptedKeys(DiffusionPolicyLoss._AcceptedKeys):
        """Keys that ``set_keys`` can change.

        Attributes:
            best_action: the best action so far, in env units; where there is none, the action.
        """

        best_action: NestedKey = "best_action"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    metric_names = ("pred_value", "target_value", "improvement")

    def __init__(
        self,
        actor_network: DiffusionPolicy,
        *,
        num_gradient_steps: int = 30,
        action_lr: float = 0.03,
        action_max_norm: float = 0.16,
        action_bound: float = 1.0,
        compile_step: bool = False,
        **kwargs: Any,
    ) -> None:
        check_at_least(1, num_gradient_steps=num_gradient_steps)
        check_above(0, action_lr=action_lr, action_max_norm=action_max_norm)
        check_above(0, action_bound=action_bound)
        super().__init__(actor_network, average_policy=True, **kwargs)
        self.num_gradient_steps = num_gradient_steps
        self.action_lr = action_lr
        self.action_max_norm = action_max_norm
        self.action_bound = action_bound
        self._run = StepRunner(compile_step)

    def _target_actor(self) -> DiffusionPolicy:
        return self.average_actor_network

    @torch.no_grad()
    def improve(self, tensordict: TensorDictBase) -> Tensor:
        """The best actions after :func:`improve_actions`, in env units, shape ``(*batch, A)``.

        Args:
            tensordict: observations, and best actions where there are any; left as it is.
        """
        actor, best = self.actor_network, self._best_action(tensordict)
        critic = self.qvalue_network
        with self._critics(self.qvalue_network_params):
            features = critic.encode(self._observations(tensordict))
            improved = improve_actions(
                partial(action_gradient, critic, features, reduce=_smallest),
                actor.from_env(best).reshape(-1, best.shape[-1]),
                num_steps=self.num_gradient_steps,
                lr=self.action_lr,
                max_norm=self.action_max_norm,
                bound=self.action_bound,
                run=self._run,
            )
        return actor.to_env(improved).reshape(best.shape)

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Denoising loss on the best actions; no gradient reaches the critics."""
        actor, observation = self.actor_network, self._observations(tensordict)
        best = self._best_action(tensordict)
        best = actor.from_env(best).reshape(-1, best.shape[-1])
        noisy, noise, level = self._forward_noise(tensordict, best)
        error = (self._predicted(observation, noisy, level) - noise).square().mean(-1) / 2
        taken = actor.from_env(tensordict[self.tensor_keys.action]).reshape(best.shape)
        metrics = {"improvement": (best - taken).abs().mean()}
        return self._weighted("loss_actor", error, tensordict, metrics)

    def _best_action(self, tensordict: TensorDictBase) -> Tensor:
        best = tensordict.get(self.tensor_keys.best_action, None)
        return tensordict[self.tensor_keys.action] if best is None else best


def _smallest(values: Tensor) -> Tensor:
    return values.amin(-1)


def improve_actions(
    gradient: Callable[[Tensor], Tensor],
    action: Tensor,
    *,
    num_steps: int = 30,
    lr: float = 0.03,
    max_norm: float = 0.16,
    bound: float = 1.0,
    run: Callable[..., Any] = _EAGER,
) -> Tensor:
    """DIPO's action gradient: steps of a fresh Adam up the critics' value, inside a box.

    The gradient of the whole batch has its length cut at ``max_norm`` before Adam sees it, and
    actions are clipped after each step. Adam hardly knows the gradient's scale: each coordinate
    moves about ``lr`` a step where its sign is stable.

    Args:
        gradient: ``action -> dQ/da`` of the same shape.
        action: where to start, shape ``(B, A)``.

    Keyword Args:
        num_steps: ``K``. Default: 30.
        lr: Adam's learning rate. Default: 0.03.
        max_norm: largest length of the gradient, over all ``B * A`` numbers. Default: 0.16.
        bound: the box is ``[-bound, bound]``. Default: 1.
        run: calls a step with its arguments; a :class:`~torchrl_aca.chain.StepRunner` to compile
            it.

    Returns:
        Improved actions of the same shape.

    Raises:
        ValueError: if a number is out of range.
    """
    check_at_least(1, num_steps=num_steps)
    check_above(0, lr=lr, max_norm=max_norm)
    state = action, torch.zeros_like(action), torch.zeros_like(action)
    for count in torch.arange(1, num_steps + 1, dtype=action.dtype, device=action.device):
        state = run(_ascend, gradient, lr, max_norm, bound, count, *state)
    return state[0]


def _ascend(
    gradient: Callable[[Tensor], Tensor],
    lr: float,
    max_norm: float,
    bound: float,
    count: Tensor,
    action: Tensor,
    first: Tensor,
    second: Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of Adam upwards: the action and both moments."""
    slope = gradient(action)
    norm = torch.linalg.vector_norm(slope)
    slope = slope * (max_norm / norm.clamp(min=max_norm))
    first = betas[0] * first + (1 - betas[0]) * slope
    second = betas[1] * second + (1 - betas[1]) * slope.square()
    mean = first / (1 - betas[0] ** count)
    scale = (second / (1 - betas[1] ** count)).sqrt() + eps
    return (action + lr * mean / scale).clamp(-bound, bound), first, second
