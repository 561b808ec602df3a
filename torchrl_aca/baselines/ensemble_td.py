"""What losses with an ensemble of critics share: values of a stack, and of a few of its members."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from torchrl_aca.td_loss import TDLoss

__all__ = ["EnsembleTDLoss"]


class EnsembleTDLoss(TDLoss):
    """Base class of losses whose critics are one stack, and whose targets are from a few of them.

    A subclass calls :meth:`_set_networks`, and has ``state_action_value`` among its keys.
    """

    actor_network: ProbabilisticActor
    qvalue_network: TensorDictModule

    def _set_networks(
        self,
        actor_network: ProbabilisticActor,
        qvalue_network: TensorDictModule,
        subset_size: int,
        subset_with_replacement: bool,
    ) -> None:
        """Take the policy, the critics, and how many of these make a target."""
        self.num_qvalue_nets = _stack_size(qvalue_network)
        if not 1 <= subset_size <= self.num_qvalue_nets:
            raise ValueError(
                f"subset_size must be from 1 to the number of critics ({self.num_qvalue_nets}), "
                f"got {subset_size}."
            )
        self.actor_network = actor_network
        self.convert_to_functional(qvalue_network, "qvalue_network", create_target_params=True)
        self.subset_size = subset_size
        self.subset_with_replacement = subset_with_replacement
        self._policy_action_key = actor_network.dist_sample_keys[0]
        self.set_keys(
            action=self._policy_action_key, state_action_value=qvalue_network.out_keys[-1]
        )

    def _values(self, params: TensorDictBase, states: TensorDictBase, action: Tensor) -> Tensor:
        """Critic values under ``params``, one per member in them.

        Args:
            params: those of all members or of some.
            states: what the critics see of a state, ``(*batch,)``.
            action: ``(*batch, A)``, or ``(n, *batch, A)`` for several actions in each state.

        Returns:
            Tensor of shape ``(*batch, members)``, or ``(n, *batch, members)``.
        """
        keys = self.qvalue_network.in_keys
        data = states.select(*keys, strict=False)
        if action.ndim > states.ndim + 1:
            data = data.expand(action.shape[:-1])
        data = data.set(self._policy_action_key, action)
        with self._critics(params) as critics:
            return critics(data)[self.tensor_keys.state_action_value]

    def _subset(self) -> Tensor:
        """Indices of the members in ``M``, drawn anew."""
        num, device = self.num_qvalue_nets, next(self.qvalue_network_params.parameters()).device
        if self.subset_with_replacement:
            return torch.randint(num, (self.subset_size,), device=device)
        return torch.rand(num, device=device).topk(self.subset_size).indices

    @torch.no_grad()
    def _target_subset_value(self, states: TensorDictBase, action: Tensor) -> Tensor:
        """``min_{i in M} Q_bar_i``, ``(*batch,)`` or ``(n, *batch)``; see :meth:`_values`."""
        members = self._subset()
        # Only the members in M are evaluated: with two of ten, a fifth of the work.
        params = self._target_params().data.apply(lambda stack: stack[members])
        return self._values(params, states, action).amin(-1)

    def _state_keys(self) -> list[NestedKey]:
        networks = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        return [key for key in dict.fromkeys(networks) if key != self._policy_action_key]


def _stack_size(network: nn.Module) -> int:
    """The number of members of a stack of networks."""
    sizes = {param.shape[0] if param.ndim else 0 for param in network.parameters()}
    if len(sizes) != 1 or 0 in sizes:
        raise ValueError(
            "qvalue_network must be a stack of critics, in which every parameter has one entry per "
            f"critic along its first dimension; got first dimensions {sizes}. "
            "torchrl_aca.baselines.EnsembleMLP is one."
        )
    return sizes.pop()
