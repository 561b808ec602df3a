"""The small agents and batches that the tests of the losses share, and the table of all losses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, is_tensor_collection
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import (
    MLP,
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SoftUpdate

from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.baselines import (
    CalQLLoss,
    DACERLoss,
    DiffusionPolicy,
    DIPOLoss,
    EnsembleCQLLoss,
    EnsembleIQLLoss,
    EnsembleMLP,
    EnsembleSACLoss,
    NoiseNetwork,
    QSMLoss,
    QVPOLoss,
    SDACLoss,
    TwinCritic,
)

OBSERVATION_DIM, ACTION_DIM, NUM_STEPS = 3, 2, 4
LOW, HIGH = torch.tensor([-2.0, -1.0]).double(), torch.tensor([1.0, 3.0]).double()

# --- ACA ------------------------------------------------------------------------------------------


def make_actor(critic=None, *, first_level=1, state="observation", **kwargs):
    if critic is None:
        critic = NoiseLevelCritic(
            OBSERVATION_DIM,
            ACTION_DIM,
            num_steps=NUM_STEPS,
            num_cells=(16, 16),
            first_level=first_level,
            in_keys=[state, "action", "noise_level"],
        )
    kwargs = {"num_candidates": 3, **kwargs}
    return CriticGuidedDenoisingActor(critic, NoiseSchedule.cosine(NUM_STEPS), **kwargs)


def make_loss(actor=None, **kwargs):
    """A loss whose targets differ from the online parameters, so that a mix-up shows."""
    loss = ACALoss(actor or make_actor(), **kwargs)
    if loss.delay_qvalue:
        SoftUpdate(loss, tau=0.1)
        for param in loss.target_qvalue_network_params.values(True, True):
            param.data.add_(0.1 * torch.randn_like(param))
    return loss


def make_aca(state="observation", action="action", **kwargs):
    """An ACA loss on such keys."""
    return make_loss(make_actor(state=state, out_keys=[action]), **kwargs)


def make_data(*batch, terminated=False, draws=False):
    """Random transitions of batch shape ``batch``; with ``draws``, nothing is left to chance."""
    flag = torch.full((*batch, 1), terminated)
    following = {
        "observation": torch.randn(*batch, OBSERVATION_DIM),
        "reward": torch.randn(*batch, 1),
        "done": flag,
        "terminated": flag.clone(),
    }
    data = TensorDict(
        observation=torch.randn(*batch, OBSERVATION_DIM),
        action=torch.rand(*batch, ACTION_DIM) * 2 - 1,
        next=TensorDict(following, batch_size=batch),
        batch_size=batch,
    )
    if draws:
        data["noise_level"] = torch.randint(1, NUM_STEPS + 1, batch)
        data["noise"] = torch.randn(*batch, ACTION_DIM)
        data["next_action"] = torch.rand(*batch, ACTION_DIM) * 2 - 1
    return data


def total(losses):
    """The paper's summed objective."""
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def set_constant(loss, online, target):
    """Make every online value equal to ``online`` and every target value to ``target``."""
    for params, value in (
        (loss.qvalue_network_params, online),
        (loss.target_qvalue_network_params, target),
    ):
        params["value", "weight"].data.zero_()
        params["value", "bias"].data.fill_(value)


# --- RLPD -----------------------------------------------------------------------------------------


def make_policy(state="observation", action="action", spec=True):
    network = nn.Sequential(
        MLP(OBSERVATION_DIM, 2 * ACTION_DIM, num_cells=[8], activation_class=nn.ReLU).double(),
        NormalParamExtractor(scale_mapping="exp"),
    )
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[state], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        spec=Bounded(LOW, HIGH, (ACTION_DIM,), dtype=torch.float64) if spec else None,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": LOW, "high": HIGH},
    )


def make_critics(state="observation", action="action", num_members=4):
    num_in = OBSERVATION_DIM + ACTION_DIM
    network = EnsembleMLP(num_in, num_members, num_cells=(6, 5), dtype=torch.float64)
    return ValueOperator(network, in_keys=[state, action])


def spread(loss):
    """No parameter of the critics at a special value, and targets that differ from them."""
    loss.make_value_estimator(gamma=0.875)
    SoftUpdate(loss, tau=0.1)
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        for param in params.values(True, True):
            param.data.add_(0.3 * torch.randn_like(param))
        # Members apart from row to row rather than everywhere: so each is the smallest somewhere.
        last = params["module", "layers", "6"]
        last["bias"].data.zero_()
        last["weight"].data.sub_(last["weight"].data.mean(1, keepdim=True))
    return loss


def make_rlpd(
    state="observation", action="action", policy=None, num_members=4, kind=EnsembleSACLoss, **kwargs
):
    """A loss with no parameter at a special value, and targets that differ from the critics."""
    critics = make_critics(state, action, num_members)
    loss = spread(kind(policy or make_policy(state, action), critics, **kwargs))
    loss.raw_alpha.data.fill_(0.3)
    return loss


