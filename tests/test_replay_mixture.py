"""Mixture of offline and online rows: shares, draws, state, errors."""

from __future__ import annotations

from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.envs import RewardScaling

from torchrl_aca.errors import RunError
from torchrl_aca.replay import MixedReplayBuffer, transitions
from torchrl_aca.training.checkpoint import Counters, read_checkpoint, restore, save_checkpoint

FLOAT64 = torch.float64


def rows(n: int, first: int = 0, dtype: torch.dtype = torch.float32) -> TensorDict:
    """n transitions whose reward is their number, counted from `first`."""
    number = torch.arange(first, first + n).unsqueeze(-1)
    observation = number + torch.zeros(n, 3, dtype=dtype)
    flag = torch.zeros(n, 1, dtype=torch.bool)
    following = {
        "observation": observation + 1,
        "reward": number.float(),
        "done": number % 5 == 4,
        "terminated": flag,
    }
    content = {"observation": observation, "action": -number.float().expand(n, 2).clone()}
    return TensorDict({**content, "next": following}, batch_size=[n])


def numbers(batch: TensorDict) -> np.ndarray:
    return batch["next", "reward"].squeeze(-1).numpy().astype(int)


def online_buffer(n: int = 0, capacity: int = 100, **kwargs) -> TensorDictReplayBuffer:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), **kwargs)
    if n:
        buffer.extend(rows(n, first=1000))
    return buffer


def mixture(offline: int = 20, online: int = 7, **kwargs) -> MixedReplayBuffer:
    """Offline rows have the numbers 0, 1, ...; online rows 1000, 1001, ..."""
    return MixedReplayBuffer(rows(offline), online_buffer(online), **kwargs)


# --- shares ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0, 0.1, 0.25, 0.29, 1 / 3, 0.5, 0.7, 0.999, 1])
@pytest.mark.parametrize("batch_size", [1, 2, 5, 7, 50, 255, 256])
def test_every_batch_has_the_same_share_rounded_half_up(fraction, batch_size):
    due = Decimal(str(fraction)) * batch_size
    expected = int(due.to_integral_value(ROUND_HALF_UP))
    buffer = mixture(offline_fraction=fraction, batch_size=batch_size)
    assert buffer.num_offline(batch_size) == expected
    for _ in range(3):
        batch = buffer.sample()
        assert batch.batch_size == (batch_size,)
        assert (numbers(batch)[:expected] < 20).all()
        assert (numbers(batch)[expected:] >= 1000).all()


def test_half_of_256_is_128_and_a_batch_size_can_be_given():
    buffer = mixture(batch_size=256)
    assert (numbers(buffer.sample()) < 1000).sum() == 128
    assert (numbers(buffer.sample(10)) < 1000).sum() == 5


def test_rows_stay_whole_and_keep_their_dtypes():
    batch = mixture(batch_size=64).sample()
    number = batch["next", "reward"]
    assert (batch["observation"] == number).all()
    assert (batch["next", "observation"] == number + 1).all()
    assert (batch["action"] == -number).all()
    assert (batch["next", "done"] == (number % 5 == 4)).all()
    assert batch["next", "done"].dtype is torch.bool
    assert batch["observation"].dtype is torch.float32


def test_without_a_half_that_no_row_comes_from():
    only_offline = MixedReplayBuffer(rows(4), online_buffer(), offline_fraction=1, batch_size=8)
    assert (numbers(only_offline.sample()) < 4).all()
    keys = ["observation", ("next", "reward")]
    only_online = MixedReplayBuffer(None, online_buffer(), offline_fraction=0, keys=keys)
    only_online.extend(rows(4, first=1000))
    batch = only_online.sample(8)
    assert (numbers(batch) >= 1000).all()
    assert set(batch.keys(True, True)) == set(keys)


def test_the_fraction_changes_between_two_phases():
    buffer = mixture(online=0, offline_fraction=1, batch_size=10)
    assert (numbers(buffer.sample()) < 20).all()
    buffer.offline_fraction = 0.3
    buffer.extend(rows(4, first=1000))
    assert (numbers(buffer.sample()) < 20).sum() == 3 == buffer.num_offline(10)
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"offline_fraction in \[0, 1\], got"):
            buffer.offline_fraction = wrong
    assert buffer.offline_fraction == 0.3


# --- draws ----------------------------------------------------------------------------------------


