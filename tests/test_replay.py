"""Rows, the replay buffer and its state."""

from __future__ import annotations

import pytest
import torch

from recipe_cases import collected
from torchrl_aca.replay import BufferState, make_replay_buffer, transitions


def test_transitions_are_flat_and_hold_only_what_learning_needs():
    flat = transitions(collected(num_envs=3, steps=2))
    assert flat.batch_size == (6,)
    assert "loc" not in flat.keys(True) and ("next", "truncated") not in flat.keys(True)


def test_a_method_keeps_keys_of_its_own():
    data = collected(num_envs=3, steps=2)
    data["next", "value"] = torch.rand(3, 2, 1)
    flat = transitions(data, ["loc", ("next", "value")])
    assert flat.batch_size == (6,)
    assert torch.equal(flat["next", "value"], data["next", "value"].flatten(0, 1))
    assert flat["loc"].shape == (6, 6) and ("next", "reward") in flat.keys(True)
    with pytest.raises(KeyError, match="mc_return"):
        transitions(data, ["mc_return"])


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


def test_state_holds_the_keys_that_are_asked_for():
    keys = ("observation", ("next", "reward"), "loc")
    buffer, other = (make_replay_buffer(capacity=20, batch_size=4) for _ in range(2))
    buffer.extend(collected(num_envs=7).reshape(-1))
    state = BufferState(buffer, keys).state_dict()
    assert set(state["rows"]) == {"observation", "next.reward", "loc"}
    BufferState(other, keys).load_state_dict(state)
    assert torch.equal(other[:]["loc"], buffer[:]["loc"])
