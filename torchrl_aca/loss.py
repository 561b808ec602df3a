"""The loss of ACA: TD regression at level 0, noise-level regression above it, alpha's schedule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import distance_loss

from torchrl_aca import functional as F
from torchrl_aca.actor import CriticGuidedDenoisingActor
from torchrl_aca.checks import check_above, check_at_least, check_choice
from torchrl_aca.critic import NoiseLevelCriticBase
from torchrl_aca.td_loss import TDLoss, next_key
from torchrl_aca.tuning import AutoGuidance, OpenLoopAlpha

__all__ = ["ACALoss"]


class ACALoss(OpenLoopAlpha, AutoGuidance, TDLoss):
    """Loss module of *Actor-Critic without Actor* (arXiv 2509.21022).

    Three losses, each to be had alone as a TensorDict of its ``loss_*`` entry and metrics:

    - :meth:`qvalue_loss`: ``sum_i (Q_i(s, a_0, 0) - y)^2`` with ``y = c r + gamma (1 - terminated)
      min_i Q_bar_i(s', a'_0, 0)``, ``a'_0`` from the actor on the online critics, exploration noise
      included;
    - :meth:`noise_level_loss`: ``sum_i (Q_i(s, a_t, t) - stop_grad(target))^2`` with ``t`` uniform
      over the noisy levels, where the target is made of ``Q(s, a_0, 0)``;
    - :meth:`alpha_loss`: ``log_alpha * stop_grad(H(alpha) - H_target)``.

    :meth:`forward` gives all three, as the paper's summed objective (whose second loss has
    ``noise_level_target="self"``). The official code instead
    takes an optimiser step on the first, and at every second update another on the second,
    computed after the first step: call the methods one by one for that.

    The loss holds the very parameters of ``actor_network.critic`` and its ``log_alpha``, so actor,
    optimiser and collector never need synchronising in one process. (``load_state_dict`` with
    ``assign=True`` is for the loss; an actor that is loaded so leaves its loss behind.) Buffers of
    a critic of one's own, running statistics say, are shared in the same way, through casts and
    copies; the target critics take over the online buffers as they are, for target updaters move
    parameters alone.

    Args:
        actor_network: the actor; its critic is the network that is trained.

    Keyword Args:
        qvalue_network: may be passed for symmetry with TorchRL's losses; must be the actor's
            critic.
        num_target_candidates: ``N`` of ``a'_0``. Default: the actor's ``num_candidates``.
        target_value: value of the next state: of the ``"best"`` candidate (paper), or the
            ``"soft"`` value of all of them, each with exploration noise of its own:
            ``tau log mean_n exp(min_i Q_bar_i(s', a'_n, 0) / tau)``. Default: ``"best"``.
        temperature: ``tau`` of the soft value, in scaled reward. Default: 0.1.
        guidance_weight: ``"fixed"``, or ``"auto"`` for :meth:`step_guidance_weight`, which moves
            the actor's ``w`` from where it is; it needs two target candidates or more. Default:
            ``"fixed"``, the paper.
        guidance_weight_lr: rate of the steps on ``log w``. Default: 0.01.
        target_spread: standard deviation below which those steps do not press the candidates, in
            critic units, or ``"auto"`` for that of a Gaussian of the target entropy,
            ``exp(H_target / A) / sqrt(2 pi e)``. Default: ``"auto"``.
        noise_level_target: ``"mean"`` over the critics (official code), each critic's own value,
            ``"self"`` (paper), or ``"target"``, the mean over the target critics (NC-LQL). Default:
            ``"mean"``.
        target_entropy: ``H_target`` in nats, or ``"auto"`` for ``-target_entropy_scale * A``.
        target_entropy_scale: default 0.9.
        entropy_noise_scale: the noise scale inside ``H``. The official code has 0.1 here whatever
            the exploration noise. Default: 0.1.
        reward_scale: ``c``. Default: 0.2.
        loss_function: distance of both regressions. Default: ``"l2"``.
        delay_qvalue: bootstrap from target parameters, to be moved by a ``SoftUpdate`` or
            ``HardUpdate``. Default: True.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; with ``"none"`` the losses have the shape of
            the input and metrics are left out. Default: ``"mean"``.
        use_prioritized_weights: weigh rows by ``priority_weight`` where it is present. Default:
            ``"auto"``.
        use_given_draws: take random draws from the input where it has them, see below; False draws
            always. Default: True.

    Random draws are taken from the input where it has them: ``noise_level`` (from ``1..T``),
    ``noise`` (standard normal, shape of the action) and ``next_action`` (``a'_0`` in env units; all
    of them, of shape ``(*batch, N, A)``, with ``target_value="soft"``).
    Where replay data hold entries of these names that mean something else, rename what the loss
    looks for with :meth:`set_keys`, or pass ``use_given_draws=False``.

    Raises:
        ValueError: on an unknown option, or a ``qvalue_network`` that is not the actor's critic.
        TypeError: if ``actor_network`` is no such actor.

    Examples:
        >>> actor = CriticGuidedDenoisingActor(NoiseLevelCritic(3, 2), NoiseSchedule.cosine(20))
        >>> loss = ACALoss(actor, num_target_candidates=4)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> losses = loss(data)
        >>> total = losses["loss_qvalue"] + losses["loss_noise_level"] + losses["loss_alpha"]
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            action: the action, in env units.
            value: where the value estimator finds the next state's value.
            state_action_value: the critic's output.
            noise_level: optional given noise levels.
            noise: optional given noise of the noise-level loss.
            next_action: optional given next action, in env units.
            candidate_spread: where the spread of the target's candidates is written.
            guidance_gain: where their gain by more guidance is written.
            priority: where the TD error for prioritised replay is written.
            reward: the reward, below ``"next"``.
            done: the done flag, below ``"next"``.
            terminated: the terminated flag, below ``"next"``.
            priority_weight: importance weights of prioritised replay.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        noise_level: NestedKey = "noise_level"
        noise: NestedKey = "noise"
        next_action: NestedKey = "next_action"
        candidate_spread: NestedKey = "candidate_spread"
        guidance_gain: NestedKey = "guidance_gain"
        priority: NestedKey = "td_error"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    loss_names = ("loss_qvalue", "loss_noise_level", "loss_alpha")
    metric_names = (
        "pred_value",
        "target_value",
        "noisy_value",
        "alpha",
        "entropy",
        "exploration_std",
    )
    SUPPORTED_VALUE_ESTIMATORS = (
        ValueEstimators.TD0,
        ValueEstimators.TD1,
        ValueEstimators.TDLambda,
    )

    actor_network: CriticGuidedDenoisingActor
    qvalue_network: NoiseLevelCriticBase

    def __init__(
        self,
        actor_network: CriticGuidedDenoisingActor,
        *,
        qvalue_network: nn.Module | None = None,
        num_target_candidates: int | None = None,
        target_value: Literal["best", "soft"] = "best",
        temperature: float = 0.1,
        guidance_weight: Literal["fixed", "auto"] = "fixed",
        guidance_weight_lr: float = 0.01,
        target_spread: float | Literal["auto"] = "auto",
        noise_level_target: Literal["mean", "self", "target"] = "mean",
        target_entropy: float | Literal["auto"] = "auto",
        target_entropy_scale: float = 0.9,
        entropy_noise_scale: float = 0.1,
        reward_scale: float = 0.2,
        loss_function: str = "l2",
        delay_qvalue: bool = True,
        reduction: Literal["none", "mean", "sum"] | None = None,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        use_given_draws: bool = True,
    ) -> None:
        super().__init__()
        if not isinstance(getattr(actor_network, "critic", None), NoiseLevelCriticBase):
            raise TypeError(
                f"ACALoss expects a CriticGuidedDenoisingActor, got {type(actor_network).__name__}."
                " Build one on your critic: the actor holds the critic that is trained."
            )
        critic = actor_network.critic
        if qvalue_network not in (None, critic, getattr(critic, "module", None)):
            raise ValueError(
                "qvalue_network must be actor_network.critic: in ACA the critic is the actor. "
                "Leave it out, or build the actor with this network."
            )
        check_choice(("mean", "self", "target"), noise_level_target=noise_level_target)
        if num_target_candidates is None:
            num_target_candidates = actor_network.num_candidates
        check_at_least(1, num_target_candidates=num_target_candidates)
        check_choice(("best", "soft"), target_value=target_value)
        check_above(0, temperature=temperature, entropy_noise_scale=entropy_noise_scale)
        check_choice(("l1", "l2", "smooth_l1"), loss_function=loss_function)
        # The actor is no submodule: its parameters are listed below, and only once.
        self.__dict__["actor_network"] = actor_network
        self.convert_to_functional(critic, "qvalue_network", create_target_params=delay_qvalue)
        self.delay_qvalue = delay_qvalue
        self.num_target_candidates = num_target_candidates
        self.target_value, self.temperature = target_value, temperature
        self.noise_level_target = noise_level_target
        self.reward_scale = reward_scale
        self.loss_function = loss_function
        self._set_reduction(reduction)
        self.use_prioritized_weights = use_prioritized_weights
        self.use_given_draws = use_given_draws
        self._init_alpha(target_entropy, target_entropy_scale, entropy_noise_scale)
        self._init_guidance(guidance_weight, guidance_weight_lr, target_spread)
        self.set_keys(
            action=actor_network.out_keys[0],
            state_action_value=critic.value_key,
            noise_level=critic.noise_level_key,
        )

    # --- the three losses -------------------------------------------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """TD loss at level 0; writes the TD error, shape ``(*batch,)``, to ``tensordict``."""
        observation, action = self._state_and_action(tensordict)
        target = self._target_value(tensordict)
        with self._critics(self.qvalue_network_params):
            features = self.actor_network.encode(observation, action.shape[:-1])
            value = self._values(features, action, self._clean_level(action))
        error = distance_loss(value, target.expand_as(value), self.loss_function).sum(-1)
        td_error = (value.detach() - target).abs().amax(-1)
        tensordict.set(self.tensor_keys.priority, td_error)
        metrics = {"pred_value": value.detach().mean(), "target_value": target.mean()}
        weights = self._maybe_get_priority_weight(tensordict)
        return self._output("loss_qvalue", error, tensordict, metrics, weights)

    def noise_level_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Regression of ``Q(s, a_t, t)`` on ``Q(s, a_0, 0)``."""
        observation, action = self._state_and_action(tensordict)
        schedule = self.actor_network.schedule
        level = self._given(tensordict, self.tensor_keys.noise_level)
        if level is None:
            shape, high = action.shape[:-1], schedule.num_steps + 1
            level = torch.randint(1, high, shape, device=action.device)
        noise = self._given(tensordict, self.tensor_keys.noise)
        noise = torch.randn_like(action) if noise is None else noise
        noisy_action = schedule.add_noise(action, noise, level)
        with self._critics(self.qvalue_network_params):
            features = self.actor_network.encode(observation, action.shape[:-1])
            clean_value = self._clean_value(features, observation, action)
            value = self._values(features, noisy_action, level)
        target = F.noise_level_target(clean_value, self.noise_level_target)
        error = distance_loss(value, target, self.loss_function).sum(-1)
        metrics = {"noisy_value": value.detach().mean()}
        weights = self._maybe_get_priority_weight(tensordict)
        return self._output("loss_noise_level", error, tensordict, metrics, weights)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All three losses and their metrics; see the class."""
        out = self.qvalue_loss(tensordict)
        out.update(self.noise_level_loss(tensordict))
        out.update(self.alpha_loss(tensordict))
        return out

    # --- their parts ------------------------------------------------------------------------------

    def _values(self, features: Any, action: Tensor, level: Tensor) -> Tensor:
        """Critic values of shape ``(*batch, E)``."""
        rows = action.reshape(-1, action.shape[-1])
        value = self.qvalue_network.evaluate(features, rows, level.reshape(-1))
        return value.reshape(*action.shape[:-1], value.shape[-1])

    @torch.no_grad()
    def sample_next_action(self, tensordict: TensorDictBase) -> Tensor:
        """Draws ``a'_0`` of the target, in env units, shape ``(*batch, A)``.

        With ``target_value="soft"`` it is all candidates, of shape ``(*batch, N, A)``.

        :meth:`qvalue_loss` does so by itself where the input has no ``next_action``. Drawn
        beforehand, it lets the rest of the loss be compiled without the chain. With
        ``guidance_weight="auto"`` it writes the spread of the candidates and their gain by more
        guidance to ``tensordict``, both of shape ``(*batch,)``.
        """
        actor = self.actor_network
        observation = [tensordict[next_key(key)] for key in actor.in_keys]
        batch = tensordict[self.tensor_keys.action].shape[:-1]
        features = actor.encode(observation, batch)
        draws = actor.draws(batch.numel(), self.num_target_candidates)
        candidates = self._candidates(features, draws[:-1])
        soft = self.target_value == "soft"
        choosing = not soft and len(candidates) > 1
        if self.auto_guidance or choosing:
            values = actor.values(features, candidates)
        if self.auto_guidance:
            self._note_guidance(tensordict, candidates, values)
        if soft:
            action = actor.explore(candidates, draws[-1]).movedim(0, 1)
        else:
            best = F.select_best(candidates, values) if choosing else candidates[0]
            action = actor.explore(best, draws[-1, 0])
        return actor.to_env(action).reshape(*batch, *action.shape[1:])

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> Tensor:
        """TD target ``y`` of shape ``(*batch, 1)``, made by the value estimator."""
        actor, keys = self.actor_network, self.tensor_keys
        observation = [tensordict[next_key(key)] for key in actor.in_keys]
        next_action = self._given(tensordict, keys.next_action)
        if next_action is None:
            next_action = self.sample_next_action(tensordict)
        next_action = actor.from_env(next_action)
        batch = tensordict[keys.action].shape[:-1]
        with self._critics(self._target_params()):
            features = actor.encode(observation, batch)
            if self.target_value == "soft":
                next_value = self._soft_value(features, next_action).reshape(*batch, 1)
            else:
                next_values = self._values(features, next_action, self._clean_level(next_action))
                next_value = next_values.amin(-1, keepdim=True)
        return self._td_target(tensordict, next_value, self.reward_scale)

    def _soft_value(self, features: Any, actions: Tensor) -> Tensor:
        """Soft value ``(B,)`` of actions ``(*batch, N, A)``, in one pass over ``N B`` rows."""
        candidates = actions.reshape(-1, *actions.shape[-2:]).movedim(1, 0)
        level = torch.zeros((), dtype=torch.long, device=actions.device)
        values = self.qvalue_network.evaluate(features, candidates, level)
        return F.soft_value(values, self.temperature)

    @torch.no_grad()
    def _clean_value(self, features: Any, observation: list[Tensor], action: Tensor) -> Tensor:
        """What the noisy levels learn, ``(*batch, E)``: by the online critics or their targets."""
        if self.noise_level_target != "target":
            return self._values(features, action, self._clean_level(action))
        with self._critics(self._target_params()):
            features = self.actor_network.encode(observation, action.shape[:-1])
            return self._values(features, action, self._clean_level(action))

    def _state_and_action(self, tensordict: TensorDictBase) -> tuple[list[Tensor], Tensor]:
        """Observations as they are, and the action in critic units."""
        action = tensordict[self.tensor_keys.action]
        observation = [tensordict[key] for key in self.actor_network.in_keys]
        return observation, self.actor_network.from_env(action)

    @staticmethod
    def _clean_level(action: Tensor) -> Tensor:
        return torch.zeros(action.shape[:-1], dtype=torch.long, device=action.device)

    # --- the LossModule contract ------------------------------------------------------------------

    def _state_keys(self) -> list[NestedKey]:
        return self.actor_network.in_keys

    def _tie(self) -> None:
        """The actor holds the loss's parameters and buffers."""
        super()._tie()
        self._tie_alpha()
        self._tie_guidance()

    def __setattr__(self, name: str, value: Any) -> None:
        """A ``guidance_weight`` that is set or loaded goes to the actor, whose buffer it is."""
        actor = self.__dict__.get("actor_network")
        if name == "guidance_weight" and actor is not None and value is not actor.guidance_weight:
            actor.guidance_weight = value
        else:
            super().__setattr__(name, value)

    def _apply(self, fn: Callable) -> ACALoss:
        """Take the actor along."""
        self.actor_network._apply(fn)
        return super()._apply(fn)
