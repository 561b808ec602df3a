"""A user's own network as a noise-level critic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_aca.checks import check_keys
from torchrl_aca.critic import NoiseLevelCriticBase

__all__ = ["CustomCritic", "as_noise_level_critic"]


class CustomCritic(NoiseLevelCriticBase):
    """Any module that maps observations, action and noise level to ``E`` values, as a critic.

    Where the module is a ``TensorDictSequential``, the parts that depend neither on the action nor
    on the noise level (an image encoder, say) run once per state; the others run once per candidate
    and denoising step. A plain ``nn.Module`` is called as
    ``module(observation, action, noise_level)``.

    The module sees flat batches: observations of shape ``(rows, ...)``, actions ``(rows, A)`` in
    critic units, integer noise levels ``(rows,)``, where 0 is the clean action. Its output has the
    shape ``(rows, E)``.

    Keep a module that changes its buffers while it trains, such as BatchNorm, in ``eval`` mode when
    actions are drawn: the chain cannot differentiate through a change of buffers. What becomes of
    buffers in a loss is told at :class:`ACALoss`.

    The parts are taken at construction: to put another one in a part's place, build the critic, the
    actor and the loss anew.

    Args:
        module: the network. A module that ignores the noise level is a plain critic ``Q(s, a)``.

    Keyword Args:
        observation_keys: keys of the observations. Default: those that the module reads and
            neither writes itself nor knows as action or noise level; ``["observation"]`` for a
            plain module.
        action_key: default ``"action"``.
        noise_level_key: default ``"noise_level"``.
        value_key: default ``"state_action_value"``.
        first_level: see :class:`NoiseLevelCriticBase`.

    Raises:
        ValueError: if the module does not read the action or does not write the value, or
            ``observation_keys`` is one key instead of a list.
        AttributeError: if another ``module`` is set.
    """

    def __init__(
        self,
        module: nn.Module,
        *,
        observation_keys: Sequence[NestedKey] | None = None,
        action_key: NestedKey = "action",
        noise_level_key: NestedKey = "noise_level",
        value_key: NestedKey = "state_action_value",
        first_level: int = 1,
    ) -> None:
        check_keys(observation_keys=observation_keys)
        row_keys = (action_key, noise_level_key)
        if isinstance(module, TensorDictModuleBase):
            inner = module
        else:
            in_keys = [*(observation_keys or ["observation"]), *row_keys]
            inner = TensorDictModule(module, in_keys=in_keys, out_keys=[value_key])
        in_keys, out_keys = list(inner.in_keys), list(inner.out_keys)
        if action_key not in in_keys or value_key not in out_keys:
            raise ValueError(
                f"A critic must read the action {action_key!r} and write the value {value_key!r}, "
                f"but this one reads {in_keys} and writes {out_keys}. Rename its keys, or pass "
                "action_key= and value_key= to CustomCritic."
            )
        if observation_keys is None:
            observation_keys = [key for key in in_keys if key not in row_keys]
        super().__init__(observation_keys, action_key, noise_level_key, value_key, first_level)
        self.module = module
        encoder, head = _split(inner, set(row_keys))
        # Both share `module`'s submodules: out of the module tree, so that each is listed once.
        self.__dict__["_encoder"] = encoder
        self.__dict__["_head"] = head
        self._feature_keys = [key for key in head.in_keys if key not in row_keys]

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "module" and "_head" in self.__dict__:
            raise AttributeError(
                "The module of a CustomCritic cannot be replaced: expected CustomCritic(module), "
                "and an actor and a loss built on that."
            )
        super().__setattr__(name, value)

    def encode(self, *observations: Tensor) -> TensorDict:
        """What the head reads of ``B`` states, as a TensorDict of batch size ``(B,)``."""
        states = TensorDict(batch_size=observations[0].shape[:1])
        for key, observation in zip(self.observation_keys, observations, strict=True):
            states.set(key, observation)
        return self._encoder(states).select(*self._feature_keys)

    def _evaluate(self, features: Any, action: Tensor, index: Tensor) -> Tensor:
        batch = action.shape[:-1]
        rows = features.expand(batch).reshape(batch.numel())
        rows.set(self.action_key, action.reshape(batch.numel(), action.shape[-1]))
        rows.set(self.noise_level_key, index.expand(batch).reshape(-1))
        value = self._head(rows).get(self.value_key)
        if value.ndim != 2:
            raise ValueError(
                f"A critic's output must have shape (rows, E), here ({rows.shape[0]}, E) with one "
                f"column per critic; got {tuple(value.shape)}. A single critic has E = 1."
            )
        return value.reshape(*batch, value.shape[-1])


def as_noise_level_critic(critic: nn.Module) -> NoiseLevelCriticBase:
    """``critic`` itself where it is a noise-level critic already, else a :class:`CustomCritic`."""
    if isinstance(critic, NoiseLevelCriticBase):
        return critic
    if isinstance(critic, nn.Module):
        return CustomCritic(critic)
    raise TypeError(f"A critic must be an nn.Module, got {type(critic).__name__}.")


def _split(
    module: TensorDictModuleBase, row_keys: set[NestedKey]
) -> tuple[TensorDictSequential, TensorDictSequential]:
    """Split a sequence into what depends on the state alone and what depends on ``row_keys``."""
    parts = (
        list(cast(nn.ModuleList, module.module))
        if isinstance(module, TensorDictSequential)
        else [module]
    )
    encoder, head = [], []
    # A part in front of the head must write nothing that the head has read or written before.
    used = set(row_keys)
    for part in parts:
        reads, writes = (cast("list[NestedKey]", keys) for keys in (part.in_keys, part.out_keys))
        if row_keys.isdisjoint(reads) and used.isdisjoint(writes):
            encoder.append(part)
        else:
            head.append(part)
            row_keys = row_keys.union(writes)
            used.update(reads, writes)
    return TensorDictSequential(*encoder), TensorDictSequential(*head)
