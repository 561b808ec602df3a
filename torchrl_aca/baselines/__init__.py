"""Rivals of ACA: what TorchRL does not have, as TorchRL parts. The recipes make agents of them."""

from torchrl_aca.baselines.cql import CalQLLoss, EnsembleCQLLoss
from torchrl_aca.baselines.dacer import DACERLoss
from torchrl_aca.baselines.diffusion_loss import DiffusionPolicyLoss
from torchrl_aca.baselines.diffusion_policy import DiffusionPolicy
from torchrl_aca.baselines.dipo import DIPOLoss
from torchrl_aca.baselines.ensemble import EnsembleMLP
from torchrl_aca.baselines.ensemble_sac import EnsembleSACLoss
from torchrl_aca.baselines.gaussian_policy import (
    make_clipped_gaussian_policy,
    make_gaussian_policy,
    make_mlp,
)
from torchrl_aca.baselines.iql import EnsembleIQLLoss
from torchrl_aca.baselines.make_diffusion_policy import make_diffusion_policy
from torchrl_aca.baselines.networks import NoiseNetwork, TwinCritic
from torchrl_aca.baselines.qsm import QSMLoss
from torchrl_aca.baselines.qvpo import QVPOLoss
from torchrl_aca.baselines.sdac import SDACLoss

__all__ = [
    "CalQLLoss",
    "DACERLoss",
    "DIPOLoss",
    "DiffusionPolicy",
    "DiffusionPolicyLoss",
    "EnsembleCQLLoss",
    "EnsembleIQLLoss",
    "EnsembleMLP",
    "EnsembleSACLoss",
    "NoiseNetwork",
    "QSMLoss",
    "QVPOLoss",
    "SDACLoss",
    "TwinCritic",
    "make_clipped_gaussian_policy",
    "make_diffusion_policy",
    "make_gaussian_policy",
    "make_mlp",
]
