"""What a loss tunes beside its critics: the exploration noise's alpha, the guidance weight."""

from __future__ import annotations

import math
from typing import Any, Literal, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_aca import functional as F
from torchrl_aca.checks import check_above, check_at_least, check_choice

__all__ = ["AutoGuidance", "OpenLoopAlpha"]

LOG_STEP = 0.1  # half the difference in log w by which the automatic guidance weight looks about


class OpenLoopAlpha:
    """Mixin of a loss whose actor explores with noise ``N(0, (noise_scale * alpha)^2 I)``.

    ``alpha`` follows a schedule that depends on no data, towards the noise whose entropy is
    ``H_target``: :meth:`alpha_loss`. The loss holds the very ``log_alpha`` of its actor.
    """

    actor_network: Any
    log_alpha: Tensor
    target_entropy: Tensor
    entropy_noise_scale: float
    reduction: str

    def _init_alpha(
        self, target_entropy: float | Literal["auto"], scale: float, noise_scale: float
    ) -> None:
        """Take over the actor's ``log_alpha``; ``"auto"`` is ``-scale * A``."""
        self.log_alpha = self.actor_network.log_alpha
        self.entropy_noise_scale = noise_scale
        if target_entropy == "auto":
            target_entropy = -scale * self.actor_network.action_dim
        target = self.log_alpha.new_tensor(target_entropy)
        cast(nn.Module, self).register_buffer("target_entropy", target)

    def _tie_alpha(self) -> None:
        """Give the actor the loss's ``log_alpha``."""
        self.actor_network.log_alpha = self.log_alpha

    def alpha_loss(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        """Open-loop schedule of the exploration noise; depends on no data.

        Args:
            tensordict: gives the shape of the loss where ``reduction="none"``; otherwise unused.
        """
        actor = self.actor_network
        with torch.no_grad():
            entropy = F.surrogate_entropy(
                self.log_alpha, actor.action_dim, self.entropy_noise_scale
            )
        loss = self.log_alpha * (entropy - self.target_entropy)
        alpha = self.log_alpha.detach().exp()
        if self.reduction == "none" and tensordict is not None:
            shape = tensordict.batch_size
            return TensorDict({"loss_alpha": loss.expand(shape)}, batch_size=shape)
        metrics = {
            "alpha": alpha,
            "entropy": entropy,
            "exploration_std": alpha * actor.exploration_noise,
        }
        return TensorDict({"loss_alpha": loss, **metrics})


class AutoGuidance:
    """Mixin of a loss that moves its actor's guidance weight ``w``, if it is to be ``"auto"``.

    The target's candidates tell where to: :meth:`step_guidance_weight`. The loss holds the very
    buffer of its actor.
    """

    actor_network: Any
    tensor_keys: Any
    guidance_weight: Tensor
    target_entropy: Tensor
    target_spread: Tensor
    num_target_candidates: int

    def _init_guidance(
        self,
        guidance_weight: Literal["fixed", "auto"],
        lr: float,
        target_spread: float | Literal["auto"],
    ) -> None:
        """Take over the actor's weight; an ``"auto"`` spread follows from the target entropy."""
        actor = self.actor_network
        check_choice(("fixed", "auto"), guidance_weight=guidance_weight)
        check_above(0, guidance_weight_lr=lr)
        self.auto_guidance, self.guidance_weight_lr = guidance_weight == "auto", lr
        if self.auto_guidance:
            check_at_least(2, num_target_candidates=self.num_target_candidates)
            check_above(0, guidance_weight_of_the_actor=float(actor.guidance_weight))
        if target_spread == "auto":
            spread = F.entropy_std(self.target_entropy, actor.action_dim)
        else:
            check_above(0, target_spread=target_spread)
            spread = self.target_entropy.new_tensor(target_spread)
        module = cast(nn.Module, self)
        module.register_buffer("guidance_weight", actor.guidance_weight)
        module.register_buffer("target_spread", spread, persistent=False)

    def _tie_guidance(self) -> None:
        """Take the actor's buffer, whatever has become of it."""
        self.guidance_weight = self.actor_network.guidance_weight

    def _candidates(self, features: Any, noise: Tensor) -> Tensor:
        """The target's candidates ``(N, B, A)``; to tune ``w``, from a little above and below."""
        actor = self.actor_network
        if not self.auto_guidance:
            return actor.propose(features, noise)
        weights = [self.guidance_weight * math.exp(sign * LOG_STEP) for sign in (1, -1)]
        halves = zip(noise.tensor_split(2, dim=1), weights, strict=True)
        return torch.cat([actor.propose(features, half, weight) for half, weight in halves])

    def _note_guidance(
        self, tensordict: TensorDictBase, candidates: Tensor, values: Tensor
    ) -> None:
        """Write what :meth:`step_guidance_weight` reads, each of the batch's shape."""
        keys = self.tensor_keys
        batch = tensordict[keys.action].shape[:-1]
        spread, gain = F.candidate_spread(candidates), F.guidance_gain(values, 2 * LOG_STEP)
        tensordict.set(keys.candidate_spread, spread.reshape(batch))
        tensordict.set(keys.guidance_gain, gain.reshape(batch))

    @torch.no_grad()
    def step_guidance_weight(self, tensordict: TensorDictBase) -> TensorDict:
        """Move ``log w`` by ``guidance_weight_lr`` times :func:`~.functional.guidance_step`.

        Args:
            tensordict: a batch that :meth:`qvalue_loss` or :meth:`sample_next_action` has seen,
                with ``guidance_weight="auto"``: they write what is read here.

        Returns:
            The metrics ``guidance_weight``, ``candidate_spread`` and ``guidance_gain``.

        Raises:
            KeyError: if they have not written it.
        """
        keys = self.tensor_keys
        # Terminal states may hold NaN, which no other loss sees either; of them alone is no step.
        spread = tensordict[keys.candidate_spread].square().nanmean().sqrt()
        gain = tensordict[keys.guidance_gain].nanmean()
        step = F.guidance_step(spread, self.target_spread, gain).nan_to_num(nan=0.0)
        # In place: actor, loss and whoever else holds the weight see the new one.
        self.guidance_weight.mul_((self.guidance_weight_lr * step).exp())
        metrics = {"candidate_spread": spread, "guidance_gain": gain}
        return TensorDict({"guidance_weight": self.guidance_weight.to(spread.dtype), **metrics})