def test_each_half_is_drawn_uniformly_with_replacement():
    buffer = mixture(offline=20, online=7, offline_fraction=0.75, batch_size=40, seed=3)
    draws = np.concatenate([numbers(buffer.sample()) for _ in range(500)])
    for first, count, total in ((0, 20, 15_000), (1000, 7, 5_000)):
        counts = np.bincount(draws[(draws >= first) & (draws < first + count)] - first)
        assert counts.shape == (count,) and counts.sum() == total
        chi_square = ((counts - total / count) ** 2 / (total / count)).sum()
        # A chi-square of k = count - 1 degrees has mean k and variance 2 k.
        assert abs(chi_square - (count - 1)) < 4 * np.sqrt(2 * (count - 1))


def test_a_row_can_come_twice_in_a_batch():
    assert (
        numbers(mixture(offline=1, online=1, batch_size=4).sample()) == [0, 0, 1000, 1000]
    ).all()


def test_the_seed_fixes_the_draws_and_the_global_stream_is_left_alone():
    one, same, other = (mixture(seed=seed) for seed in (1, 1, 2))
    before = torch.get_rng_state()
    for _ in range(3):
        first = one.sample()
        torch.rand(1)  # what others draw does not matter
        assert (first == same.sample()).all()
    assert (numbers(first) != numbers(other.sample())).any()
    torch.set_rng_state(before)
    one.sample()
    assert torch.equal(torch.get_rng_state(), before)


def test_batches_do_not_share_memory_with_each_other_or_with_the_data():
    offline = rows(20)
    buffer = MixedReplayBuffer(offline, online_buffer(7), batch_size=6)
    first, second = buffer.sample(), buffer.sample()
    kept = second.clone()
    first.zero_()
    assert (second == kept).all()
    assert (offline == rows(20)).all()
    assert (buffer.online[:].exclude("index") == rows(7, first=1000)).all()


# --- online rows ----------------------------------------------------------------------------------


def test_extend_and_add_reach_the_online_half_and_leave_their_input():
    buffer = mixture(online=0, offline_fraction=0, batch_size=30)
    data = rows(3, first=1000)
    data["unused"] = torch.zeros(3)
    kept = data.clone()
    assert buffer.extend(data).tolist() == [0, 1, 2]
    assert buffer.add(rows(1, first=1003)[0]) == 3
    assert set(data.keys(True)) == set(kept.keys(True)) and (data == kept).all()
    assert "unused" not in list(buffer.online[:].keys())
    assert set(numbers(buffer.sample())) == {1000, 1001, 1002, 1003}
    assert len(buffer) == 20 + 4


def test_an_online_buffer_that_wraps_around_loses_its_oldest_rows():
    buffer = MixedReplayBuffer(rows(5), online_buffer(capacity=10), batch_size=400)
    for first in range(1000, 1025, 5):
        buffer.extend(rows(5, first=first))
    assert len(buffer) == 5 + 10
    assert set(numbers(buffer.sample())) == {*range(5), *range(1015, 1025)}


def test_rows_that_a_collector_wrote_are_drawn_too():
    buffer = mixture(online=0, offline_fraction=0, batch_size=50)
    buffer.online.extend(rows(4, first=1000))
    assert set(numbers(buffer.sample())) == {1000, 1001, 1002, 1003}


# --- kinds of halves ------------------------------------------------------------------------------


def memmap(data: TensorDict, path) -> TensorDict:
    data.memmap(path)
    return TensorDict.load_memmap(path)


def plain_buffer(data: TensorDict, path) -> ReplayBuffer:
    return ReplayBuffer(storage=TensorStorage(data))


def tensordict_buffer(data: TensorDict, path) -> TensorDictReplayBuffer:
    buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(50, scratch_dir=path))
    buffer.extend(data)
    return buffer


@pytest.mark.parametrize("kind", [memmap, plain_buffer, tensordict_buffer])
def test_offline_rows_may_lie_on_disk_or_in_a_buffer(kind, tmp_path):
    offline = kind(rows(20), tmp_path / "offline")
    buffer = MixedReplayBuffer(offline, online_buffer(7), seed=5)
    batch, expected = buffer.sample(), mixture(seed=5).sample()
    assert set(batch.keys(True, True)) == set(expected.keys(True, True))
    assert (batch == expected).all()
    assert all(type(value) is torch.Tensor for value in batch.values(True, True))


def test_keys_project_both_halves():
    keys = ["observation", "action", ("next", "reward")]
    offline, online = rows(20), online_buffer()
    offline["mc_return"] = torch.zeros(20)
    online.extend(rows(7).set("info", torch.zeros(7)))
    batch = MixedReplayBuffer(offline, online, keys=keys).sample()
    assert set(batch.keys(True, True)) == set(keys)


# --- state ----------------------------------------------------------------------------------------


def step(buffer: MixedReplayBuffer, first: int) -> TensorDict:
    buffer.extend(rows(4, first=first))
    return buffer.sample(16)


