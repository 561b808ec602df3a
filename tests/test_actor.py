from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

import oracle
from torchrl_aca import (
    CriticGuidedDenoisingActor,
    NoiseLevelCritic,
    NoiseLevelCriticBase,
    NoiseSchedule,
)
from torchrl_aca.interop import to_official

OBS, ACTION, BATCH, CANDIDATES, T = 4, 3, 6, 5, 6
DETERMINISTIC = set_exploration_type(ExplorationType.DETERMINISTIC)


def make_critic(observation_dim=OBS, action_dim=ACTION, **kwargs):
    kwargs = {"num_cells": (7, 5), "embedding_dim": 8, "num_steps": T, **kwargs}
    critic = NoiseLevelCritic(observation_dim, action_dim, **kwargs)
    for name, parameter in critic.named_parameters():
        if name.endswith("bias"):
            nn.init.normal_(parameter, std=0.1)
    return critic


def make_actor(critic=None, schedule=None, **kwargs):
    kwargs = {"num_candidates": CANDIDATES, **kwargs}
    return CriticGuidedDenoisingActor(
        critic or make_critic(), schedule or NoiseSchedule.cosine(T), **kwargs
    )


def observe(*batch, **kwargs):
    return TensorDict(observation=torch.randn(*batch, OBS, **kwargs), batch_size=batch)


def act(actor, td, seed=None):
    if seed is not None:
        torch.manual_seed(seed)
    return actor(td.clone())["action"]


# --- the chain against the oracle -----------------------------------------------------------------


LINEAR = NoiseSchedule.linear(T, 1e-4, 0.999, scale=0.8), oracle.linear_betas(T, 1e-4, 0.999, 0.8)
COSINE = NoiseSchedule.cosine(T), oracle.cosine_betas(T)


@pytest.mark.parametrize("first_level", [0, 1])
@pytest.mark.parametrize("unit", [True, False])
@pytest.mark.parametrize(
    ("schedules", "clip"),
    [(COSINE, True), (LINEAR, True), (LINEAR, False), (COSINE, 2.0)],
    ids=["cosine", "linear", "unclipped", "wide"],
)
@pytest.mark.parametrize("weight", [0.0, 1.0, 50.0])
def test_denoise_equals_the_oracle(first_level, unit, schedules, clip, weight):
    schedule, betas = schedules
    critic = make_critic(first_level=first_level, dtype=torch.float64)
    actor = make_actor(
        critic, schedule, guidance_weight=weight, normalize_gradient=unit, clip_denoised=clip
    )
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    expected = oracle.denoise(
        to_official(critic), observation.numpy(), noise[0].numpy(), noise[1:].numpy(),
        oracle.schedule(betas), weight, first_level, unit, clip,
    )  # fmt: skip
    actual = actor.denoise(observation, noise)
    assert not actual.requires_grad
    np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("first_level", [0, 1])