def make_rlpd_data(*batch):
    terminated = torch.zeros(*batch, 1, dtype=torch.bool)
    terminated.view(-1)[::3] = True
    following = {
        "observation": torch.randn(*batch, OBSERVATION_DIM, dtype=torch.float64),
        "reward": torch.randn(*batch, 1, dtype=torch.float64),
        "done": torch.ones_like(terminated),  # time limits, which must not stop the bootstrap
        "terminated": terminated,
    }
    unit = torch.rand(*batch, ACTION_DIM, dtype=torch.float64)
    return TensorDict(
        observation=torch.randn(*batch, OBSERVATION_DIM, dtype=torch.float64),
        action=LOW + unit * (HIGH - LOW),
        next=TensorDict(following, batch_size=batch),
        batch_size=batch,
    )


# --- diffusion policies ---------------------------------------------------------------------------

LANGEVIN = [1 - step / NUM_STEPS for step in range(NUM_STEPS)]


def make_diffusion_policy(state="observation", action="action", critic=None, chain=None, **kwargs):
    """A policy in float64, with bounds that are not [-1, 1]."""
    sizes = {"num_cells": (6, 5), "dtype": torch.float64}
    if critic is None:
        critic = TwinCritic(OBSERVATION_DIM, ACTION_DIM, **sizes)
    embedding = "none" if chain is LANGEVIN else "mlp"
    network = NoiseNetwork(
        OBSERVATION_DIM,
        ACTION_DIM,
        num_steps=NUM_STEPS,
        embedding=embedding,
        embedding_dim=4,
        **sizes,
    )
    spec = Bounded(LOW, HIGH, (ACTION_DIM,), dtype=torch.float64)
    kwargs = {"num_candidates": 3, "critic": critic, "spec": spec, **kwargs}
    chain = NoiseSchedule.cosine(NUM_STEPS) if chain is None else chain
    return DiffusionPolicy(network, chain, in_keys=[state], out_keys=[action], **kwargs)


def make_diffusion_loss(loss_class, state="observation", action="action", policy=None, **kwargs):
    """A loss with no parameter at a special value, and targets apart from the online networks."""
    loss = loss_class(policy or make_diffusion_policy(state, action), **kwargs)
    loss.make_value_estimator(gamma=0.875)
    SoftUpdate(loss, tau=0.1)
    for params in filter(is_tensor_collection, loss.children()):
        for param in params.values(True, True):
            param.data.add_(0.3 * torch.randn_like(param))
    return loss


def make_qsm(state="observation", action="action", **kwargs):
    policy = kwargs.pop("policy", None)
    if policy is None:
        policy = make_diffusion_policy(state, action, chain=LANGEVIN)
    return make_diffusion_loss(QSMLoss, policy=policy, **kwargs)


def make_qvpo(state="observation", action="action", **kwargs):
    return make_diffusion_loss(QVPOLoss, state, action, **kwargs)


def make_sdac(state="observation", action="action", policy=None, **kwargs):
    if policy is None:
        policy = make_diffusion_policy(state, action, exploration_noise=0.1, alpha_init=2.0)
    return make_diffusion_loss(SDACLoss, policy=policy, **{"num_proposals": 5, **kwargs})


def make_dipo(state="observation", action="action", policy=None, **kwargs):
    if policy is None:
        policy = make_diffusion_policy(state, action, num_candidates=1)
    return make_diffusion_loss(DIPOLoss, policy=policy, **{"num_gradient_steps": 4, **kwargs})


def make_dipo_data(*batch):
    data = make_rlpd_data(*batch)
    unit = torch.rand_like(data["action"])
    return data.set("best_action", LOW + unit * (HIGH - LOW))


def make_dacer_critic(**kwargs):
    sizes = {"num_cells": (6, 5), "dtype": torch.float64, **kwargs}
    return TwinCritic(OBSERVATION_DIM, ACTION_DIM, num_outputs=2, **sizes)


def make_dacer(state="observation", action="action", policy=None, **kwargs):
    if policy is None:
        noise = {"exploration_noise": 0.1, "alpha_init": 2.0, "clip_action": True}
        critic = make_dacer_critic()
        policy = make_diffusion_policy(state, action, critic, num_candidates=1, **noise)
    return make_diffusion_loss(DACERLoss, policy=policy, **{"num_entropy_samples": 30, **kwargs})


# --- CQL, Cal-QL, IQL -----------------------------------------------------------------------------


def make_cql(*args, kind=EnsembleCQLLoss, **kwargs):
    kwargs = {"num_actions": 3, "num_backup_actions": 2, "cql_weight": 0.6, **kwargs}
    return make_rlpd(*args, kind=kind, **kwargs)


