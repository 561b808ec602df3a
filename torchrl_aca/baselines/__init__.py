"""Rivals of ACA: what TorchRL does not have, as TorchRL parts. The recipes make agents of them."""

from torchrl_aca.baselines.cql import CalQLLoss, EnsembleCQLLoss
from torchrl_aca.baselines.ensemble import EnsembleMLP
from torchrl_aca.baselines.ensemble_sac import EnsembleSACLoss
from torchrl_aca.baselines.iql import EnsembleIQLLoss

__all__ = ["CalQLLoss", "EnsembleCQLLoss", "EnsembleIQLLoss", "EnsembleMLP", "EnsembleSACLoss"]