@pytest.mark.parametrize("unit", [True, False])
@pytest.mark.parametrize("levels", [[1, 6], [1, 3, 6], [1, 2, 3, 5, 6], [1, 2, 3, 4, 5, 6]])
def test_a_chain_of_fewer_steps_equals_ddim_on_these_levels(levels, unit, first_level):
    critic = make_critic(first_level=first_level, dtype=torch.float64)
    actor = make_actor(critic, inference_levels=levels, normalize_gradient=unit)
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(len(levels) + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    expected = oracle.ddim_chain(
        to_official(critic), observation.numpy(), noise[0].numpy(), noise[1:].numpy(),
        oracle.schedule(oracle.cosine_betas(T)), levels, 50.0, first_level, unit,
    )  # fmt: skip
    assert actor.chain_schedule.noise_levels.tolist() == levels
    np.testing.assert_allclose(actor.denoise(observation, noise), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("steps", [0, 1, T + 1, -2, 2.5])
def test_number_of_inference_steps_must_fit_the_levels(steps):
    with pytest.raises(ValueError, match=f"from 2 to {T}, got {steps}"):
        make_actor(num_inference_steps=steps)


def test_levels_are_chosen_or_given():
    assert make_actor().inference_levels == [1, 2, 3, 4, 5, 6]
    assert make_actor(num_inference_steps=4).inference_levels == [1, 2, 3, 6]
    given = make_actor(inference_levels=(1, 4, 6))
    assert given.inference_levels == [1, 4, 6]
    assert given.num_inference_steps == 3
    with pytest.raises(ValueError, match="num_inference_steps or inference_levels, got both"):
        make_actor(num_inference_steps=3, inference_levels=[1, 4, 6])
    with pytest.raises(ValueError, match="rising integers from 1 to 6, both included"):
        make_actor(inference_levels=[1, 4])


def test_fewer_steps_ask_the_critic_less_often_and_act_in_every_way(monkeypatch):
    actor = make_actor(num_inference_steps=3)
    asked, gradient = [], actor.critic.action_gradient
    monkeypatch.setattr(
        actor.critic,
        "action_gradient",
        lambda *args: asked.append(args[2].item()) or gradient(*args),
    )
    td = observe(BATCH)
    assert act(actor, td).shape == (BATCH, ACTION)
    assert asked == [6, 2]  # not at level 1, where sigma is 0
    with DETERMINISTIC:
        torch.testing.assert_close(act(actor, td), act(actor, td), rtol=0, atol=0)


@pytest.mark.parametrize("first_level", [0, 1])
@pytest.mark.parametrize("unit", [True, False])
def test_langevin_sampler_equals_the_oracle(first_level, unit):
    critic = make_critic(first_level=first_level, dtype=torch.float64)
    actor = make_actor(
        critic, guidance_weight=20.0, normalize_gradient=unit,
        sampler="langevin", langevin_step_size=0.01,
    )  # fmt: skip
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    expected = oracle.langevin(
        to_official(critic), observation.numpy(), noise[0].numpy(), noise[1:].numpy(),
        20.0, 0.01, unit,
    )  # fmt: skip
    np.testing.assert_allclose(actor.denoise(observation, noise), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("sampler", ["denoising", "langevin"])
def test_trajectory_begins_at_the_noise_and_ends_at_the_candidates(sampler):
    actor = make_actor(sampler=sampler)
    observation, noise = torch.randn(2, 3, OBS), torch.randn(T + 1, CANDIDATES, 2, 3, ACTION)
    path = actor.trajectory(observation, noise)
    assert path.shape == noise.shape
    torch.testing.assert_close(path[0], noise[0], rtol=0, atol=0)
    torch.testing.assert_close(path[-1], actor.denoise(observation, noise), rtol=0, atol=0)


@pytest.mark.parametrize(
    "bad",
    [
        {"sampler": "gibbs"},
        {"deterministic_draws": "other"},
        {"langevin_step_size": 0.0},
        {"clip_denoised": -1.0},
    ],
)
def test_sampler_must_be_known_and_its_numbers_in_range(bad):
    (name,) = bad
    with pytest.raises(ValueError, match=f"Expected {name}"):
        make_actor(**bad)


def test_without_clipping_the_chain_is_definition_1_to_the_letter():
    """``a_{t-1} = (a_t + beta / sqrt(1 - alpha_bar) w sigma grad Q) / sqrt(alpha) + sigma z``."""
    weight, critic = 3.0, make_critic(dtype=torch.float64)
    schedule = LINEAR[0]
    actor = make_actor(
        critic, schedule, guidance_weight=weight, normalize_gradient=False, clip_denoised=False
    )
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    action = noise[0]
    for step, t in enumerate(range(T, 0, -1), start=1):
        beta, alpha = schedule.betas[t - 1], schedule.alphas[t - 1]
        sigma = schedule.posterior_variance[t - 1].sqrt()
        action.requires_grad_()
        level = torch.full((CANDIDATES, BATCH), t)
        value = critic(observation.expand(CANDIDATES, -1, -1), action, level)
        (gradient,) = torch.autograd.grad(value.sum(), action)
        drift = beta / (1 - schedule.alphas_cumprod[t - 1]).sqrt() * weight * sigma * gradient
        action = ((action + drift) / alpha.sqrt() + sigma * noise[step]).detach()
    torch.testing.assert_close(actor.denoise(observation, noise), action, rtol=0, atol=1e-10)


def test_the_last_step_is_neither_guided_nor_noisy():
    schedule = NoiseSchedule.linear(1, 0.5)
    actor = make_actor(make_critic(num_steps=1), schedule)
    noise = torch.randn(2, CANDIDATES, BATCH, ACTION)
    actual = actor.denoise(torch.randn(BATCH, OBS), noise)
    torch.testing.assert_close(actual, (noise[0] / 0.5**0.5).clamp(-1, 1))


def test_guidance_raises_the_value():
    critic = make_critic(num_cells=(16, 16))
    observation, noise = torch.randn(64, OBS), torch.randn(T + 1, 1, 64, ACTION)
    level = torch.zeros(64, dtype=torch.long)

    def mean_value(weight):
        candidates = make_actor(critic, guidance_weight=weight).denoise(observation, noise)
        return critic(observation, candidates[0], level).mean()

    assert mean_value(50.0) > mean_value(0.0)


def test_candidates_stay_in_the_box_when_the_clean_estimate_is_clipped():
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION)
    candidates = make_actor().denoise(torch.randn(BATCH, OBS), noise)
    assert candidates.abs().max() <= 1


# --- best of N ------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_critics", [1, 2, 3])
def test_select_equals_the_oracle(num_critics):
    critic = make_critic(dtype=torch.float64, num_critics=num_critics)
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    candidates = torch.randn(CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    actual = make_actor(critic).select(observation, candidates)
    expected = oracle.select_best(to_official(critic), observation.numpy(), candidates.numpy())
    np.testing.assert_array_equal(actual, expected)


def test_ties_go_to_the_first_candidate():
    critic = make_critic()
    nn.init.zeros_(critic.value.weight)
    candidates = torch.randn(CANDIDATES, BATCH, ACTION)
    best = make_actor(critic).select(torch.randn(BATCH, OBS), candidates)
    assert torch.equal(best, candidates[0])


def test_best_of_n_is_never_worse_than_the_first_candidate():
    critic = make_critic()
    observation, candidates = torch.randn(200, OBS), torch.randn(CANDIDATES, 200, ACTION)
    best = make_actor(critic).select(observation, candidates)
    level = torch.zeros(200, dtype=torch.long)
    lowest = [critic(observation, a, level).amin(-1) for a in (best, *candidates)]
    for values in lowest[1:]:
        assert (lowest[0] >= values).all()
    assert (lowest[0] > lowest[1]).any()


@pytest.mark.parametrize("batch", [(), (BATCH,), (2, 3)])
def test_the_action_is_the_best_candidate_of_the_fixed_draws(batch):
    actor, td = make_actor(), observe(*batch)
    draws = actor.fixed_noise[(slice(None), slice(None), *[None] * len(batch))]
    draws = draws.expand(T + 1, CANDIDATES, *batch, ACTION)
    candidates = actor.denoise(td["observation"], draws)
    assert candidates.shape == (CANDIDATES, *batch, ACTION)
    with DETERMINISTIC:
        action = act(actor, td)
    torch.testing.assert_close(action, actor.select(td["observation"], candidates))


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


# --- units and specs ------------------------------------------------------------------------------


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


# --- the module -----------------------------------------------------------------------------------


def test_the_actor_owns_no_network():
    critic = make_critic()
    actor = make_actor(critic)
    assert actor.critic is critic
    own = {name for name, _ in actor.named_parameters() if not name.startswith("critic.")}
    assert own == {"log_alpha"} and actor.log_alpha.shape == ()
    networks = {f"critic.{key}" for key in critic.state_dict()}
    assert set(actor.state_dict()) == {"log_alpha", "guidance_weight", *networks}


def test_the_guidance_weight_is_a_number_to_set_and_part_of_the_state():
    actor, held = make_actor(guidance_weight=0.3), observe(BATCH)
    buffer = actor.guidance_weight
    actor.guidance_weight = 7
    assert actor.guidance_weight is buffer and buffer == 7
    other = make_actor(actor.critic)
    other.load_state_dict(actor.state_dict())
    assert other.guidance_weight == 7
    assert torch.equal(act(other, held, seed=0), act(actor, held, seed=0))
    other.guidance_weight = 0.0
    assert not torch.equal(act(other, held, seed=0), act(actor, held, seed=0))
    with pytest.raises(ValueError, match="guidance_weight >= 0, got guidance_weight=-1"):
        actor.guidance_weight = -1


def test_casts_round_no_guidance_weight():
    actor = make_actor(guidance_weight=0.1).half().double()
    assert actor.guidance_weight.item() == 0.1


def test_casts_reach_all_but_the_schedule():
    actor = make_actor(spec=Bounded(-0.4, 0.4, shape=(ACTION,))).double()
    with DETERMINISTIC:
        assert act(actor, observe(BATCH)).dtype == torch.float64
    assert act(actor, observe(BATCH)).dtype == torch.float64
    assert {p.dtype for p in actor.parameters()} == {torch.float64}
    assert actor.float().schedule.betas.dtype == torch.float64


def test_moves_reach_everything():
    actor = make_actor(spec=Bounded(-0.4, 0.4, shape=(ACTION,))).to("meta")
    assert {t.device.type for t in [*actor.parameters(), *actor.buffers()]} == {"meta"}
    td = actor(observe(BATCH).to("meta"))
    assert td["action"].device.type == "meta"


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_copies_act_alike_and_share_nothing(duplicate):
    actor, td = make_actor(spec=Bounded(-0.4, 0.4, shape=(ACTION,))), observe(BATCH)
    copied = duplicate(actor)
    assert copied.critic is not actor.critic
    with DETERMINISTIC:
        assert torch.equal(act(copied, td), act(actor, td))
    assert torch.equal(act(copied, td, seed=0), act(actor, td, seed=0))
    nn.init.zeros_(copied.log_alpha)
    assert actor.log_alpha != 0


@pytest.mark.parametrize("activation", [nn.Mish, nn.ReLU, nn.GELU, nn.SiLU, nn.Tanh, nn.ELU])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_the_written_out_gradient_gives_the_generic_chain(
    activation, dtype, tolerance, monkeypatch
):
    critic = make_critic(activation=activation, dtype=dtype)
    actor = make_actor(critic, guidance_weight=1.0)
    observation = torch.randn(BATCH, OBS, dtype=dtype)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=dtype)
    fast = actor.denoise(observation, noise)
    generic = NoiseLevelCriticBase._action_gradient.__get__(critic)
    monkeypatch.setattr(critic, "_action_gradient", generic, raising=True)
    torch.testing.assert_close(fast, actor.denoise(observation, noise), rtol=0, atol=tolerance)


@pytest.mark.parametrize("tile_rows", [1, 2 * BATCH, 10_000])
def test_tiles_change_no_result(tile_rows):
    critic = make_critic(dtype=torch.float64)
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(T + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    whole, tiled = make_actor(critic), make_actor(critic, tile_rows=tile_rows)
    candidates = whole.denoise(observation, noise)
    torch.testing.assert_close(tiled.denoise(observation, noise), candidates, rtol=0, atol=1e-12)
    chosen = whole.select(observation, candidates)
    assert torch.equal(tiled.select(observation, candidates), chosen)


def test_compiles_without_a_graph_break():
    actor, td = make_actor(make_critic(num_steps=2), NoiseSchedule.cosine(2)), observe(BATCH)
    compiled = torch.compile(actor, fullgraph=True, backend="aot_eager")
    with DETERMINISTIC:
        torch.testing.assert_close(act(compiled, td), act(actor, td), rtol=0, atol=1e-5)
    assert act(compiled, td).shape == (BATCH, ACTION)  # with fresh draws it compiles as well


def test_one_compiled_step_serves_acting_targets_and_evaluation(monkeypatch):
    torch._dynamo.reset()
    compiled = []

    def counting_backend(graph, inputs):
        compiled.append(graph)
        return graph.forward

    torch_compile = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda f, **kwargs: torch_compile(f, backend=counting_backend, **kwargs)
    )
    actor = make_actor(compile_step=True, num_candidates=32, tile_rows=64)
    for num_states, num_candidates in [(5, 32), (50, 32), (10, 32), (16, 8), (5, 4)]:
        observation = torch.randn(num_states, OBS)
        actor.sample(observation, [num_states], num_candidates=num_candidates)
        with torch.no_grad(), DETERMINISTIC:
            act(actor, observe(num_states))
    # A step and a choice; tiles of one candidate have versions of their own: 50 states fill one.
    assert len(compiled) == 4


def test_a_compiled_step_acts_alike_at_every_level_and_stays_behind_in_copies(monkeypatch):
    compiled_steps = []

    def compile_without_codegen(function, **kwargs):
        compiled_steps.append(function)
        return torch_compile(function, backend="aot_eager", fullgraph=True, **kwargs)

    torch_compile = torch.compile
    monkeypatch.setattr(torch, "compile", compile_without_codegen)
    critic, td = make_critic(), observe(BATCH)
    plain, compiled = make_actor(critic), make_actor(critic, compile_step=True)
    for seed in (0, 1):
        expected = act(plain, td, seed)
        torch.testing.assert_close(act(compiled, td, seed), expected, rtol=0, atol=1e-5)
    assert len(compiled_steps) == 2  # the step, and the choice among the candidates
    for copied in (copy.deepcopy(compiled), pickle.loads(pickle.dumps(compiled))):
        torch.testing.assert_close(act(copied, td, seed=1), expected, rtol=0, atol=1e-5)
    assert len(compiled_steps) == 6


# --- collectors -----------------------------------------------------------------------------------


def collecting_actor():
    env = ContinuousActionVecMockEnv()
    (size,) = env.observation_spec["observation"].shape
    critic = make_critic(size, env.action_spec.shape[-1], num_steps=2)
    return make_actor(critic, NoiseSchedule.cosine(2), spec=env.action_spec)


def test_collects_in_process():
    actor = collecting_actor()
    collector = Collector(
        ContinuousActionVecMockEnv(),
        actor,
        frames_per_batch=8,
        total_frames=16,
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(8,)] * 2
    assert all(actor.spec["action"].shape == batch["action"].shape[1:] for batch in batches)
    assert not batches[0]["action"].requires_grad


@pytest.fixture
def collect_from_spawned_worker():
    """An endless iterator of batches that the actor collects in a process of its own."""
    collectors = []

    def start(actor, **kwargs):
        collector = MultiSyncCollector(
            [ContinuousActionVecMockEnv], actor, frames_per_batch=8,
            auto_register_policy_transforms=False, **kwargs,
        )  # fmt: skip
        collectors.append(collector)
        return collector, iter(collector)

    yield start
    for collector in collectors:
        collector.shutdown()


def test_a_spawned_worker_acts_as_the_learner_before_and_after_an_update(
    collect_from_spawned_worker,
):
    actor = collecting_actor()
    kind = ExplorationType.DETERMINISTIC
    collector, batches = collect_from_spawned_worker(actor, exploration_type=kind)

    def learners_action(batch):
        return actor.sample(batch["observation"], batch.shape, deterministic=True)

    first = next(batches).clone()
    # The worker need not round as this process does (3e-5 has been seen).
    torch.testing.assert_close(first["action"], learners_action(first), rtol=0, atol=1e-3)
    with torch.no_grad():
        actor.critic.value.weight.neg_()
    collector.update_policy_weights_()
    next(batches)  # may have begun before the update
    later = next(batches).clone()
    torch.testing.assert_close(later["action"], learners_action(later), rtol=0, atol=1e-3)
    assert not torch.allclose(first["action"], learners_action(first), atol=1e-2)


def test_what_is_set_reaches_a_spawned_worker(collect_from_spawned_worker):
    actor = collecting_actor()
    collector, batches = collect_from_spawned_worker(actor)
    assert not actor.spec["action"].is_in(next(batches)["action"])  # loud exploration noise
    with torch.no_grad():
        actor.log_alpha.fill_(-30.0)
    collector.update_policy_weights_()
    next(batches)  # may have begun before the update
    assert actor.spec["action"].is_in(next(batches)["action"])


def test_the_guidance_weight_reaches_a_spawned_worker(collect_from_spawned_worker):
    actor = collecting_actor()
    kind = ExplorationType.DETERMINISTIC
    collector, batches = collect_from_spawned_worker(actor, exploration_type=kind)
    next(batches)
    actor.guidance_weight = 0.0
    collector.update_policy_weights_()
    next(batches)  # may have begun before the update
    batch = next(batches).clone()
    unguided = actor.sample(batch["observation"], batch.shape, deterministic=True)
    torch.testing.assert_close(batch["action"], unguided, rtol=0, atol=1e-3)


def test_one_candidate_is_taken_without_a_look_at_its_value(monkeypatch):
    actor = make_actor(num_candidates=1)
    candidates = torch.rand(1, 1, actor.action_dim)
    calls = []
    monkeypatch.setattr(actor.critic, "evaluate", lambda *args: calls.append(args))
    assert torch.equal(actor.select(torch.zeros(1, OBS), candidates), candidates[0])
    assert not calls