@pytest.mark.parametrize("stored", [0, 7, 10, 13])  # empty, partly filled, full, wrapped
@pytest.mark.parametrize("through_files", [False, True])
def test_save_load_continue_equals_never_stopping(stored, through_files, tmp_path):
    def build():
        return MixedReplayBuffer(rows(20), online_buffer(capacity=10), offline_fraction=0.5, seed=1)

    through, resumed = build(), build()
    for first in range(1000, 1000 + stored):
        through.extend(rows(1, first=first))
        through.sample()
    if through_files:
        through.dumps(tmp_path / "made" / "here")
        resumed.loads(tmp_path / "made" / "here")
    else:
        torch.save(through.state_dict(), tmp_path / "state.pt")
        resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for first in (2000, 3000, 4000):
        assert (step(through, first) == step(resumed, first)).all()
    assert (through.online[:] == resumed.online[:]).all()


def test_a_mixture_is_a_part_of_a_run_checkpoint(tmp_path):
    buffer, other, foreign = mixture(seed=1), mixture(seed=2), mixture(offline=21)
    collected = rows(6, first=1000).reshape(3, 2)  # as a collector gives it: (num_envs, steps)
    buffer.extend(transitions(collected))
    parts = {"buffer": buffer, "counters": Counters()}
    save_checkpoint(tmp_path / "checkpoints", parts, {}, updates=1, keep_last=1)
    states = read_checkpoint(tmp_path)["parts"]
    restore({"buffer": other}, states)
    assert (buffer.sample() == other.sample()).all()
    with pytest.raises(RunError, match="another mixture"):
        restore({"buffer": foreign}, states)


def test_the_fraction_is_a_part_of_the_state():
    through, resumed = mixture(seed=1, offline_fraction=0.5), mixture(offline_fraction=0.5)
    through.offline_fraction = 1
    resumed.load_state_dict(through.state_dict())
    assert resumed.offline_fraction == 1
    assert (through.sample(8) == resumed.sample(8)).all()
    assert (numbers(resumed.sample(8)) < 20).all()


def test_offline_rows_are_identified_and_not_saved(tmp_path):
    MixedReplayBuffer(rows(50_000), online_buffer(7)).dumps(tmp_path)
    assert (tmp_path / "mixture.pt").stat().st_size < 20_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("rows", "expected offline rows 20, got 21"),
        ("values", "expected offline fingerprint"),
        ("dtype", "expected offline fingerprint"),
        ("keys", "expected keys .* got .'observation'"),
        ("capacity", "expected online capacity 100, got 50"),
        ("batch", "expected batch_size 256, got 64"),
    ],
)
def test_the_state_of_another_mixture_is_refused_and_nothing_changes(change, message):
    state = mixture(online=7).state_dict()
    offline = rows(21 if change == "rows" else 20)
    if change == "values":
        offline["action"][3, 1] += 1
    elif change == "dtype":
        offline["action"] = offline["action"].half()
    keys = ["observation", ("next", "reward")] if change == "keys" else None
    online = online_buffer(capacity=50 if change == "capacity" else 100)
    other = MixedReplayBuffer(
        offline, online, keys=keys, batch_size=64 if change == "batch" else 256
    )
    with pytest.raises(ValueError, match=f"another mixture: {message}"):
        other.load_state_dict(state)
    assert len(other.online) == 0


def test_one_changed_row_among_many_makes_other_data():
    data, online = rows(5_000), online_buffer(7)
    state = MixedReplayBuffer(data, online).state_dict()
    data["next", "reward"][4_321] += 1
    with pytest.raises(ValueError, match="expected offline fingerprint"):
        MixedReplayBuffer(data, online).load_state_dict(state)


# --- errors ---------------------------------------------------------------------------------------


def test_returns_over_several_steps_are_not_mixed_with_single_steps():
    several = rows(4).set("steps_to_next_obs", torch.full((4, 1), 3))
    with pytest.raises(
        ValueError, match="'steps_to_next_obs', so its rewards are sums over several"
    ):
        mixture().extend(several)
    single = [key for key in several.keys(True, True) if key != "steps_to_next_obs"]
    with pytest.raises(ValueError, match="The offline half has 'steps_to_next_obs'"):
        MixedReplayBuffer(several, online_buffer(), keys=single)
    both = MixedReplayBuffer(several, online_buffer())
    both.extend(several)
    assert (both.sample(8)["steps_to_next_obs"] == 3).all()


@pytest.mark.parametrize("fraction", [-0.1, 1.1, float("nan")])
def test_a_fraction_outside_of_zero_to_one_is_refused(fraction):
    with pytest.raises(ValueError, match=r"offline_fraction in \[0, 1\], got"):
        mixture(offline_fraction=fraction)


