"""The loss of RLPD: soft actor-critic with many critics and targets from a few of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.modules import ProbabilisticActor
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_aca.baselines.ensemble_td import EnsembleTDLoss
from torchrl_aca.checks import check_above, check_choice

__all__ = ["EnsembleSACLoss"]

# The temperature as a function of its parameter, and the way back.
TEMPERATURES: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[float], float]]] = {
    "exp": (torch.exp, math.log),
    "softplus": (nn.functional.softplus, lambda alpha: alpha + math.log(-math.expm1(-alpha))),
}


class EnsembleSACLoss(EnsembleTDLoss):
    """Loss module of RLPD (*Efficient Online RL with Offline Data*, arXiv 2302.02948).

    With critics ``Q_1..Q_E``, their targets ``Q_bar_i``, a random subset ``M`` of the members for
    each call, the policy ``pi`` and its temperature ``alpha``, three losses, each to be had alone
    as a TensorDict of its ``loss_*`` entry and metrics:

    - :meth:`qvalue_loss`: ``mean_i (Q_i(s, a) - y)^2`` with ``y = r + gamma (1 - terminated)
      (min_{i in M} Q_bar_i(s', a') - alpha log pi(a'|s'))``, ``a' ~ pi(.|s')``;
    - :meth:`actor_loss`: ``alpha log pi(a|s) - mean_i Q_i(s, a)``, ``a ~ pi(.|s)``;
    - :meth:`alpha_loss`: ``alpha * stop_grad(-log pi(a|s) - H_target)``.

    :meth:`forward` gives all three. RLPD takes many critic steps for each step of actor and
    temperature: call the methods one by one for that.

    The defaults are RLPD's for locomotion. WSRL's authors (arXiv 2412.07762) compare with another
    algorithm under this name: ``subset_with_replacement=True, actor_value="min",
    entropy_backup=False, target_entropy_scale=1.0, temperature="softplus"``; it is their online SAC
    as well. They measure the entropy of ``alpha_loss`` at next states, which is not done here.

    Why not TorchRL's ``REDQLoss``: it has this target and this actor objective, but no critic loss
    of its own, so twenty critic steps would pay for twenty actor passes; its temperature loss also
    averages over next states, and its temperature is clamped to [0.1, 10] by default. ``SACLoss``
    has separate losses, but takes the minimum over all critics.

    Log-probabilities are those of the action rescaled to [-1, 1], as in RLPD, which rescales its
    environments: so target entropy and temperature mean the same whatever the action's range. The
    actor tells the range by a bounded spec; without one, they are those of the action itself.

    No priority is written, and importance weights are not read.

    Args:
        actor_network: the policy. Its distribution must have ``rsample``.
        qvalue_network: the critics as one module with a parameter stack, such as
            ``ValueOperator(EnsembleMLP(...), in_keys=["observation", "action"])``: every parameter
            has ``E`` as its first dimension, the output has the shape ``(*batch, E)``.

    Keyword Args:
        subset_size: number of members in ``M``. Default: 2.
        subset_with_replacement: whether ``M`` may hold a member twice. Default: False.
        actor_value: what the actor maximises, the ``"mean"`` or the ``"min"`` over all members.
            Default: ``"mean"``.
        entropy_backup: keep ``-alpha log pi(a'|s')`` in the target. Default: True.
        target_entropy: ``H_target`` in nats, or ``"auto"`` for ``-target_entropy_scale * A``.
        target_entropy_scale: default 0.5.
        alpha_init: first temperature. Default: 1.0.
        temperature: ``alpha`` is ``"exp"`` or ``"softplus"`` of the trained parameter,
            ``raw_alpha``. Default: ``"exp"``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; with ``"none"`` the losses have the shape of
            the input and metrics are left out. Default: ``"mean"``.

    Raises:
        ValueError: on an unknown option, or a ``qvalue_network`` that is no stack.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor
        >>> from torchrl.modules import TanhNormal, ValueOperator
        >>> from torchrl_aca.baselines import EnsembleMLP, EnsembleSACLoss
        >>> network = torch.nn.Sequential(MLP(3, 4), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     spec=Bounded(-1.0, 1.0, (2,)),
        ...     distribution_class=TanhNormal,
        ... )
        >>> critics = ValueOperator(EnsembleMLP(3 + 2), in_keys=["observation", "action"])
        >>> loss = EnsembleSACLoss(actor, critics)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> for _ in range(20):
        ...     loss.qvalue_loss(data)["loss_qvalue"].backward()  # and a step, and a soft update
        >>> loss.actor_loss(data)["loss_actor"].backward()
        >>> loss.alpha_loss(data)["loss_alpha"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            action: the action in the data.
            value: where the value estimator finds the next state's value.
            state_action_value: the critics' output.
            log_prob: where :meth:`actor_loss` leaves its actions' log-probabilities, and
                :meth:`alpha_loss` finds them.
            reward: the reward, below ``"next"``.
            done: the done flag, below ``"next"``.
            terminated: the terminated flag, below ``"next"``.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        log_prob: NestedKey = "policy_log_prob"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    loss_names: tuple[str, ...] = ("loss_qvalue", "loss_actor", "loss_alpha")
    metric_names: tuple[str, ...] = ("pred_value", "target_value", "entropy", "alpha")

    target_entropy: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticActor,
        qvalue_network: TensorDictModule,
        *,
        subset_size: int = 2,
        subset_with_replacement: bool = False,
        actor_value: Literal["mean", "min"] = "mean",
        entropy_backup: bool = True,
        target_entropy: float | Literal["auto"] = "auto",
        target_entropy_scale: float = 0.5,
        alpha_init: float = 1.0,
        temperature: Literal["exp", "softplus"] = "exp",
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__()
        check_choice(("mean", "min"), actor_value=actor_value)
        check_choice(tuple(TEMPERATURES), temperature=temperature)
        check_above(0, alpha_init=alpha_init)
        self._set_networks(actor_network, qvalue_network, subset_size, subset_with_replacement)
        self.actor_value = actor_value
        self.entropy_backup = entropy_backup
        self.temperature = temperature
        self._set_reduction(reduction)
        self._init_entropy(alpha_init, target_entropy, target_entropy_scale)

    def _init_entropy(self, alpha_init: float, target: float | str, scale: float) -> None:
        """The temperature's parameter, its target, and the scale on which entropy is measured."""
        like = next(self.qvalue_network_params.parameters())
        _, inverse = TEMPERATURES[self.temperature]
        self.raw_alpha = nn.Parameter(like.new_tensor(inverse(alpha_init)))
        spec = self._action_spec()
        if target == "auto":
            if spec is None:
                raise ValueError(
                    'target_entropy="auto" needs the size of the action: build the actor with '
                    "spec=env.action_spec_unbatched, or give a number."
                )
            target = -scale * spec.shape[-1]
        self.register_buffer("target_entropy", like.new_tensor(target))
        log_half_range = like.new_zeros(())
        if isinstance(spec, Bounded):
            log_half_range = ((spec.space.high - spec.space.low) / 2).log().sum().to(like)
        self.register_buffer("_log_half_range", log_half_range)

    def _action_spec(self) -> TensorSpec | None:
        spec = self.actor_network.spec
        return spec.get(self._policy_action_key, None) if isinstance(spec, Composite) else spec

    # --- the three losses -------------------------------------------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """TD loss of all critics."""
        error, metrics = self._td_error(tensordict, self._next_value(tensordict["next"]))
        return self._output("loss_qvalue", error, tensordict, metrics)

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the policy; writes its log-probabilities, ``(*batch,)``, to ``tensordict``."""
        action, log_prob = self._sample(tensordict)
        values = self._values(self.qvalue_network_params.data, tensordict, action)
        value = values.mean(-1) if self.actor_value == "mean" else values.amin(-1)
        tensordict.set(self.tensor_keys.log_prob, log_prob.detach())
        metrics = {"entropy": -log_prob.detach().mean()}
        return self._output("loss_actor", self.alpha * log_prob - value, tensordict, metrics)

    def alpha_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the temperature.

        Args:
            tensordict: what :meth:`actor_loss` has seen, so that the policy is not run again; or
                any batch of observations, for which actions are drawn.
        """
        log_prob = tensordict.get(self.tensor_keys.log_prob, None)
        if log_prob is None:
            with torch.no_grad():
                _, log_prob = self._sample(tensordict)
        alpha = self._alpha()
        error = alpha * (-log_prob - self.target_entropy)
        return self._output("loss_alpha", error, tensordict, {"alpha": alpha.detach()})

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All three losses and their metrics; see the class."""
        out = self.qvalue_loss(tensordict)
        out.update(self.actor_loss(tensordict))
        out.update(self.alpha_loss(tensordict))
        return out

    @property
    def alpha(self) -> Tensor:
        """The temperature, without gradient."""
        return self._alpha().detach()

    # --- their parts ------------------------------------------------------------------------------

    def _alpha(self) -> Tensor:
        function, _ = TEMPERATURES[self.temperature]
        return function(self.raw_alpha)

    def _sample(
        self, tensordict: TensorDictBase, num: tuple[int, ...] = ()
    ) -> tuple[Tensor, Tensor]:
        """Reparametrised actions ``(*num, *batch, A)`` in env units, and log-probabilities.

        The probability is of the very draw: recovering that from a rounded action would fail where
        tanh saturates.
        """
        actor = self.actor_network
        distribution = actor.get_dist(tensordict.select(*actor.in_keys))
        action, log_prob = rsample_and_log_prob(distribution, num)
        return action, log_prob + self._log_half_range

    @torch.no_grad()
    def _next_value(self, states: TensorDictBase) -> Tensor:
        """What the target bootstraps from, ``(*batch,)``: one action, a few members."""
        action, log_prob = self._sample(states)
        value = self._target_subset_value(states, action)
        return value - self.alpha * log_prob if self.entropy_backup else value

    def _td_error(
        self, tensordict: TensorDictBase, next_value: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """``mean_i (Q_i(s, a) - y)^2``, ``(*batch,)``, and metrics."""
        target = self._td_target(tensordict, next_value.unsqueeze(-1))
        action = tensordict[self.tensor_keys.action]
        value = self._values(self.qvalue_network_params, tensordict, action)
        error = (value - target).square().mean(-1)
        return error, {"pred_value": value.detach().mean(), "target_value": target.mean()}
