"""Units and specs: the critic's box and the environment's, and what is refused."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from actor_cases import ACTION, BATCH, DETERMINISTIC, OBS, act, make_actor, make_critic, observe
from torchrl_aca import NoiseSchedule

BOUNDS = {
    "humanoid": ([-0.4] * 3, [0.4] * 3),
    "pendulum": ([-3.0] * 3, [3.0] * 3),
    "asymmetric": ([-1.0, 0.0, -3.0], [1.0, 2.0, 5.0]),
}


@pytest.fixture(params=BOUNDS)
def box(request):
    low, high = (torch.tensor(side) for side in BOUNDS[request.param])
    return Bounded(low, high, shape=(ACTION,), dtype=torch.float32)


def test_units_are_mapped_by_the_bounds_and_back(box):
    actor = make_actor(spec=box)
    corners = torch.tensor([[-1.0], [0.0], [1.0]]).expand(-1, ACTION)
    low, high = box.space.low, box.space.high
    torch.testing.assert_close(actor.to_env(corners), torch.stack([low, (low + high) / 2, high]))
    action = torch.randn(BATCH, ACTION)
    torch.testing.assert_close(actor.from_env(actor.to_env(action)), action)
    torch.testing.assert_close(actor.to_env(actor.from_env(action)), action)


def test_actions_are_in_the_units_of_the_env(box):
    critic, td = make_critic(), observe(50)
    plain, scaled = make_actor(critic), make_actor(critic, spec=box)
    with DETERMINISTIC:
        action = act(scaled, td)
        torch.testing.assert_close(action, scaled.to_env(act(plain, td)))
    assert box.is_in(action)
    noisy = act(scaled, td, seed=0)
    torch.testing.assert_close(noisy, scaled.to_env(act(plain, td, seed=0)))


def test_exploration_noise_leaves_the_box_unless_the_action_is_clipped(box):
    critic, td = make_critic(), observe(50)
    free = act(make_actor(critic, spec=box), td, seed=0)
    clipped = act(make_actor(critic, spec=box, clip_action=True), td, seed=0)
    assert not box.is_in(free)
    low, high = box.space.low, box.space.high
    torch.testing.assert_close(clipped, free.clamp(low, high))


def test_a_clipped_action_is_within_the_bounds_to_the_last_bit():
    low, high = torch.tensor([-2.0, -0.3, 0.1]), torch.tensor([0.4, 1.1, 0.7])
    spec = Bounded(low, high, (3,))
    actor = make_actor(spec=spec, exploration_noise=9.0, clip_action=True)
    corners = actor.to_env(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    torch.testing.assert_close(corners, torch.stack([low, high]))
    assert all(spec.is_in(corner) for corner in corners)
    assert all(spec.is_in(action) for action in act(actor, observe(50)))


def test_without_a_spec_both_units_are_the_same():
    actor, action = make_actor(), torch.randn(BATCH, ACTION)
    assert torch.equal(actor.to_env(action), action)
    assert torch.equal(actor.from_env(action), action)


@pytest.mark.parametrize("key", ["action", ("agent", "action")])
def test_a_composite_holds_the_spec_under_the_actions_key(box, key):
    composite = Composite({key: box})
    actor = make_actor(spec=composite, out_keys=[key])
    assert torch.equal(actor.to_env(torch.ones(ACTION)), box.space.high)
    assert actor.spec[key] == box


@pytest.mark.parametrize(
    "spec",
    [
        Unbounded(shape=(ACTION,)),
        Categorical(4),
        Bounded(-1, 1, shape=(5, ACTION)),
        Bounded(-1, 1, shape=()),
        Bounded(0, 3, shape=(ACTION,), dtype=torch.int64),
        Composite(action=Unbounded(shape=(ACTION,))),
    ],
    ids=["unbounded", "discrete", "batched", "scalar", "integer", "composite"],
)
def test_other_specs_are_refused_with_the_fix(spec):
    with pytest.raises(ValueError, match=r"bounded, continuous.*env.action_spec_unbatched; got"):
        make_actor(spec=spec)


@pytest.mark.parametrize("high", [float("inf"), float("nan")])
def test_bounds_must_be_finite(high):
    box = Bounded(-torch.ones(ACTION), torch.tensor([1.0, 1.0, high]))
    with pytest.raises(ValueError, match="must be finite"):
        make_actor(spec=box)


def test_a_missing_observation_is_named():
    with pytest.raises(KeyError, match="observation"):
        make_actor()(TensorDict(state=torch.zeros(2, OBS), batch_size=[2]))


def test_a_call_without_candidates_is_refused():
    with pytest.raises(ValueError, match="num_candidates >= 1, got num_candidates=0"):
        make_actor().sample(torch.zeros(2, OBS), [2], num_candidates=0)


@pytest.mark.parametrize(
    "bad",
    [
        {"num_candidates": 0},
        {"tile_rows": 0},
        {"guidance_weight": -1.0},
        {"guidance_weight": float("nan")},
        {"exploration_noise": -0.1},
        {"alpha_init": 0.0},
    ],
)
def test_numbers_out_of_range_are_refused(bad):
    (name, value), *_ = bad.items()
    with pytest.raises(ValueError, match=f"{name} >.*{name}={value}"):
        make_actor(**bad)


def test_critic_and_schedule_must_have_the_same_number_of_levels():
    with pytest.raises(ValueError, match="num_steps=6.*the schedule 7. Build both"):
        make_actor(schedule=NoiseSchedule.cosine(7))
