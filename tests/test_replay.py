"""Rows, the replay buffer and its state."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs.transforms import RewardScaling

from recipe_cases import collected
from torchrl_aca.replay import (
    BufferState,
    MixedReplayBuffer,
    make_replay_buffer,
    require_index,
    transitions,
    write_back,
)


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


def test_what_a_method_rewrites_begins_as_a_copy():
    data = collected(num_envs=3, steps=2)
    rows = transitions(data, rewritten={"best_action": "action"})
    assert torch.equal(rows["best_action"], rows["action"])
    rows["best_action"].zero_()
    assert rows["action"].any() and data["action"].any()
    assert "best_action" not in data


@pytest.mark.parametrize("num_rows", [12, 20, 33])
def test_rewritten_entries_reach_the_rows_that_were_sampled_and_no_others(num_rows):
    buffer = make_replay_buffer(capacity=20, batch_size=8)
    for _ in range(num_rows):
        data = collected(num_envs=1)
        buffer.extend(transitions(data, rewritten={"best_action": "action"}))
    before = buffer[:].clone()
    batch = buffer.sample()
    batch["best_action"] = batch["best_action"] + 1
    write_back(buffer, batch, ["best_action"])
    after, changed = buffer[:], batch["index"].unique()
    assert 1 < len(changed) < len(buffer)
    expected = before["best_action"].index_add(0, changed, torch.ones(len(changed), 6))
    assert torch.equal(after["best_action"], expected)
    assert (after.exclude("best_action") == before.exclude("best_action")).all()
    for index, action in zip(batch["index"], batch["best_action"], strict=True):
        assert torch.equal(buffer[int(index)]["best_action"], action)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: ReplayBuffer(storage=LazyTensorStorage(5)), "ReplayBuffer"),
        (lambda: TensorDictReplayBuffer(storage=ListStorage(5)), "TensorDictReplayBuffer"),
        (
            lambda: TensorDictReplayBuffer(storage=LazyTensorStorage(5, ndim=2)),
            "TensorDictReplayBuffer",
        ),
        (
            lambda: MixedReplayBuffer(
                TensorDict(action=torch.zeros(3, 1), batch_size=[3]), make_replay_buffer(5, 2)
            ),
            "MixedReplayBuffer",
        ),
    ],
    ids=["no index", "no tensors", "two dimensions", "mixture"],
)
def test_a_buffer_whose_rows_cannot_be_rewritten_is_refused(make, name):
    with pytest.raises(ValueError, match=f"the index of each row; got a {name}"):
        require_index(make())


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


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ({"transform": RewardScaling(0.0, 0.5)}, "no transform"),
        ({"sampler": SamplerWithoutReplacement()}, "uniform RandomSampler"),
        ({"storage": LazyTensorStorage(20, ndim=2)}, "ndim=1"),
    ],
)
def test_a_buffer_with_more_of_a_state_than_its_rows_is_refused(kind, message):
    buffer = TensorDictReplayBuffer(**{"storage": LazyTensorStorage(20), "batch_size": 4} | kind)
    with pytest.raises(ValueError, match=f"The saved buffer must have .*{message}"):
        BufferState(buffer)


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
