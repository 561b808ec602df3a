"""Actor-Critic without Actor (ACA) as composable TorchRL modules."""

from torchrl_aca.actor import CriticGuidedDenoisingActor
from torchrl_aca.critic import NoiseLevelCritic, NoiseLevelCriticBase
from torchrl_aca.custom_critic import CustomCritic
from torchrl_aca.loss import ACALoss
from torchrl_aca.make import make_aca, make_aca_actor
from torchrl_aca.schedule import NoiseSchedule

__all__ = [
    "ACALoss",
    "CriticGuidedDenoisingActor",
    "CustomCritic",
    "NoiseLevelCritic",
    "NoiseLevelCriticBase",
    "NoiseSchedule",
    "make_aca",
    "make_aca_actor",
]
__version__ = "0.1.0"
