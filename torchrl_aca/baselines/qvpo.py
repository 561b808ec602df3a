"""The loss of QVPO: denoising regression weighted by advantages, with uniform actions beside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_aca import functional as F
from torchrl_aca.baselines.diffusion_loss import DiffusionPolicyLoss
from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.checks import check_at_least, check_choice

__all__ = ["QVPOLoss", "advantage_weight", "cutoff_weight", "entropy_coefficient"]


def advantage_weight(values: Tensor) -> Tensor:
    """``max(max_n Q_n - mean_n Q_n, 0)`` over the candidates, ``(N, *batch)`` to ``(*batch,)``."""
    return (values.amax(0) - values.mean(0)).clamp(min=0)


def cutoff_weight(values: Tensor) -> Tensor:
    """The best candidate's value where it is above 1, else 0; ``(N, *batch)`` to ``(*batch,)``."""
    best = values.amax(0)
    return best * (best > 1)


def entropy_coefficient(
    update: int, first: float = 0.02, last: float = 0.002, num_updates: int = 200_000
) -> float:
    """The weight of uniform actions, ``max(last, first * (1 - update / num_updates))``."""
    return max(last, first * (1 - update / num_updates))


WEIGHTS = {"advantage": advantage_weight, "cutoff": cutoff_weight}


