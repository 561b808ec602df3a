"""The loss of SDAC: reverse sampling score matching towards exp(Q)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_aca import functional as F
from torchrl_aca.baselines.diffusion_loss import DiffusionPolicyLoss
from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.checks import check_above, check_at_least
from torchrl_aca.tuning import OpenLoopAlpha

__all__ = ["SDACLoss", "reverse_sampling_target"]


def reverse_sampling_target(
    draws: Tensor, values: Tensor, inverse_temperature: float | Tensor
) -> Tensor:
    """The noise of the better clean actions: ``sum_k w_k e_k``, ``w = softmax_k(beta Q_k)``.

    Args:
        draws: ``e_k``, noises that could have made the noised action, shape ``(K, *batch, A)``.
        values: ``Q_k``, the values of the clean actions that they lead back to, ``(K, *batch)``.
        inverse_temperature: ``beta``.

    Returns:
        Tensor of shape ``(*batch, A)``.
    """
    weights = torch.softmax(inverse_temperature * values, dim=0)
    return (weights.unsqueeze(-1) * draws).sum(0)


class SDACLoss(OpenLoopAlpha, DiffusionPolicyLoss):
    """Loss module of SDAC, soft diffusion actor-critic.

    Of *Efficient Online Reinforcement Learning for Diffusion Policy*, arXiv 2502.00361. With
    critics ``Q_i``, ``Q = min_i Q_i``, the policy's noise network ``eps`` and the ``alpha`` of its
    exploration, three losses, each to be had alone:

    - :meth:`qvalue_loss`: ``sum_i (Q_i(s, a) - y)^2``, ``y = c r + gamma (1 - terminated)
      min_i Q_bar_i(s', a')``;
    - :meth:`actor_loss`: ``mean_j (eps(s, a_t, t)_j - e_bar_j)^2``, where ``a_t`` is an action of
      the policy's own, noised to a uniform level ``t``; ``e_bar = sum_k w_k e_k`` is the average of
      ``num_proposals`` fresh noises, weighted by ``w_k ~ exp(beta / alpha Q(s, a_0(e_k)))`` of the
      clean actions ``a_0(e_k)`` that they lead back to (:func:`reverse_sampling_target`);
    - :meth:`alpha_loss`: ``log_alpha * stop_grad(H(alpha) - H_target)``.

    The policy that acts is the moving average, ``average_actor_network``; targets and proposals
    come from the online one.

    Differences from the authors' code: it evaluates ``eps`` once for each of the ``K`` noises and
    weighs the errors. All are at the same ``a_t``, so the gradient is that of the one error from
    the average, divided by ``K``, which Adam does not see: here the network is evaluated once.

    Args:
        actor_network: the policy, with its critics and its ``log_alpha``.

    Keyword Args:
        num_proposals: ``K``. Default: 64.
        inverse_temperature: ``beta``; that of the weights is ``beta / alpha``. Default: 5, the
            initial ``alpha``, so that it starts at 1.
        target_entropy: ``H_target`` in nats, or ``"auto"`` for ``-target_entropy_scale * A``.
        target_entropy_scale: default 0.9.
        entropy_noise_scale: the noise scale inside ``H``. Default: 0.1.
        reward_scale: ``c``. Default: 0.2.
        kwargs: as of :class:`DiffusionPolicyLoss`.

    Draws of a chain are taken from the input where it has them, ``policy_action`` too: the policy's
    action at the states of the data, in env units.

    Raises:
        ValueError: if a number is out of range, or the policy's chain has no noise schedule.

    Examples:
        >>> from torchrl_aca.baselines import DiffusionPolicy, NoiseNetwork, SDACLoss, TwinCritic
        >>> schedule = NoiseSchedule.linear(20, 1e-4, 0.999, 0.8)
        >>> loss = SDACLoss(DiffusionPolicy(NoiseNetwork(3, 2), schedule, critic=TwinCritic(3, 2)))
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> losses = loss(data)
        >>> losses["loss_actor"].backward()
        >>> acting = loss.average_actor_network
    """

    @dataclass
    class _AcceptedKeys(DiffusionPolicyLoss._AcceptedKeys):
        """Keys that ``set_keys`` can change: those of :class:`DiffusionPolicyLoss`, and one more.

        Attributes:
            policy_action: optional given action of the policy at the data's states, in env units.
        """

        policy_action: NestedKey = "policy_action"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    loss_names = ("loss_qvalue", "loss_actor", "loss_alpha")
    metric_names = ("pred_value", "target_value", "alpha", "entropy", "exploration_std")

    def __init__(
        self,
        actor_network: DiffusionPolicy,
        *,
        num_proposals: int = 64,
        inverse_temperature: float = 5.0,
        target_entropy: float | Literal["auto"] = "auto",
        target_entropy_scale: float = 0.9,
        entropy_noise_scale: float = 0.1,
        reward_scale: float = 0.2,
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, average_policy=True, reward_scale=reward_scale, **kwargs)
        check_at_least(1, num_proposals=num_proposals)
        check_at_least(0, inverse_temperature=inverse_temperature)
        check_above(0, entropy_noise_scale=entropy_noise_scale)
        self.num_proposals = num_proposals
        self.inverse_temperature = inverse_temperature
        self._init_alpha(target_entropy, target_entropy_scale, entropy_noise_scale)

    @torch.no_grad()
    def sample_policy_action(self, tensordict: TensorDictBase) -> Tensor:
        """The policy's actions at the data's states, exploration included, in env units.

        :meth:`actor_loss` draws them by itself where the input has no ``policy_action``.
        """
        return self.actor_network.sample(tensordict[self.actor_network.in_keys[0]])

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Reverse sampling score matching: regression of the noise on that of better actions."""
        observation = self._observations(tensordict)
        action = self._given(tensordict, self.tensor_keys.policy_action)
        if action is None:
            action = self.sample_policy_action(tensordict)
        action = self.actor_network.from_env(action).reshape(len(observation), -1)
        noisy_action, _, level = self._forward_noise(tensordict, action)
        target = self._average_noise(observation, noisy_action, level)
        error = (self._predicted(observation, noisy_action, level) - target).square().mean(-1)
        return self._weighted("loss_actor", error, tensordict, {})

    @torch.no_grad()
    def _average_noise(self, observation: Tensor, noisy_action: Tensor, level: Tensor) -> Tensor:
        """``e_bar`` of each noised action, ``(B, A)``."""
        schedule = self.actor_network.schedule
        draws = noisy_action.new_empty(self.num_proposals, *noisy_action.shape).normal_()
        alpha_cumprod = schedule.at(schedule.alphas_cumprod, level, noisy_action.dtype)
        clean = F.predict_clean(noisy_action, draws, alpha_cumprod)
        if bound := float(self.actor_network.clip_denoised):  # that of the policy's own estimates
            clean = clean.clamp(-bound, bound)
        values = self.actor_network.values(observation, clean).amin(-1)
        beta = self.inverse_temperature / self.log_alpha.exp()
        return reverse_sampling_target(draws, values, beta)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All three losses and their metrics; see the class."""
        out = self.qvalue_loss(tensordict)
        out.update(self.actor_loss(tensordict))
        out.update(self.alpha_loss(tensordict))
        return out

    def _tie(self) -> None:
        super()._tie()
        if "log_alpha" in self._parameters:
            self._tie_alpha()
