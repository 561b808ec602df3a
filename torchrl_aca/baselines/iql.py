"""The losses of IQL with an ensemble of critics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from torchrl_aca.baselines.ensemble_td import EnsembleTDLoss
from torchrl_aca.checks import check_above

__all__ = ["EnsembleIQLLoss"]


class EnsembleIQLLoss(EnsembleTDLoss):
    """Loss module of IQL (*Implicit Q-Learning*, arXiv 2110.06169) with an ensemble.

    No action is evaluated that is not in the data. With critics ``Q_1..Q_E``, their targets
    ``Q_bar_i``, a random subset ``M`` of the members for each call, a state value ``V`` and the
    policy ``pi``, three losses, each to be had alone as a TensorDict of its ``loss_*`` entry and
    metrics:

    - :meth:`value_loss`: ``|tau - 1(u < 0)| u^2`` with ``u = min_{i in M} Q_bar_i(s, a) - V(s)``
      (paper, eq. 5);
    - :meth:`qvalue_loss`: ``mean_i (Q_i(s, a) - y)^2`` with ``y = r + gamma (1 - terminated)
      V(s')`` (eq. 6); ``V`` is the online one;
    - :meth:`actor_loss`: ``-min(exp(beta u), max_weight) log pi(a|s)`` (eq. 7), with a subset of
      its own.

    It is TorchRL's ``IQLLoss`` with targets from a few members, as in the code of WSRL's authors
    (arXiv 2412.07762) with ten critics; with ``subset_size=E`` and without replacement the two
    have the same values and gradients, but that the critics' loss is a mean over members here and a
    sum there. A subclass of it would evaluate all ten target critics for each of two minima, and
    has no ``none`` reduction of the metrics that the other losses here have.

    Args:
        actor_network: the policy, whose distribution has ``log_prob``. The authors' is a Gaussian
            without a squash and with a standard deviation that does not depend on the state.
        qvalue_network: the critics as one module with a parameter stack; see
            :class:`EnsembleSACLoss`.
        value_network: ``V``, with an output of shape ``(*batch, 1)`` under its last key.

    Keyword Args:
        expectile: ``tau``. Default: 0.7.
        temperature: ``beta``, the inverse temperature of the advantages. Default: 3.0.
        max_weight: largest weight of a row. Default: 100.0.
        subset_size: number of members in ``M``. Default: 2.
        subset_with_replacement: whether ``M`` may hold a member twice. Default: True.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; with ``"none"`` the losses have the shape of
            the input and metrics are left out. Default: ``"mean"``.

    Raises:
        ValueError: on a bad option, or a ``qvalue_network`` that is no stack.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import MLP, IndependentNormal, NormalParamExtractor
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_aca.baselines import EnsembleIQLLoss, EnsembleMLP
        >>> network = torch.nn.Sequential(MLP(3, 4), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ... )
        >>> critics = ValueOperator(EnsembleMLP(3 + 2), in_keys=["observation", "action"])
        >>> value = ValueOperator(MLP(3, 1), in_keys=["observation"])
        >>> loss = EnsembleIQLLoss(actor, critics, value)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> losses = loss(data)
        >>> sum(losses[f"loss_{name}"] for name in ("value", "qvalue", "actor")).backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            action: the action in the data.
            value: where the value estimator finds the next state's value.
            state_action_value: the critics' output.
            reward: the reward, below ``"next"``.
            done: the done flag, below ``"next"``.
            terminated: the terminated flag, below ``"next"``.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    loss_names = ("loss_value", "loss_qvalue", "loss_actor")
    metric_names = ("state_value", "pred_value", "target_value", "advantage_weight", "log_prob")

    value_network: TensorDictModule

    def __init__(
        self,
        actor_network: ProbabilisticActor,
        qvalue_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        expectile: float = 0.7,
        temperature: float = 3.0,
        max_weight: float = 100.0,
        subset_size: int = 2,
        subset_with_replacement: bool = True,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__()
        if not 0 < expectile < 1:
            raise ValueError(f"Expected expectile in (0, 1), got expectile={expectile}.")
        check_above(0, temperature=temperature, max_weight=max_weight)
        self._set_networks(actor_network, qvalue_network, subset_size, subset_with_replacement)
        self.value_network = value_network
        self.expectile, self.temperature, self.max_weight = expectile, temperature, max_weight
        self._set_reduction(reduction)

    # --- the three losses -------------------------------------------------------------------------

    def value_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Expectile loss of the state value."""
        value = self._state_value(tensordict)
        advantage = self._target_value(tensordict) - value
        weight = (self.expectile - (advantage < 0).to(advantage.dtype)).abs()
        error, metrics = weight * advantage.square(), {"state_value": value.detach().mean()}
        return self._output("loss_value", error, tensordict, metrics)

    def qvalue_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """TD loss of all critics."""
        with torch.no_grad():
            next_value = self._state_value(tensordict["next"]).unsqueeze(-1)
            target = self._td_target(tensordict, next_value)
        action = tensordict[self.tensor_keys.action]
        value = self._values(self.qvalue_network_params, tensordict, action)
        metrics = {"pred_value": value.detach().mean(), "target_value": target.mean()}
        error = (value - target).square().mean(-1)
        return self._output("loss_qvalue", error, tensordict, metrics)

    def actor_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the policy: advantage-weighted regression on the data's actions."""
        actor, action = self.actor_network, tensordict[self.tensor_keys.action]
        log_prob = actor.get_dist(tensordict.select(*actor.in_keys)).log_prob(action)
        with torch.no_grad():
            advantage = self._target_value(tensordict) - self._state_value(tensordict)
            weight = (self.temperature * advantage).exp().clamp(max=self.max_weight)
        metrics = {"advantage_weight": weight.mean(), "log_prob": log_prob.detach().mean()}
        return self._output("loss_actor", -weight * log_prob, tensordict, metrics)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All three losses and their metrics; see the class."""
        out = self.value_loss(tensordict)
        out.update(self.qvalue_loss(tensordict))
        out.update(self.actor_loss(tensordict))
        return out

    # --- their parts ------------------------------------------------------------------------------

    def _state_value(self, tensordict: TensorDictBase) -> Tensor:
        """``V``, ``(*batch,)``."""
        network = self.value_network
        data = network(tensordict.select(*network.in_keys))
        return data[network.out_keys[-1]].squeeze(-1)

    def _target_value(self, tensordict: TensorDictBase) -> Tensor:
        """``min_{i in M} Q_bar_i(s, a)`` at the data's actions, ``(*batch,)``."""
        return self._target_subset_value(tensordict, tensordict[self.tensor_keys.action])

    def _state_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys([*super()._state_keys(), *self.value_network.in_keys]))
