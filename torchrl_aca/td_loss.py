"""What losses with a TD target share: the contract of a LossModule, and the target itself."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator

from torchrl_aca.checks import check_choice

__all__ = ["TDLoss", "next_key"]


class TDLoss(LossModule):
    """Base class of losses that regress critics on ``r + gamma (1 - terminated) V(s')``.

    A subclass has ``_AcceptedKeys`` with ``action``, ``value``, ``reward``, ``done`` and
    ``terminated``, its losses, ``qvalue_network`` made functional, and what is declared here.

    The critics' parameters and buffers in the loss are those of ``qvalue_network`` itself. Buffers,
    such as running statistics, have no targets of their own: before each use the target critics
    take over the online ones, as no target updater of TorchRL moves buffers.

    Attributes:
        loss_names: keys of the losses in the output.
        metric_names: keys of the metrics in the output, which ``reduction="none"`` leaves out.
    """

    tensor_keys: Any
    reduction: str
    use_given_draws: bool = True
    loss_names: tuple[str, ...]
    metric_names: tuple[str, ...]
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS: tuple[ValueEstimators, ...] = (ValueEstimators.TD0,)
    qvalue_network: nn.Module
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    def __init__(self) -> None:
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[str] | None = None
        super().__init__()
        self.register_load_state_dict_post_hook(_tie_loaded)

    @abstractmethod
    def _state_keys(self) -> list[NestedKey]:
        """Keys of what the networks see of a state."""

    def _row_keys(self) -> list[NestedKey]:
        """Keys of what a loss reads in a row besides the transition."""
        return []

    def _set_reduction(self, reduction: str | None) -> None:
        """Keep how errors become a loss; None is the mean."""
        self.reduction = reduction or "mean"
        check_choice(("none", "mean", "sum"), reduction=self.reduction)

    @contextmanager
    def _critics(self, params: TensorDictBase) -> Iterator[Any]:
        """``qvalue_network`` on other parameters; its own return after an exception as well."""
        critics = self.qvalue_network
        # As a context, `to_module` would leave the module as it is on an exception.
        own = params.to_module(critics, preserve_module_state=False)
        try:
            yield critics
        finally:
            own.to_module(critics, preserve_module_state=False, return_swap=False)

    def _target_params(self) -> TensorDictBase:
        """The target parameters, with the online buffers."""
        online, target = self.qvalue_network_params, self.target_qvalue_network_params
        for name, buffer in online.named_buffers():
            target.get(tuple(name.split("."))).copy_(buffer)
        return target

    def _td_target(
        self, tensordict: TensorDictBase, next_value: Tensor, reward_scale: float = 1.0
    ) -> Tensor:
        """The target ``y`` of shape ``(*batch, 1)``, made by the value estimator.

        Args:
            tensordict: rewards and flags below ``"next"``, and the steps of n-step returns, if any.
            next_value: ``V(s')``, shape ``(*batch, 1)``.
            reward_scale: factor of the rewards.
        """
        keys, read = self.tensor_keys, self.value_estimator.tensor_keys
        reward, done, terminated = map(next_key, (keys.reward, keys.done, keys.terminated))
        data = tensordict.select(reward, done, terminated)
        if (steps := tensordict.get(read.steps_to_next_obs, None)) is not None:
            data.set(read.steps_to_next_obs, steps)
        data.set(reward, reward_scale * data[reward])
        # A terminal state may hold anything, NaN included: its value is zero, not zero times that.
        next_value = next_value.masked_fill(data[terminated].reshape(next_value.shape), 0.0)
        data.set(next_key(read.value), next_value)
        target = self.value_estimator.value_estimate(data).reshape(next_value.shape)
        return target.to(next_value.dtype)  # rewards may be float64; torch < 2.13 would not learn

    def _output(
        self,
        name: str,
        error: Tensor,
        tensordict: TensorDictBase,
        metrics: dict[str, Tensor],
        weights: Tensor | None = None,
    ) -> TensorDict:
        """One loss, reduced from errors of shape ``(*batch,)``, and its metrics."""
        loss = self._reduce_loss(error, tensordict, weights=weights)
        if self.reduction == "none":
            return TensorDict({name: loss}, batch_size=tensordict.batch_size)
        return TensorDict({name: loss, **metrics})

    def _given(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor | None:
        """Draws that the input holds, if any and if wanted."""
        return tensordict.get(key, None) if self.use_given_draws else None

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        """Importance weights, if any; the parent's test for the key fails on nested keys."""
        if self.use_prioritized_weights not in (True, "auto"):
            return None
        return tensordict.get(self.tensor_keys.priority_weight, None)

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: Any
    ) -> Any:
        """Set the value estimator, one of ``SUPPORTED_VALUE_ESTIMATORS``; see ``LossModule``."""
        value_type, hyperparams = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if value_type is not None:
            dispatch_value_estimator(
                self,
                value_type,
                supported=self.SUPPORTED_VALUE_ESTIMATORS,
                tensor_keys={"value_target": "value_target", **self._estimator_keys()},
                value_network=None,
                **hyperparams,
            )
        return self

    def _estimator_keys(self) -> dict[str, NestedKey]:
        names = ("value", "reward", "done", "terminated")
        return {name: getattr(self.tensor_keys, name) for name in names}

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._estimator_keys())
        self._in_keys = None

    def _tie(self) -> None:
        """Give ``qvalue_network`` the loss's parameters and buffers."""
        self.qvalue_network_params.to_module(self.qvalue_network)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """A copy of its own whose parts hold the same parameters, as do optimisers copied along."""
        clone = self.__class__.__new__(self.__class__)
        memo[id(self)] = clone
        clone.__dict__.update(copy.deepcopy(self.__dict__, memo))
        clone._tie()
        for old, new in zip(self.parameters(), clone.parameters(), strict=True):
            memo[id(old)] = new
        return clone

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A pickle holds parameters and their networks, and not that they are the same."""
        super().__setstate__(state)
        self._tie()

    def _apply(self, fn: Callable) -> Any:
        """Casts and moves make new buffers, in the loss and in its parts: tie them again."""
        super()._apply(fn)
        self._tie()
        return self

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that the loss reads; what it may read, such as given draws, is not listed."""
        if self._in_keys is None:
            keys, states = self.tensor_keys, self._state_keys()
            after = (keys.reward, keys.done, keys.terminated, *states)
            self._in_keys = [keys.action, *states, *self._row_keys(), *map(next_key, after)]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[str]:
        """The losses, then the metrics."""
        if self._out_keys is None:
            metrics = () if self.reduction == "none" else self.metric_names
            self._out_keys = [*self.loss_names, *metrics]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[str]) -> None:
        self._out_keys = values


def _tie_loaded(loss: TDLoss, incompatible_keys: Any) -> None:
    """With ``assign=True`` the tensors of a state dict take the place of those that were tied."""
    loss._tie()


def next_key(key: NestedKey) -> NestedKey:
    """The key of the same entry of the next state."""
    return ("next", key) if isinstance(key, str) else ("next", *key)
