"""Replay buffer and its state, episode sums, NaN checks."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_aca.training.data import (
    BufferState,
    EpisodeTracker,
    check_finite,
    make_replay_buffer,
    transitions,
)
from torchrl_aca.errors import RunError


def collected(num_envs: int = 5, steps: int = 1, observation_dim: int = 17, action_dim: int = 6):
    shape = (num_envs, steps)
    observation = torch.randn(*shape, observation_dim)
    flag = torch.zeros(*shape, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": observation,
            "action": torch.rand(*shape, action_dim),
            "loc": torch.zeros(*shape, action_dim),
            "done": flag,
            "next": {
                "observation": observation + 1,
                "reward": torch.randn(*shape, 1),
                "done": flag.clone(),
                "terminated": flag.clone(),
                "truncated": flag.clone(),
            },
        },
        batch_size=shape,
    )


def test_transitions_are_flat_and_hold_only_what_learning_needs():
    flat = transitions(collected(num_envs=3, steps=2))
    assert flat.batch_size == (6,)
    assert "loc" not in flat.keys(True) and ("next", "truncated") not in flat.keys(True)


@pytest.mark.parametrize("rows", [7, 20, 33])
def test_buffer_state_round_trip_when_partly_filled_full_and_wrapped(rows):
    buffer, other = (make_replay_buffer(capacity=20, batch_size=4) for _ in range(2))
    for _ in range(rows):
        buffer.extend(transitions(collected(num_envs=1)))
    state = BufferState(buffer).state_dict()
    assert state["rows"]["next.reward"].shape[0] == min(rows, 20)
    BufferState(other).load_state_dict(state)
    for each in (buffer, other):
        torch.manual_seed(1)
        each.extend(transitions(collected()))
    torch.manual_seed(2)
    expected = buffer.sample()
    torch.manual_seed(2)
    assert (expected == other.sample()).all()
    assert (buffer[:] == other[:]).all()


def test_state_of_a_nearly_empty_buffer_is_small(tmp_path):
    buffer = make_replay_buffer(capacity=100_000, batch_size=4)
    buffer.extend(transitions(collected()))
    torch.save(BufferState(buffer).state_dict(), tmp_path / "buffer.pt")
    assert (tmp_path / "buffer.pt").stat().st_size < 20_000


def test_a_million_half_cheetah_transitions_stay_below_one_gibibyte():
    buffer = make_replay_buffer(capacity=10_000, batch_size=4)
    buffer.extend(transitions(collected()))
    storage = buffer.storage._storage
    size = sum(value.nbytes for value in storage.values(True, True))
    assert 100 * size < 2**30


def test_episode_tracker_sums_per_environment_and_restores():
    tracker, other = EpisodeTracker(2), EpisodeTracker(2)
    data = collected(num_envs=2, steps=4)
    data["next", "reward"] = torch.tensor([[1.0, 1, 1, 1], [2, 2, 2, 2]]).unsqueeze(-1)
    data["next", "done"][0, 1] = True
    tracker.add(data)
    assert tracker.metrics() == {
        "train_episodes": 1.0,
        "train_return": 2.0,
        "train_episode_length": 2.0,
    }
    other.load_state_dict(tracker.state_dict())
    data["next", "done"][:, 3] = True
    for each in (tracker, other):
        each.add(data)
    assert tracker.metrics() == other.metrics()
    assert list(tracker.latest) == [(2.0, 2), (4.0, 4), (2.0, 2), (16.0, 8)]


@pytest.mark.parametrize("key", ["action", ("next", "reward"), ("next", "observation")])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_check_finite_names_environment_frames_and_key(key, value):
    data = collected()
    check_finite(data, "Toy-v0", 10)
    data[key][2, 0, 0] = value
    name = key if isinstance(key, str) else ".".join(key)
    with pytest.raises(RunError, match=f"Toy-v0.*{name}.*after 10 frames"):
        check_finite(data, "Toy-v0", 10)
