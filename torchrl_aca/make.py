"""ACA from plain keywords."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch.optim import Adam, Optimizer
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from torchrl_aca.actor import CriticGuidedDenoisingActor
from torchrl_aca.checks import action_spec, check_choice, check_keys
from torchrl_aca.critic import NoiseLevelCritic
from torchrl_aca.loss import ACALoss
from torchrl_aca.schedule import NoiseSchedule

__all__ = ["ACAParts", "make_aca", "make_aca_actor"]


def make_aca_actor(
    observation_dim: int,
    spec: TensorSpec,
    *,
    num_steps: int = 20,
    schedule: str = "cosine",
    num_critics: int = 2,
    num_cells: Sequence[int] = (256, 256, 256),
    first_level: int = 1,
    observation_keys: Sequence[NestedKey] = ("observation",),
    device: torch.device | str | None = None,
    **actor: Any,
) -> CriticGuidedDenoisingActor:
    """Builds a :class:`CriticGuidedDenoisingActor` on a :class:`NoiseLevelCritic`.

    Args:
        observation_dim: size ``O`` of the observation vector, or of all of them together.
        spec: bounded spec of one env's action, of shape ``(A,)``, or a ``Composite`` that holds it
            under the action's key.

    Keyword Args:
        num_steps: number ``T`` of noise levels. Default: 20.
        schedule: ``"cosine"``, ``"linear"`` or ``"vp"``. Default: ``"cosine"``.
        num_critics: number ``E`` of critics. Default: 2.
        num_cells: widths of the critic's hidden layers. Default: three of 256.
        first_level: see :class:`NoiseLevelCriticBase`. Default: 1.
        observation_keys: keys of the observations, vectors that the critic joins in this order.
            Default: ``"observation"``.
        device: device of the parameters.
        actor: more keywords of the actor.

    Raises:
        ValueError: if a value is refused by one of the parts, or the schedule is unknown.

    Examples:
        >>> from torchrl.data import Bounded
        >>> actor = make_aca_actor(17, Bounded(-2.0, 2.0, shape=(6,)), num_candidates=4)
        >>> actor(TensorDict(observation=torch.zeros(3, 17), batch_size=[3]))["action"].shape
        torch.Size([3, 6])
    """
    check_choice(("cosine", "linear", "vp"), schedule=schedule)
    check_keys(observation_keys=observation_keys)
    action_dim = action_spec(spec, actor.get("out_keys", ["action"])[0], None).shape[-1]
    critic = NoiseLevelCritic(
        observation_dim,
        action_dim,
        num_steps=num_steps,
        num_critics=num_critics,
        num_cells=num_cells,
        first_level=first_level,
        in_keys=(*observation_keys, "action", "noise_level"),
        device=device,
    )
    levels = getattr(NoiseSchedule, schedule)(num_steps)
    return CriticGuidedDenoisingActor(critic, levels, spec=spec, **actor).to(device)


@dataclass
class ACAParts:
    """What :func:`make_aca` builds. A deep copy is a learner of its own.

    Attributes:
        loss: the loss; its value estimator has ``gamma``.
        target_update: moves the target parameters.
        optimizer: of the critic.
        alpha_optimizer: of ``loss.log_alpha``.
    """

    loss: ACALoss
    target_update: SoftUpdate
    optimizer: Optimizer
    alpha_optimizer: Optimizer

    @property
    def actor(self) -> CriticGuidedDenoisingActor:
        """The policy."""
        return self.loss.actor_network

    def __deepcopy__(self, memo: dict[int, Any]) -> ACAParts:
        """The updater is built anew, as it keeps tensors of its loss; it begins with a copy."""
        loss = copy.deepcopy(self.loss, memo)
        optimizers = copy.deepcopy((self.optimizer, self.alpha_optimizer), memo)
        targets = loss.target_qvalue_network_params
        kept = targets.data.clone()
        updater = SoftUpdate(loss, eps=self.target_update.eps)
        targets.data.copy_(kept)
        return ACAParts(loss, updater, *optimizers)


def make_aca(
    env: EnvBase,
    *,
    observation_keys: Sequence[NestedKey] = ("observation",),
    num_target_candidates: int | None = None,
    loss: Mapping[str, Any] | None = None,
    gamma: float = 0.99,
    tau: float = 0.005,
    lr: float = 1e-3,
    alpha_lr: float = 3e-2,
    make_optimizer: Callable[..., Optimizer] = Adam,
    device: torch.device | str | None = None,
    **actor: Any,
) -> ACAParts:
    """Builds ACA with sizes and bounds from an environment's specs; the defaults are the paper's.

    Args:
        env: a TorchRL environment, of any batch size; it is neither stepped nor kept.

    Keyword Args:
        observation_keys: as in :func:`make_aca_actor`.
        num_target_candidates: candidates in the target, ``N`` of ``a'_0``. Default: as for acting.
        loss: other keywords of :class:`ACALoss`, such as ``{"reward_scale": 1.0}``.
        gamma: discount. Default: 0.99.
        tau: step of the target parameters. Default: 0.005.
        lr: learning rate of the critic. Default: 1e-3.
        alpha_lr: learning rate of ``log_alpha``. Default: 3e-2, which is for a step at every 250th
            update, as in the official code: exploration noise is then at its lowest after 30,000
            updates, and after 120 with a step at each.
        make_optimizer: called as ``make_optimizer(parameters, lr=...)``. Default: Adam.
        device: device of the parameters. Default: the environment's.
        actor: other keywords of :func:`make_aca_actor` and of the actor; ``out_keys`` is by default
            the environment's action key. Where it has one reward, done or terminated flag, the loss
            reads that; else tell it by ``loss.set_keys``.

    Raises:
        ValueError: if ``env`` has no such observations, several actions or no bounded vector as
            action, or one of the parts refuses a value.
        TypeError: if ``env`` is no TorchRL environment.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> aca = make_aca(GymEnv("Pendulum-v1"), num_candidates=4)
        >>> aca.actor.critic.observation_dim
        3
    """
    if not isinstance(env, EnvBase):
        raise TypeError(
            f"make_aca expects a TorchRL environment, got {type(env).__name__}. Wrap it, as in "
            "torchrl.envs.GymWrapper(env)."
        )
    if len(env.action_keys) > 1 and "out_keys" not in actor:
        raise ValueError(
            f"Expected an environment with one action, got {env.action_keys}. Pass out_keys=[...] "
            "with the one that ACA is to choose, and let another policy choose the others."
        )
    device = env.device if device is None else device
    network = make_aca_actor(
        _observation_dim(env, observation_keys),
        env.action_spec_unbatched,
        observation_keys=observation_keys,
        device=device,
        **{"out_keys": env.action_keys[:1], **actor},
    )
    module = ACALoss(network, num_target_candidates=num_target_candidates, **(loss or {}))
    module.make_value_estimator(gamma=gamma)
    module.set_keys(**_reward_keys(env))
    return ACAParts(
        module,
        SoftUpdate(module, tau=tau),
        make_optimizer(module.qvalue_network.parameters(), lr=lr),
        make_optimizer([module.log_alpha], lr=alpha_lr),
    )


def _reward_keys(env: EnvBase) -> dict[str, NestedKey]:
    """Keys of reward, done and terminated, each where the environment has one alone."""
    found = {"reward": list(env.reward_keys)}
    for name in ("done", "terminated"):
        found[name] = [key for key in env.done_keys if key == name or key[-1] == name]
    return {name: keys[0] for name, keys in found.items() if len(keys) == 1}


def _observation_dim(env: EnvBase, keys: Sequence[NestedKey]) -> int:
    """The numbers in the observations of one environment."""
    check_keys(observation_keys=keys)
    spec = env.full_observation_spec_unbatched
    known = list(spec.keys(True, True))
    for key in keys:
        if key not in known or spec[key].ndim != 1:
            found = f"shape {tuple(spec[key].shape)}" if key in known else f"only {known}"
            raise ValueError(
                f"Expected the environment to have a vector {key!r} among its observations, got "
                f"{found}. Pass observation_keys=[...], flatten it, or use a CustomCritic."
            )
    return sum(spec[key].shape[-1] for key in keys)
