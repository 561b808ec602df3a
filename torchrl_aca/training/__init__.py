"""Algorithm-free helpers of the recipes: environments, data, evaluation, run directory, resume."""

from torchrl_aca.training.policy import load_policy

__all__ = ["load_policy"]
