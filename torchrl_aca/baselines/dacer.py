"""DACER: a diffusion policy that climbs the critics through its whole chain."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torch.nn.functional import softplus

from torchrl_aca.baselines.diffusion_loss import DiffusionPolicyLoss
from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.baselines.gmm import fit_gmm, gmm_entropy
from torchrl_aca.checks import check_above, check_at_least

__all__ = ["DACERLoss", "distributional_error", "running_scale"]


class DACERLoss(DiffusionPolicyLoss):
    """Loss module of DACER (*Diffusion Actor-Critic with Entropy Regulator*, arXiv 2405.15177).

    Each critic tells the mean ``q_i`` and the standard deviation of the return. Three losses, each
    to be had alone as a TensorDict of its ``loss_*`` entry and metrics:

    - :meth:`qvalue_loss`: :func:`distributional_error` with the target's mean ``y`` and a draw
      ``y_z``, both of the target critic ``j`` whose mean is smaller, ``a'`` from the policy;
    - :meth:`actor_loss`: ``-min_i q_i(s, a)``, ``a`` from the policy, differentiated through every
      step of its chain and through its clips;
    - :meth:`alpha_loss`: ``log_alpha * stop_grad(H - H_target)``, with the entropy ``H`` estimated
      by mixtures of Gaussians that are fitted to actions of each state (:func:`fit_gmm`).

    The first moves the running scale ``M`` of each critic. It is used at once, and kept by
    :meth:`step_scale`, to be called after each step of the critics.

    How it differs from its authors' code: the mixtures are fitted in torch, all states at a time,
    from far-apart samples; there by scikit-learn.

    Args:
        actor_network: the policy, with critics of two outputs
            (``TwinCritic(..., num_outputs=2)``); usually one candidate, ``clip_action=True``.

    Keyword Args:
        target_entropy: ``H_target`` in nats of actions in [-1, 1], or ``"auto"`` for
            ``-target_entropy_scale * A``.
        target_entropy_scale: default 0.9.
        num_entropy_samples: actions of each state for the entropy. Default: 200.
        num_components: Gaussians of its mixtures. Default: 3.
        scale_tau: rate of the running scale ``M``. Default: 0.005.
        kwargs: those of :class:`DiffusionPolicyLoss`, without ``average_policy``.

    Raises:
        ValueError: if a number is out of range, or the critics have not two outputs.

    Examples:
        >>> from torchrl_aca.baselines import DACERLoss, DiffusionPolicy, NoiseNetwork, TwinCritic
        >>> critic = TwinCritic(3, 2, num_outputs=2)
        >>> policy = DiffusionPolicy(
        ...     NoiseNetwork(3, 2), NoiseSchedule.vp(20), critic=critic, exploration_noise=0.1,
        ...     alpha_init=3.0, clip_action=True,
        ... )
        >>> loss = DACERLoss(policy)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> loss.qvalue_loss(data)["loss_qvalue"].backward()  # and a step
        >>> loss.step_scale()
        >>> loss.actor_loss(data)["loss_actor"].backward()  # and a step, and a soft update
        >>> loss.alpha_loss(data)["loss_alpha"].backward()  # rarely
    """

    loss_names = ("loss_qvalue", "loss_actor", "loss_alpha")
    metric_names = (
        "pred_value",
        "target_value",
        "value_std",
        "alpha",
        "entropy",
        "exploration_std",
    )
    num_outputs = 2  # mean and standard deviation
    target_entropy: Tensor
    scale: Tensor
    next_scale: Tensor

    def __init__(
        self,
        actor_network: DiffusionPolicy,
        *,
        target_entropy: float | Literal["auto"] = "auto",
        target_entropy_scale: float = 0.9,
        num_entropy_samples: int = 200,
        num_components: int = 3,
        scale_tau: float = 0.005,
        **kwargs: Any,
    ) -> None:
        check_at_least(1, num_components=num_components)
        check_at_least(num_components, num_entropy_samples=num_entropy_samples)
        check_above(0, scale_tau=scale_tau)
        super().__init__(actor_network, **kwargs)
        self.log_alpha = actor_network.log_alpha
        self.num_entropy_samples = num_entropy_samples
        self.num_components = num_components
        self.scale_tau = scale_tau
        if target_entropy == "auto":
            target_entropy = -target_entropy_scale * actor_network.action_dim
        self.register_buffer("target_entropy", self.log_alpha.new_tensor(target_entropy))
        # One for each critic; zero says that there was no batch yet.
        zeros = self.log_alpha.new_zeros(actor_network.critic.num_critics)
        self.register_buffer("scale", zeros)
        self.register_buffer("next_scale", zeros.clone())

    # --- the losses -------------------------------------------------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Distributional loss of the critics; writes the TD error of the means, ``(*batch,)``."""
        observation, action = self._rows(tensordict)
        target, target_draw = self._targets(tensordict)
        mean, std = self._gaussians(observation, action)
        scale = running_scale(self.scale, std, self.scale_tau)
        self.next_scale.copy_(scale)
        error = distributional_error(mean, std, target, target_draw, scale).sum(-1)
        batch = tensordict[self.tensor_keys.action].shape[:-1]
        td_error = (mean.detach() - target).abs().amax(-1)
        tensordict.set(self.tensor_keys.priority, td_error.reshape(batch))
        metrics = {
            "pred_value": mean.detach().mean(),
            "target_value": target.mean(),
            "value_std": std.detach().mean(),
        }
        return self._weighted("loss_qvalue", error, tensordict, metrics)

    def step_scale(self) -> None:
        """Keep the running scale that the latest :meth:`qvalue_loss` has used."""
        self.scale.copy_(self.next_scale)

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Minus the value of the policy's actions; no gradient reaches the critics."""
        actor, observation = self.actor_network, self._observations(tensordict)
        draws = actor.draws(len(observation))
        action = actor.explore(actor.denoise(observation, draws[:-1]), draws[-1])[0]
        with self._critics(self.qvalue_network_params.data):
            mean, _ = self._gaussians(observation, action)
        return self._weighted("loss_actor", -mean.amin(-1), tensordict, {})

    def alpha_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the exploration noise, by the policy's entropy in each state."""
        entropy = self.entropy(tensordict)
        error = self.log_alpha * (entropy - self.target_entropy)
        alpha = self.log_alpha.detach().exp()
        metrics = {
            "alpha": alpha,
            "entropy": entropy.mean(),
            "exploration_std": alpha * self.actor_network.exploration_noise,
        }
        return self._weighted("loss_alpha", error, tensordict, metrics)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All three losses and their metrics; see the class."""
        out = super().forward(tensordict)
        return out.update(self.alpha_loss(tensordict))

    # --- their parts ------------------------------------------------------------------------------

    @torch.no_grad()
    def entropy(self, tensordict: TensorDictBase) -> Tensor:
        """Entropy of the policy in nats of actions in [-1, 1], with its noise: shape ``(B,)``."""
        actor, observation = self.actor_network, self._observations(tensordict)
        draws = actor.draws(len(observation), self.num_entropy_samples)
        actions = actor.explore(actor.denoise(observation, draws[:-1]), draws[-1])
        # Actions at the bounds have covariances near the loading, too small for float32.
        mixture = fit_gmm(actions.movedim(0, 1).double(), self.num_components)
        return gmm_entropy(mixture).to(actions.dtype)

    def _gaussians(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Means and standard deviations ``(B, E)`` under the critics' parameters in use."""
        mean, raw_std = self._values(observation, action).unbind(-1)
        return mean, softplus(raw_std)

    @torch.no_grad()
    def _targets(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Mean of the target and a draw of it, ``(B, 1)`` each, made by the value estimator."""
        rows = self._next_rows(tensordict)
        with self._critics(self._target_params()):
            mean, std = self._gaussians(*rows)
        noise = torch.randn(mean.shape, dtype=mean.dtype, device=mean.device)
        draw = mean + std * noise.clamp(-3, 3)
        smaller = mean.argmin(-1, keepdim=True)
        batch = tensordict[self.tensor_keys.action].shape[:-1]
        target, target_draw = (
            self._td_target(
                tensordict, values.gather(-1, smaller).reshape(*batch, 1), self.reward_scale
            ).reshape(-1, 1)
            for values in (mean, draw)
        )
        return target, target_draw

    def _tie(self) -> None:
        """The policy holds the loss's ``log_alpha``."""
        super()._tie()
        self.actor_network.log_alpha = self.log_alpha


def distributional_error(
    mean: Tensor,
    std: Tensor,
    target: Tensor,
    target_draw: Tensor,
    scale: Tensor,
    eps: float = 0.1,
) -> Tensor:
    """Errors of critics that tell a Gaussian of the return (DSAC-T), shape of ``mean``.

    With ``y`` the target's mean, ``y_z`` a draw of the target, ``M`` the critic's running standard
    deviation and ``y_b = q + clip(y_z - q, -3M, 3M)``::

        -(M^2 + eps) (q sg[(y - q) / (std^2 + eps)]
                      + std sg[((q - y_b)^2 - std^2) / (std^3 + eps)])

    whose gradient, not whose value, means something.

    Args:
        mean: the critics' means ``q``, shape ``(*batch, E)``.
        std: their standard deviations, same shape.
        target: ``y``, shape ``(*batch, 1)``.
        target_draw: ``y_z``, broadcastable to that of ``mean``.
        scale: ``M``, shape ``(E,)``.
        eps: keeps the divisions bounded. Default: 0.1.
    """
    q, deviation = mean.detach(), std.detach()
    bounded = q + torch.minimum((target_draw - q).maximum(-3 * scale), 3 * scale)
    by_mean = (target - q) / (deviation.square() + eps)
    by_std = ((q - bounded).square() - deviation.square()) / (deviation.pow(3) + eps)
    return -(scale.square() + eps) * (mean * by_mean + std * by_std)


def running_scale(scale: Tensor, std: Tensor, tau: float) -> Tensor:
    """``M`` after another batch: ``tau mean(std) + (1 - tau) M``, and the first batch's mean.

    Args:
        scale: ``M`` so far, shape ``(E,)``; zero before the first batch.
        std: the critics' standard deviations, shape ``(*batch, E)``.
        tau: rate.
    """
    latest = std.detach().reshape(-1, std.shape[-1]).mean(0)
    return torch.where(scale > 0, tau * latest + (1 - tau) * scale, latest)
