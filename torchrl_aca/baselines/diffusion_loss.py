"""What the losses of the diffusion-policy baselines share: networks, targets and the TD loss."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.checks import check_above, check_at_least
from torchrl_aca.td_loss import TDLoss, next_key

__all__ = ["DiffusionPolicyLoss"]


class DiffusionPolicyLoss(TDLoss):
    """Base class of losses with twin critics and a :class:`DiffusionPolicy`.

    It has the critics' loss, ``sum_i (Q_i(s, a) - y)^2`` with ``y = c r + gamma (1 - terminated)
    min_i Q_bar_i(s', a')`` and ``a'`` from the policy; a subclass has :meth:`actor_loss`.

    The loss holds the very parameters of ``actor_network.network`` and ``actor_network.critic``.
    With ``average_policy`` it also holds the policy's moving average, which the target updater
    moves with the target critics: ``average_actor_network`` is the policy with those parameters.

    Args:
        actor_network: the policy, with its critics.

    Keyword Args:
        average_policy: keep a moving average of the policy's network.
        reward_scale: ``c``. Default: 1.
        num_target_candidates: ``N`` of ``a'``. Default: the policy's ``num_candidates``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; with ``"none"`` the losses have the shape of
            the input and metrics are left out. Default: ``"mean"``.
        use_prioritized_weights: weigh rows by ``priority_weight`` where it is present. Default:
            ``"auto"``.
        use_given_draws: take random draws from the input where it has them: ``next_action`` (``a'``
            in env units), ``noise_level`` (from ``1..T``) and ``noise`` (standard normal, shape of
            the action). Default: True.

    Attributes:
        needs_schedule: whether the policy has to have a denoising chain, and so a schedule.
        num_outputs: numbers that each critic has to give.

    Raises:
        ValueError: if the policy has no critics, or not those or the chain that the loss needs, or
            a number is out of range.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            action: the action, in env units.
            value: where the value estimator finds the next state's value.
            next_action: optional given next action, in env units.
            noise_level: optional given noise levels.
            noise: optional given noise.
            priority: where the TD error for prioritised replay is written.
            reward: the reward, below ``"next"``.
            done: the done flag, below ``"next"``.
            terminated: the terminated flag, below ``"next"``.
            priority_weight: importance weights of prioritised replay.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        next_action: NestedKey = "next_action"
        noise_level: NestedKey = "noise_level"
        noise: NestedKey = "noise"
        priority: NestedKey = "td_error"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority_weight: NestedKey = "priority_weight"

    needs_schedule = True
    num_outputs = 1
    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    loss_names: tuple[str, ...] = ("loss_qvalue", "loss_actor")
    metric_names: tuple[str, ...] = ("pred_value", "target_value")

    actor_network: DiffusionPolicy
    average_actor_network: DiffusionPolicy
    policy_network: Any
    qvalue_network: Any
    policy_network_params: TensorDictParams
    target_policy_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: DiffusionPolicy,
        *,
        average_policy: bool = False,
        reward_scale: float = 1.0,
        num_target_candidates: int | None = None,
        reduction: Literal["none", "mean", "sum"] | None = None,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        use_given_draws: bool = True,
    ) -> None:
        super().__init__()
        if actor_network.critic is None:
            raise ValueError("The policy must have critics: build it with critic=... .")
        got = getattr(actor_network.critic, "num_outputs", self.num_outputs)
        if got != self.num_outputs:
            raise ValueError(
                f"{type(self).__name__} is for critics of num_outputs={self.num_outputs}, got "
                f"num_outputs={got}. Build them with that."
            )
        if self.needs_schedule and actor_network.schedule is None:
            raise ValueError(
                f"{type(self).__name__} is for denoising chains: build the policy with a "
                "NoiseSchedule, not with step sizes."
            )
        if num_target_candidates is None:
            num_target_candidates = actor_network.num_candidates
        check_at_least(1, num_target_candidates=num_target_candidates)
        check_above(0, reward_scale=reward_scale)
        # The policies are no submodules: their parameters are listed below, and only once.
        self.__dict__["actor_network"] = actor_network
        network, critic = actor_network.network, actor_network.critic
        self.average_policy = average_policy
        self.convert_to_functional(network, "policy_network", create_target_params=average_policy)
        self.convert_to_functional(critic, "qvalue_network", create_target_params=True)
        if average_policy:
            average = copy.deepcopy(network).requires_grad_(False)
            self.__dict__["average_actor_network"] = actor_network.on(average)
            self._tie()
        self.num_target_candidates = num_target_candidates
        self.reward_scale = reward_scale
        self._set_reduction(reduction)
        self.use_prioritized_weights = use_prioritized_weights
        self.use_given_draws = use_given_draws
        self.set_keys(action=actor_network.out_keys[0])

    # --- the losses -------------------------------------------------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """TD loss of the critics; writes the TD error, shape ``(*batch,)``, to ``tensordict``."""
        observation, action = self._rows(tensordict)
        target = self._target_value(tensordict)
        value = self._values(observation, action)
        difference = value - target.reshape(-1, 1)
        td_error = difference.detach().abs().amax(-1)
        tensordict.set(self.tensor_keys.priority, td_error.reshape(target.shape[:-1]))
        metrics = {"pred_value": value.detach().mean(), "target_value": target.mean()}
        return self._weighted("loss_qvalue", difference.square().sum(-1), tensordict, metrics)

    @abstractmethod
    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the policy's network; no gradient reaches the critics."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All losses and their metrics; see the class."""
        out = self.qvalue_loss(tensordict)
        out.update(self.actor_loss(tensordict))
        return out

    # --- their parts ------------------------------------------------------------------------------

    def _rows(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Observations ``(B, O)`` and actions ``(B, A)``, these in [-1, 1] units."""
        action = self.actor_network.from_env(tensordict[self.tensor_keys.action])
        return self._observations(tensordict), action.reshape(-1, action.shape[-1])

    def _observations(self, tensordict: TensorDictBase) -> Tensor:
        observation = tensordict[self.actor_network.in_keys[0]]
        return observation.reshape(-1, observation.shape[-1])

    def _values(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values ``(B, E)`` of actions in [-1, 1] units under the critics' parameters in use."""
        return self.qvalue_network.evaluate(self.qvalue_network.encode(observation), action)

    def _target_actor(self) -> DiffusionPolicy:
        """The policy that ``a'`` is from."""
        return self.actor_network

    @torch.no_grad()
    def sample_next_action(self, tensordict: TensorDictBase) -> Tensor:
        """Draws ``a'`` of the target, in env units, shape ``(*batch, A)``.

        :meth:`qvalue_loss` does so by itself where the input has no ``next_action``. Drawn
        beforehand, it lets the rest of the loss be compiled without the chain.
        """
        observation = tensordict[next_key(self.actor_network.in_keys[0])]
        return self._target_actor().sample(observation, num_candidates=self.num_target_candidates)

    def _next_rows(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Next observations ``(B, O)`` and ``a'`` ``(B, A)``, given or drawn, in [-1, 1] units."""
        action = self._given(tensordict, self.tensor_keys.next_action)
        if action is None:
            action = self.sample_next_action(tensordict)
        action = self.actor_network.from_env(action)
        return self._observations(tensordict["next"]), action.reshape(-1, action.shape[-1])

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> Tensor:
        """TD target ``y`` of shape ``(*batch, 1)``, made by the value estimator."""
        rows = self._next_rows(tensordict)
        with self._critics(self._target_params()):
            next_value = self._values(*rows).amin(-1)
        batch = tensordict[self.tensor_keys.action].shape[:-1]
        return self._td_target(tensordict, next_value.reshape(*batch, 1), self.reward_scale)

    def _forward_noise(
        self, tensordict: TensorDictBase, action: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Noised actions ``a_t`` of ``(B, A)``, their noise and their levels, given or drawn."""
        schedule = self.actor_network.schedule
        level = self._given(tensordict, self.tensor_keys.noise_level)
        if level is None:
            high = schedule.num_steps + 1
            level = torch.randint(1, high, action.shape[:-1], device=action.device)
        noise = self._given(tensordict, self.tensor_keys.noise)
        noise = torch.randn_like(action) if noise is None else noise.reshape(action.shape)
        level = level.reshape(-1)
        return schedule.add_noise(action, noise, level), noise, level

    def _predicted(self, observation: Tensor, noisy_action: Tensor, level: Tensor) -> Tensor:
        """What the policy's network says of one noisy action of each state, ``(B, A)``."""
        network = self.policy_network
        return network(network.encode(observation), noisy_action, level)

    def _weighted(
        self, name: str, error: Tensor, tensordict: TensorDictBase, metrics: dict[str, Tensor]
    ) -> TensorDict:
        """One loss from errors of shape ``(B,)``, with importance weights if there are any."""
        error = error.reshape(tensordict[self.tensor_keys.action].shape[:-1])
        weights = self._maybe_get_priority_weight(tensordict)
        return self._output(name, error, tensordict, metrics, weights)

    # --- the LossModule contract ------------------------------------------------------------------

    def _state_keys(self) -> list[NestedKey]:
        return self.actor_network.in_keys

    def _tie(self) -> None:
        """The policies hold the loss's parameters and buffers."""
        super()._tie()
        self.policy_network_params.to_module(self.policy_network)
        if self.average_policy:
            self.target_policy_network_params.to_module(self.average_actor_network.network)

    def _apply(self, fn: Callable) -> Any:
        """Take the policy along."""
        self.actor_network._apply(fn)
        return super()._apply(fn)
