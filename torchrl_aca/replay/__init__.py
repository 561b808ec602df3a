"""Replay: what a row is, the buffer and its state, exact mixtures. Knows no algorithm."""

from torchrl_aca.replay.buffer import (
    TRANSITION_KEYS,
    BufferState,
    make_replay_buffer,
    require_index,
    transitions,
    write_back,
)
from torchrl_aca.replay.episodes import FinishedEpisodes
from torchrl_aca.replay.mixture import MixedReplayBuffer
from torchrl_aca.replay.multi_step import with_last_flags

__all__ = [
    "TRANSITION_KEYS",
    "BufferState",
    "FinishedEpisodes",
    "MixedReplayBuffer",
    "make_replay_buffer",
    "require_index",
    "transitions",
    "with_last_flags",
    "write_back",
]
