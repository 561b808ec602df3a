"""What the agents with an ensemble of critics share: settings and networks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import torch
from pydantic import Field, model_validator
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator

from torchrl_aca.baselines import EnsembleMLP, make_gaussian_policy
from torchrl_aca.training.config import Count, Positive, Section, Widths
from torchrl_aca.training.policy import PolicyBuilder

INITIALISERS = {"xavier_uniform": nn.init.xavier_uniform_, "orthogonal": nn.init.orthogonal_}
Network = TypeVar("Network", bound=nn.Module)


class EnsembleSettings(Section):
    """The networks, and how many critics make a target."""

    section: ClassVar[str]

    num_cells: Widths
    num_qvalue_nets: Annotated[int, Field(ge=1, le=1000)]
    critic_layer_norm: bool
    actor_layer_norm: bool
    init: Literal["xavier_uniform", "orthogonal"]
    gain: Positive
    last_hidden_gain: Positive
    log_std_min: float
    log_std_max: float
    subset_size: Count
    subset_with_replacement: bool

    @model_validator(mode="after")
    def _sizes(self) -> EnsembleSettings:
        if self.subset_size > self.num_qvalue_nets:
            expected = f"at most {self.section}.num_qvalue_nets ({self.num_qvalue_nets})"
            self.refuse("subset_size", expected)
        if self.log_std_max < self.log_std_min:
            expected = f"at least {self.section}.log_std_min ({self.log_std_min})"
            self.refuse("log_std_max", expected)
        return self


class EnsembleSACSettings(EnsembleSettings):
    """And the soft actor-critic on them."""

    entropy_backup: bool
    actor_value: Literal["mean", "min"]
    alpha_init: Positive
    target_entropy_scale: float
    temperature: Literal["exp", "softplus"]

    def of_loss(self) -> dict[str, Any]:
        """Returns the keywords of `EnsembleSACLoss`."""
        names = (
            "subset_size",
            "subset_with_replacement",
            "actor_value",
            "entropy_backup",
            "target_entropy_scale",
            "alpha_init",
            "temperature",
        )
        return {name: getattr(self, name) for name in names}


# --- networks -------------------------------------------------------------------------------------


def actor_mlp(settings: EnsembleSettings) -> dict[str, Any]:
    """The keywords of the actor's network, and of others of its kind."""
    return {"num_cells": settings.num_cells, "layer_norm": settings.actor_layer_norm}


def policy_builder(
    settings: EnsembleSettings,
    env: EnvBase,
    factory: Callable[..., TensorDictModuleBase] = make_gaussian_policy,
) -> PolicyBuilder:
    """How the Gaussian policy is built."""
    bounds = {"log_std_min": settings.log_std_min, "log_std_max": settings.log_std_max}
    return PolicyBuilder.of(env, factory, **actor_mlp(settings), **bounds)


def initialised(
    network: Network, settings: EnsembleSettings, last_hidden_gain: float | None = None
) -> Network:
    """Draws the weights of a policy or an MLP anew; the biases are zero."""
    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.zeros_(layer.bias)
    initialise([layer.weight.unsqueeze(0) for layer in layers], settings, last_hidden_gain)
    return network


def make_critics(settings: EnsembleSettings, env: EnvBase, device: torch.device) -> ValueOperator:
    """The ensemble of critics."""
    network = EnsembleMLP(
        env.observation_spec["observation"].shape[-1] + env.action_spec_unbatched.shape[-1],
        settings.num_qvalue_nets,
        num_cells=settings.num_cells,
        layer_norm=settings.critic_layer_norm,
        device=device,
    )
    initialise(network.weights, settings)
    return ValueOperator(network, in_keys=["observation", "action"])


def initialise(
    weights: list[torch.Tensor], settings: EnsembleSettings, last_hidden_gain: float | None = None
) -> None:
    """Draws stacks of weights, first layer to last; the last hidden one has a gain of its own."""
    fill = INITIALISERS[settings.init]
    if last_hidden_gain is None:
        last_hidden_gain = settings.last_hidden_gain
    for layer, weight in enumerate(weights):
        gain = last_hidden_gain if layer == len(weights) - 2 else settings.gain
        for member in weight:
            fill(member, gain=gain)