def test_a_batch_without_rows_is_refused():
    with pytest.raises(ValueError, match="batch_size=0"):
        mixture(batch_size=0)
    with pytest.raises(ValueError, match="batch_size=0"):
        mixture().sample(0)


def test_an_empty_half_that_is_needed_is_an_error():
    with pytest.raises(ValueError, match="128 online rows.*empty online half"):
        mixture(online=0).sample()
    with pytest.raises(ValueError, match="128 offline rows.*empty offline half"):
        mixture(offline=0).sample()


def test_no_offline_half_needs_a_fraction_of_zero_and_keys():
    for arguments in ({"keys": ["action"]}, {"offline_fraction": 0}):
        with pytest.raises(ValueError, match="offline=None needs offline_fraction=0 and keys"):
            MixedReplayBuffer(None, online_buffer(), **arguments)


def test_an_online_half_on_its_own_may_lie_on_another_device():
    online = TensorDictReplayBuffer(storage=LazyTensorStorage(9, device="meta"))
    whole = MixedReplayBuffer(None, online, offline_fraction=0, batch_size=2, keys=["action"])
    for _ in range(2):
        whole.extend(rows(3))
    assert whole.sample()["action"].device.type == "meta"
    with pytest.raises(ValueError, match="the layout of the rows.*'action' expected torch.float32"):
        whole.extend(rows(3).apply(lambda x: x.double() if x.is_floating_point() else x))


def mismatches():
    double = rows(4, dtype=FLOAT64)
    yield "dtype", double, "'observation' expected torch.float32.*got torch.float64"
    wide = rows(4).set("action", torch.zeros(4, 5))
    yield "shape", wide, r"'action' expected .* \(n, 2\).*got .* \(n, 5\)"
    yield "key", rows(4).exclude("action"), "tensor under 'action', got NoneType"
    yield "batch dimensions", rows(4).reshape(2, 2), r"batch size \(2, 2\).*reshape\(-1\)"


@pytest.mark.parametrize(
    ("data", "message"), [pytest.param(d, m, id=name) for name, d, m in mismatches()]
)
def test_data_that_does_not_fit_is_refused_before_it_is_stored(data, message):
    buffer = mixture()
    with pytest.raises(ValueError, match=message):
        buffer.extend(data)
    assert len(buffer.online) == 7


def test_online_rows_that_do_not_fit_are_refused_at_the_start_or_when_they_come():
    online = online_buffer()
    late = MixedReplayBuffer(rows(20), online)
    online.extend(rows(4, dtype=FLOAT64))
    for attempt in (late.sample, lambda: MixedReplayBuffer(rows(20), online)):
        with pytest.raises(ValueError, match="The online half .* 'observation' .*torch.float64"):
            attempt()


def test_without_offline_data_the_first_rows_set_the_layout():
    keys = ["observation", "action"]
    buffer = MixedReplayBuffer(None, online_buffer(), offline_fraction=0, keys=keys)
    buffer.add(rows(1)[0])
    with pytest.raises(ValueError, match="expected torch.float32.*got torch.float64"):
        buffer.add(rows(1, dtype=FLOAT64)[0])


def test_a_key_that_names_no_tensor_is_refused():
    with pytest.raises(ValueError, match="tensor under 'next', got TensorDict"):
        mixture(keys=["next"])


def test_buffers_that_cannot_be_drawn_uniformly_are_refused():
    scaled = online_buffer(transform=RewardScaling(0, 0.2, in_keys=[("next", "reward")]))
    refused = {
        "SamplerWithoutReplacement": online_buffer(sampler=SamplerWithoutReplacement()),
        "ListStorage": ReplayBuffer(storage=ListStorage(10)),
        "ndim=2": TensorDictReplayBuffer(storage=LazyTensorStorage(10, ndim=2)),
        "no transform": scaled,
    }
    for message, online in refused.items():
        with pytest.raises(ValueError, match=f"The online buffer must .*{message}"):
            MixedReplayBuffer(rows(4), online)
    with pytest.raises(ValueError, match="The offline buffer must have no transform"):
        MixedReplayBuffer(scaled, online_buffer())
    with pytest.raises(ValueError, match="offline must be a TensorDict.*got dict"):
        MixedReplayBuffer(rows(4).to_dict(), online_buffer())


def test_prioritised_replay_is_refused():
    pytest.importorskip("torchrl._torchrl", exc_type=ImportError)
    from torchrl.data import TensorDictPrioritizedReplayBuffer

    online = TensorDictPrioritizedReplayBuffer(
        alpha=0.6, beta=0.4, storage=LazyTensorStorage(10), batch_size=2
    )
    with pytest.raises(ValueError, match="RandomSampler, got PrioritizedSampler"):
        MixedReplayBuffer(rows(4), online)
