"""Acting: exploration types and their noise, batch shapes, keys, dtypes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actor_cases import (
    ACTION,
    BATCH,
    CANDIDATES,
    DETERMINISTIC,
    OBS,
    act,
    make_actor,
    make_critic,
    observe,
)

# --- exploration ----------------------------------------------------------------------------------


QUIET = ["DETERMINISTIC", "MODE", "MEAN", "MEDIAN"]


@pytest.mark.parametrize("kind", QUIET)
def test_quiet_exploration_types_make_the_action_a_function_of_the_observation(kind):
    actor, td = make_actor(), observe(BATCH)
    with set_exploration_type(ExplorationType[kind]):
        before = torch.get_rng_state()
        action = act(actor, td)
        assert torch.equal(act(actor, td), action)
        assert torch.equal(torch.get_rng_state(), before)  # draws nothing
    assert action.abs().max() <= 1
    with DETERMINISTIC:
        assert torch.equal(act(actor, td), action)


@pytest.mark.parametrize("kind", [None, ExplorationType.RANDOM])
def test_exploration_noise_has_standard_deviation_scale_times_alpha(kind):
    actor = make_actor(exploration_noise=0.3, alpha_init=4.0, num_candidates=2)
    td = observe(4000)
    with set_exploration_type(kind):
        noisy = act(actor, td, seed=1)
        actor.exploration_noise = 0.0
        quiet = act(actor, td, seed=1)
        assert not torch.equal(act(actor, td, seed=2), quiet)  # the chain itself is random
    noise = (noisy - quiet).flatten()
    assert noise.mean().abs() < 0.05
    assert noise.std().item() == pytest.approx(1.2, rel=0.03)
    assert quiet.abs().max() <= 1


def test_exploration_noise_follows_log_alpha():
    actor, td = make_actor(alpha_init=5.0), observe(BATCH)
    assert actor.log_alpha.exp().item() == pytest.approx(5)
    actions = []
    for alpha in (1e-20, 1.0, 2.0):
        nn.init.constant_(actor.log_alpha, np.log(alpha))
        actions.append(act(actor, td, seed=0))
    quiet, once, twice = actions
    torch.testing.assert_close(twice - quiet, 2 * (once - quiet), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", [ExplorationType.RANDOM, None])
def test_same_seed_gives_the_same_action(kind):
    actor, td = make_actor(), observe(BATCH)
    with set_exploration_type(kind):
        assert torch.equal(act(actor, td, seed=3), act(actor, td, seed=3))
        assert not torch.equal(act(actor, td, seed=3), act(actor, td, seed=4))


def test_actors_built_after_other_draws_have_the_same_fixed_noise():
    critic = make_critic()
    first = make_actor(critic)
    torch.randn(7)
    assert torch.equal(make_actor(critic).fixed_noise, first.fixed_noise)


def test_deterministic_calls_may_draw_afresh_and_still_explore_nothing():
    critic, td = make_critic(), observe(BATCH)
    actor = make_actor(critic, deterministic_draws="fresh")
    quiet = make_actor(critic, exploration_noise=0.0)
    with DETERMINISTIC:
        action = act(actor, td, seed=1)
        assert not torch.equal(act(actor, td, seed=2), action)
    assert torch.equal(action, act(quiet, td, seed=1))
    many = actor.sample(td["observation"], [BATCH], num_candidates=99, deterministic=True)
    assert many.shape == (BATCH, ACTION)


def test_explore_adds_the_draw_scaled_by_alpha():
    actor, (action, draw) = make_actor(exploration_noise=0.3, alpha_init=4.0), torch.randn(2, 5, 3)
    torch.testing.assert_close(actor.explore(action, draw), action + 1.2 * draw)


def test_building_an_actor_leaves_the_global_random_state_alone():
    critic = make_critic()
    before = torch.get_rng_state()
    make_actor(critic)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_a_state_acts_alone_as_it_does_in_a_batch(dtype, tolerance):
    actor, td = make_actor(make_critic(dtype=dtype)), observe(BATCH, dtype=dtype)
    with DETERMINISTIC:
        together = act(actor, td)
        alone = torch.stack([act(actor, one) for one in td.unbind(0)])
    torch.testing.assert_close(together, alone, rtol=0, atol=tolerance)


def test_fewer_candidates_may_be_asked_for():
    actor, td = make_actor(), observe(BATCH)
    observation = td["observation"]
    one = actor.sample(observation, [BATCH], num_candidates=1, deterministic=True)
    draws = actor.fixed_noise[:, :1, None].expand(-1, -1, BATCH, -1)
    torch.testing.assert_close(one, actor.denoise(observation, draws)[0])
    many = actor.sample(observation, [BATCH], num_candidates=3 * CANDIDATES)
    assert many.shape == (BATCH, ACTION)


def test_a_deterministic_call_has_no_more_candidates_than_the_actor():
    with pytest.raises(ValueError, match="draws for 5 candidates, got num_candidates=6. Build"):
        make_actor().sample(torch.randn(OBS), [], num_candidates=6, deterministic=True)


# --- TensorDicts ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
@pytest.mark.parametrize("batch", [(), (BATCH,), (2, 3)])
def test_actions_have_the_batch_shape_of_the_observations(batch, kind):
    actor, td = make_actor(), observe(*batch)
    with set_exploration_type(kind):
        assert actor(td) is td
    assert td["action"].shape == (*batch, ACTION) and td["action"].dtype == torch.float32


def test_a_batch_of_rollouts_acts_as_its_flat_rows():
    actor, td = make_actor(), observe(2, 3)
    with DETERMINISTIC:
        nested, flat = act(actor, td), act(actor, td.reshape(-1))
    assert torch.equal(nested.reshape(-1, ACTION), flat)


def test_only_the_action_is_written():
    actor, td = make_actor(), observe(BATCH)
    td["other"] = torch.randn(BATCH, 2)
    before = td.clone()
    assert set(actor(td).keys()) == {"observation", "other", "action"}
    assert (td.exclude("action") == before).all()


def test_keys_may_be_renamed_and_nested():
    state, action = ("agent", "state"), ("agent", "action")
    actor = make_actor(make_critic(in_keys=[state, action, "noise_level"]), out_keys=[action])
    assert actor.in_keys == [state] and actor.out_keys == [action]
    assert actor.spec[action].shape == (ACTION,)
    observation = torch.randn(BATCH, OBS)
    agent = TensorDict(state=observation, batch_size=[BATCH])
    with DETERMINISTIC:
        td = actor(TensorDict(agent=agent, batch_size=[BATCH]))
    expected = actor.sample(observation, [BATCH], deterministic=True)
    assert torch.equal(td[action], expected)


def test_the_observation_key_may_differ_from_the_critics():
    actor = make_actor(in_keys=["state"])
    td = actor(TensorDict(state=torch.randn(BATCH, OBS), batch_size=[BATCH]))
    assert td["action"].shape == (BATCH, ACTION)


@pytest.mark.parametrize("batch", [(), (BATCH,), (2, 3)])
def test_plain_tensors_act_as_a_tensordict(batch):
    actor, td = make_actor(), observe(*batch)
    with DETERMINISTIC:
        expected = act(actor, td)
        assert torch.equal(actor(td["observation"]), expected)
        assert torch.equal(actor(observation=td["observation"]), expected)


def test_float64_observations_give_actions_of_the_critics_dtype():
    actor, td = make_actor(), observe(BATCH, dtype=torch.float64)
    with DETERMINISTIC:
        assert act(actor, td).dtype == torch.float32
        assert torch.equal(act(actor, td), act(actor, td.float()))


@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_every_grad_mode_gives_the_same_action_without_a_graph(mode):
    actor, td = make_actor(), observe(BATCH)
    expected = act(actor, td, seed=0)
    with mode():
        action = act(actor, td, seed=0)
    assert not action.requires_grad
    assert torch.equal(action, expected)
