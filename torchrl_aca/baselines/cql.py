"""The losses of CQL, Cal-QL and WSRL: an ensemble SAC that learns small values off the data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor

from torchrl_aca.baselines.ensemble_sac import TEMPERATURES, EnsembleSACLoss
from torchrl_aca.checks import check_above, check_at_least

__all__ = ["CalQLLoss", "EnsembleCQLLoss"]

# The SAC below CQL in the code of WSRL's authors, where it differs from RLPD's.
WSRL_SETTINGS = {
    "subset_with_replacement": True,
    "actor_value": "min",
    "entropy_backup": False,
    "target_entropy_scale": 1.0,
    "temperature": "softplus",
}


class EnsembleCQLLoss(EnsembleSACLoss):
    """Loss module of CQL with an ensemble (*Conservative Q-Learning*, arXiv 2006.04779).

    It is :class:`EnsembleSACLoss` but for its critics' loss, which is restated from the code of
    WSRL's authors (arXiv 2412.07762) for locomotion with ten critics. In each state ``s`` of the
    data, ``U`` holds ``n`` uniform actions, ``n`` of ``pi(.|s)`` and ``n`` of ``pi(.|s')``, each
    ``u`` with the density ``mu(u)`` that it was drawn from; ``M'`` is a subset of the members of
    its own:

    - :meth:`qvalue_loss`: ``mean_i (Q_i(s, a) - y)^2 + weight * gap`` with ``gap =
      mean_{i in M'} [log sum_{u in U} exp(Q_i(s, u) - log mu(u)) - Q_i(s, a)]`` and the backup
      ``y = r + gamma (1 - terminated) max_{a'} min_{i in M} Q_bar_i(s', a')`` over several
      ``a' ~ pi(.|s')``;
    - :meth:`cql_weight_loss`, with ``gap_threshold``: ``weight * (gap_threshold - gap)``, which
      raises the weight while the gap is above the threshold;
    - :meth:`td_loss`: the critics' loss of the parent, without ``gap``: WSRL's online phase;
    - :meth:`actor_loss` and :meth:`alpha_loss` as in the parent.

    Densities are of actions rescaled to [-1, 1], as everywhere in the parent: ``log mu`` of a
    uniform action is ``-A log 2``. No gradient of ``gap`` reaches the policy. As ``U`` has actions
    of ``pi(.|s')``, terminal states must be finite too, where other losses ignore what they hold.

    Only the members in ``M'`` are evaluated at the ``3 n`` actions. WSRL's code evaluates all and
    then takes these: the same loss at a fifth of the cost.

    Why not TorchRL's ``CQLLoss`` (0.14.1): its ``logsumexp`` runs over three values in each state
    instead of ``3 n``, as it puts the actions on the batch axis; and it has two critics.

    Args:
        actor_network: as in the parent; its action spec must be bounded, for the uniform actions.
        qvalue_network: as in the parent.

    Keyword Args:
        cql_weight: factor of the gap; with ``gap_threshold`` the first one. Default: 5.0.
        num_actions: ``n``. Default: 10.
        num_backup_actions: actions ``a'`` whose largest value is backed up. Default: 10.
        gap_threshold: train the weight so that the gap stays near this. Default: None, a fixed
            weight.
        **settings: of :class:`EnsembleSACLoss`; the defaults are those of WSRL's code:
            ``subset_with_replacement=True, actor_value="min", entropy_backup=False,
            target_entropy_scale=1.0, temperature="softplus"``.

    Raises:
        ValueError: on a bad option, or an action spec without bounds.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor
        >>> from torchrl.modules import TanhNormal, ValueOperator
        >>> from torchrl_aca.baselines import EnsembleCQLLoss, EnsembleMLP
        >>> network = torch.nn.Sequential(MLP(3, 4), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     spec=Bounded(-1.0, 1.0, (2,)),
        ...     distribution_class=TanhNormal,
        ... )
        >>> critics = ValueOperator(EnsembleMLP(3 + 2), in_keys=["observation", "action"])
        >>> loss = EnsembleCQLLoss(actor, critics)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> loss.qvalue_loss(data)["loss_qvalue"].backward()
    """

    @dataclass
    class _AcceptedKeys(EnsembleSACLoss._AcceptedKeys):
        """Keys that ``set_keys`` can change.

        Attributes:
            cql_gap: where :meth:`EnsembleCQLLoss.qvalue_loss` leaves the gap of each row, and
                :meth:`EnsembleCQLLoss.cql_weight_loss` finds it.
        """

        cql_gap: NestedKey = "cql_gap"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    metric_names: tuple[str, ...] = ("pred_value", "target_value", "cql_gap", "entropy", "alpha")

    _low: Tensor
    _high: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticActor,
        qvalue_network: TensorDictModule,
        *,
        cql_weight: float = 5.0,
        num_actions: int = 10,
        num_backup_actions: int = 10,
        gap_threshold: float | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, qvalue_network, **{**WSRL_SETTINGS, **settings})
        check_at_least(0, cql_weight=cql_weight)
        check_at_least(1, num_actions=num_actions, num_backup_actions=num_backup_actions)
        self.num_actions, self.num_backup_actions = num_actions, num_backup_actions
        self.gap_threshold = gap_threshold
        spec = self._action_spec()
        if not isinstance(spec, Bounded):
            raise ValueError(
                "CQL draws uniform actions, so the actor needs a bounded action spec, got "
                f"{spec}. Build it with spec=env.action_spec_unbatched."
            )
        like = self.raw_alpha.detach()
        self.register_buffer("_low", spec.space.low.to(like))
        self.register_buffer("_high", spec.space.high.to(like))
        if gap_threshold is None:
            self.register_buffer("_fixed_weight", like.new_tensor(cql_weight))
        else:
            check_above(0, cql_weight=cql_weight)
            _, inverse = TEMPERATURES[self.temperature]
            self.raw_cql_weight = nn.Parameter(like.new_tensor(inverse(cql_weight)))
            self.loss_names = (*self.loss_names, "loss_cql_weight")
            self.metric_names = (*self.metric_names, "cql_weight")

    # --- the losses -------------------------------------------------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """TD loss and gap; writes the gap of each row, ``(*batch,)``, to ``tensordict``."""
        error, metrics = self._td_error(tensordict, self._backup_value(tensordict["next"]))
        gap, gap_metrics = self._gap(tensordict)
        tensordict.set(self.tensor_keys.cql_gap, gap.detach())
        metrics.update(cql_gap=gap.detach().mean(), **gap_metrics)
        error = error + self.cql_weight * gap
        return self._output("loss_qvalue", error, tensordict, metrics)

    def td_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """``loss_qvalue`` as in the parent: one action in the backup, and nothing conservative."""
        return super().qvalue_loss(tensordict)

    def cql_weight_loss(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the weight, for ``gap_threshold``.

        Args:
            tensordict: what :meth:`qvalue_loss` has seen, so that the gap is not computed again; or
                any batch of transitions.
        """
        gap = tensordict.get(self.tensor_keys.cql_gap, None)
        if gap is None:
            with torch.no_grad():
                gap, _ = self._gap(tensordict)
        weight = self._cql_weight()
        error = weight * (self.gap_threshold - gap)
        return self._output("loss_cql_weight", error, tensordict, {"cql_weight": weight.detach()})

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All losses and their metrics; see the class."""
        out = super().forward(tensordict)
        if self.gap_threshold is not None:
            out.update(self.cql_weight_loss(tensordict))
        return out

    @property
    def cql_weight(self) -> Tensor:
        """The factor of the gap, without gradient."""
        return self._cql_weight().detach()

    # --- their parts ------------------------------------------------------------------------------

    def _cql_weight(self) -> Tensor:
        if self.gap_threshold is None:
            return self._fixed_weight
        function, _ = TEMPERATURES[self.temperature]
        return function(self.raw_cql_weight)

    @torch.no_grad()
    def _backup_value(self, states: TensorDictBase) -> Tensor:
        """What the target bootstraps from, ``(*batch,)``: the best of several actions."""
        action, log_prob = self._sample(states, (self.num_backup_actions,))
        value = self._target_subset_value(states, action)
        if self.entropy_backup:
            value = value - self.alpha * log_prob
        return value.amax(0)

    def _gap(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The gap of each row, ``(*batch,)``, and metrics."""
        action, log_density = self._contrast(tensordict)
        action = torch.cat([action, tensordict[self.tensor_keys.action].unsqueeze(0)])
        members = self._subset()
        params = self.qvalue_network_params.apply(lambda stack: stack[members])
        values = self._values(params, tensordict, action)
        drawn, metrics = self._bounded(values[:-1], tensordict)
        soft_maximum = (drawn - log_density.unsqueeze(-1)).logsumexp(0)
        return (soft_maximum - values[-1]).mean(-1), metrics

    @torch.no_grad()
    def _contrast(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The actions in ``U``, ``(3 n, *batch, A)``, uniform ones first, and ``log mu``."""
        num = (self.num_actions,)
        here, here_log_prob = self._sample(tensordict, num)
        there, there_log_prob = self._sample(tensordict["next"], num)
        uniform = self._low + torch.rand_like(here) * (self._high - self._low)
        uniform_log_prob = torch.full_like(here_log_prob, -here.shape[-1] * math.log(2))
        log_density = torch.cat([uniform_log_prob, here_log_prob, there_log_prob])
        return torch.cat([uniform, here, there]), log_density

    def _bounded(
        self, values: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Values at the actions in ``U``, ``(3 n, *batch, members)``: in CQL as they are."""
        return values, {}


class CalQLLoss(EnsembleCQLLoss):
    """Loss module of Cal-QL (*Calibrated Q-Learning*, arXiv 2303.05479).

    It is :class:`EnsembleCQLLoss` with a floor under the values that the gap pushes down: at the
    actions of the policy, not at the uniform ones, ``Q_i(s, u)`` is replaced by ``max(Q_i(s, u),
    G(s))`` with ``G`` the discounted return that the data had from ``s`` on. So no value is pushed
    below what the data show to be possible. ``G`` is an entry of each row, ``mc_return`` of shape
    ``(*batch, 1)``; where it is minus infinity there is no floor. See
    :func:`torchrl_aca.offline.return_bounds` for what it is where an episode was cut.

    Examples:
        >>> from torchrl_aca.baselines import CalQLLoss
        >>> CalQLLoss.metric_names
        ('pred_value', 'target_value', 'cql_gap', 'bound_rate', 'entropy', 'alpha')
    """

    @dataclass
    class _AcceptedKeys(EnsembleCQLLoss._AcceptedKeys):
        """Keys that ``set_keys`` can change.

        Attributes:
            mc_return: the discounted return from the state on.
        """

        mc_return: NestedKey = "mc_return"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    metric_names = ("pred_value", "target_value", "cql_gap", "bound_rate", "entropy", "alpha")

    def _bounded(
        self, values: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Values with the floor, and the share of those at the policy's actions that are on it."""
        floor = tensordict[self.tensor_keys.mc_return]
        uniform, policy = values.tensor_split([self.num_actions])
        rate = (policy.detach() < floor).to(values.dtype).mean()
        return torch.cat([uniform, torch.maximum(policy, floor)]), {"bound_rate": rate}

    def _row_keys(self) -> list[NestedKey]:
        return [self.tensor_keys.mc_return]
