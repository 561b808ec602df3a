"""Offline data beside online data; no algorithm."""

from torchrl_aca.offline.mixture import MixedReplayBuffer

__all__ = ["MixedReplayBuffer"]
