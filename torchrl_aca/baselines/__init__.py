"""Rivals of ACA: what TorchRL does not have, as TorchRL parts. The recipes make agents of them."""

from torchrl_aca.baselines.ensemble import EnsembleMLP
from torchrl_aca.baselines.ensemble_sac import EnsembleSACLoss

__all__ = ["EnsembleMLP", "EnsembleSACLoss"]