class QVPOLoss(DiffusionPolicyLoss):
    """Loss module of QVPO, Q-weighted variational policy optimisation.

    Of *Diffusion-based Reinforcement Learning via Q-weighted Variational Policy Optimization*,
    arXiv 2405.16173.
    With critics ``Q_i``, ``Q = min_i Q_i``, the policy's noise network ``eps`` and its candidates
    ``a_1..a_N`` for each state, two losses, each to be had alone:

    - :meth:`qvalue_loss`: ``sum_i (Q_i(s, a) - y)^2``, ``y = c r + gamma (1 - terminated)
      min_i Q_bar_i(s', a')``;
    - :meth:`actor_loss`: the mean over ``1 + M`` actions of each state of ``w mean_j (eps(s, a_t,
      t)_j - noise_j)^2``. The first action is the best candidate, with the weight ``w = max_n Q -
      mean_n Q``; the ``M`` others are uniform in [-1, 1], with the weight ``entropy_coefficient *
      w``, and keep the policy from collapsing. Levels and noises are drawn for each action.

    ``loss.entropy_coefficient`` is a buffer, for the caller to move
    (:func:`entropy_coefficient`). The policy that acts is the moving average,
    ``average_actor_network``; candidates and targets come from the online one.

    Differences from the authors' code: the candidates are the ``N`` of acting, not 64 of their own;
    targets are drawn by the online policy and critics, acting by the moving average.

    The code base that ACA's paper compares in takes the value itself, if above 1, for a weight
    (``weight="cutoff"``), and differs in three ways that are not restated: it differentiates the
    weight through the chain, it gives the uniform actions states scrambled across rows and
    dimensions, and it steps the critics twice on the same gradient.

    Args:
        actor_network: the policy, with its critics and at least two candidates.

    Keyword Args:
        weight: ``"advantage"`` or ``"cutoff"``. Default: ``"advantage"``.
        num_uniform: ``M``. Default: 10.
        entropy_coefficient: its first value. Default: 0.02.
        reward_scale: ``c``. Default: 0.2.
        kwargs: as of :class:`DiffusionPolicyLoss`.

    What a chain draws is taken from the input where it has it: ``policy_action``, the best
    candidate in env units, with ``policy_weight``, its weight of shape ``(*batch,)``. Levels and
    noise of the regression are drawn always: there are ``1 + M`` of them for each state.

    Raises:
        ValueError: on an unknown option, a number out of range, or a policy of one candidate, whose
            advantage is zero.

    Examples:
        >>> from torchrl_aca.baselines import DiffusionPolicy, NoiseNetwork, QVPOLoss, TwinCritic
        >>> network, critic = NoiseNetwork(3, 2), TwinCritic(3, 2)
        >>> schedule = NoiseSchedule.cosine(20)
        >>> loss = QVPOLoss(DiffusionPolicy(network, schedule, critic=critic, num_candidates=4))
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> losses = loss(data)
        >>> losses["loss_actor"].backward()
        >>> acting = loss.average_actor_network
    """

    @dataclass
    class _AcceptedKeys(DiffusionPolicyLoss._AcceptedKeys):
        """Keys that ``set_keys`` can change: those of :class:`DiffusionPolicyLoss`, and two more.

        Attributes:
            policy_action: optional given best candidate at the data's states, in env units.
            policy_weight: its weight, with it.
        """

        policy_action: NestedKey = "policy_action"
        policy_weight: NestedKey = "policy_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    metric_names = ("pred_value", "target_value", "policy_weight")
    entropy_coefficient: Tensor

    def __init__(
        self,
        actor_network: DiffusionPolicy,
        *,
        weight: Literal["advantage", "cutoff"] = "advantage",
        num_uniform: int = 10,
        entropy_coefficient: float = 0.02,
        reward_scale: float = 0.2,
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, average_policy=True, reward_scale=reward_scale, **kwargs)
        check_choice(tuple(WEIGHTS), weight=weight)
        check_at_least(0, num_uniform=num_uniform, entropy_coefficient=entropy_coefficient)
        if weight == "advantage" and actor_network.num_candidates < 2:
            raise ValueError(
                "The advantage of one candidate over itself is zero: build the policy with "
                f"num_candidates >= 2, got {actor_network.num_candidates}."
            )
        self.weight = weight
        self.num_uniform = num_uniform
        coefficient = actor_network.log_alpha.new_tensor(entropy_coefficient)
        self.register_buffer("entropy_coefficient", coefficient)

    @torch.no_grad()
    def sample_policy_action(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The best candidates, ``(*batch, A)`` in env units, and their weights, ``(*batch,)``.

        :meth:`actor_loss` draws them by itself where the input has no ``policy_action``.
        """
        actor, observation = self.actor_network, self._observations(tensordict)
        candidates = actor.denoise(observation, actor.draws(len(observation))[:-1])
        values = actor.values(observation, candidates)
        best = F.select_best(candidates, values)
        weight = WEIGHTS[self.weight](values.amin(-1))
        batch = tensordict[actor.in_keys[0]].shape[:-1]
        return actor.to_env(best).reshape(*batch, -1), weight.reshape(batch)

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Denoising regression on the best candidates, by weight, and on uniform actions."""
        observation, keys = self._observations(tensordict), self.tensor_keys
        action = self._given(tensordict, keys.policy_action)
        if action is None:
            action, weight = self.sample_policy_action(tensordict)
        else:
            weight = tensordict[keys.policy_weight]
        action = self.actor_network.from_env(action).reshape(1, len(observation), -1)
        weight = weight.reshape(1, -1)
        uniform = 2 * torch.rand_like(action.expand(self.num_uniform, -1, -1)) - 1
        uniform_weight = self.entropy_coefficient * weight.expand(self.num_uniform, -1)
        error = self._denoising_error(observation, torch.cat([action, uniform]))
        error = (torch.cat([weight, uniform_weight]) * error).mean(0)
        return self._weighted("loss_actor", error, tensordict, {"policy_weight": weight.mean()})

    def _denoising_error(self, observation: Tensor, actions: Tensor) -> Tensor:
        """Errors ``(M, B)`` of the noise in several actions of each state, ``(M, B, A)``."""
        schedule = self.actor_network.schedule
        level = torch.randint(1, schedule.num_steps + 1, actions.shape[:-1], device=actions.device)
        noise = torch.randn_like(actions)
        noisy_actions = schedule.add_noise(actions, noise, level)
        return (self._predicted(observation, noisy_actions, level) - noise).square().mean(-1)