def make_cql_with_threshold(*args, **kwargs):
    return make_cql(*args, gap_threshold=0.7, **kwargs)


def make_calql(*args, **kwargs):
    return make_cql(*args, kind=CalQLLoss, **kwargs)


def make_calql_data(*batch):
    """Returns of the size of the values, so that some of these are above and some below."""
    data = make_rlpd_data(*batch)
    data["mc_return"] = 0.3 * torch.randn(*batch, 1, dtype=torch.float64)
    return data


def make_iql(state="observation", action="action", num_members=4, **kwargs):
    network = nn.Sequential(
        MLP(OBSERVATION_DIM, 2 * ACTION_DIM, num_cells=[8], activation_class=nn.ReLU).double(),
        NormalParamExtractor(scale_mapping="exp"),
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=[state], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        distribution_class=IndependentNormal,
    )
    value = MLP(OBSERVATION_DIM, 1, num_cells=[8], activation_class=nn.ReLU).double()
    critics = make_critics(state, action, num_members)
    return spread(EnsembleIQLLoss(actor, critics, ValueOperator(value, in_keys=[state]), **kwargs))


# --- all losses -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class LossCase:
    """What the battery needs of a loss.

    ``make(state=KEY, action=KEY, **kwargs)`` gives one with targets apart from the critics and an
    updater; ``data(*batch)`` gives transitions, and whatever else it may read; ``parts`` are its
    losses by method name, in the order of ``forward``; ``metrics`` are its metrics and ``written``
    the entries that it adds to its input.
    """

    make: Callable
    data: Callable
    parts: tuple[str, ...]
    metrics: frozenset[str]
    written: frozenset[str]

    @property
    def losses(self) -> set[str]:
        return {f"loss_{part.removesuffix('_loss')}" for part in self.parts}


def make_aca_data(*batch):
    return make_data(*batch, draws=True)


CASES = {
    "aca": LossCase(
        make_aca,
        make_aca_data,
        ("qvalue_loss", "noise_level_loss", "alpha_loss"),
        frozenset(
            {"pred_value", "target_value", "noisy_value", "alpha", "entropy", "exploration_std"}
        ),
        frozenset({"td_error"}),
    ),
    "dacer": LossCase(
        make_dacer,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss", "alpha_loss"),
        frozenset(
            {"pred_value", "target_value", "value_std", "alpha", "entropy", "exploration_std"}
        ),
        frozenset({"td_error"}),
    ),
    "dipo": LossCase(
        make_dipo,
        make_dipo_data,
        ("qvalue_loss", "actor_loss"),
        frozenset({"pred_value", "target_value", "improvement"}),
        frozenset({"td_error"}),
    ),
    "qsm": LossCase(
        make_qsm,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss"),
        frozenset({"pred_value", "target_value", "gradient_norm"}),
        frozenset({"td_error"}),
    ),
    "qvpo": LossCase(
        make_qvpo,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss"),
        frozenset({"pred_value", "target_value", "policy_weight"}),
        frozenset({"td_error"}),
    ),
    "sdac": LossCase(
        make_sdac,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss", "alpha_loss"),
        frozenset({"pred_value", "target_value", "alpha", "entropy", "exploration_std"}),
        frozenset({"td_error"}),
    ),
    "rlpd": LossCase(
        make_rlpd,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss", "alpha_loss"),
        frozenset({"pred_value", "target_value", "entropy", "alpha"}),
        frozenset({"policy_log_prob"}),
    ),
    "cql": LossCase(
        make_cql,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss", "alpha_loss"),
        frozenset({"pred_value", "target_value", "cql_gap", "entropy", "alpha"}),
        frozenset({"policy_log_prob", "cql_gap"}),
    ),
    "cql_with_threshold": LossCase(
        make_cql_with_threshold,
        make_rlpd_data,
        ("qvalue_loss", "actor_loss", "alpha_loss", "cql_weight_loss"),
        frozenset({"pred_value", "target_value", "cql_gap", "entropy", "alpha", "cql_weight"}),
        frozenset({"policy_log_prob", "cql_gap"}),
    ),
    "calql": LossCase(
        make_calql,
        make_calql_data,
        ("qvalue_loss", "actor_loss", "alpha_loss"),
        frozenset({"pred_value", "target_value", "cql_gap", "bound_rate", "entropy", "alpha"}),
        frozenset({"policy_log_prob", "cql_gap"}),
    ),
    "iql": LossCase(
        make_iql,
        make_rlpd_data,
        ("value_loss", "qvalue_loss", "actor_loss"),
        frozenset({"state_value", "pred_value", "target_value", "advantage_weight", "log_prob"}),
        frozenset(),
    ),
}
