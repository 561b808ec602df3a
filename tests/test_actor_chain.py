"""The chains and the choice among their candidates, against a float64 oracle."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

import oracle
from actor_cases import (
    ACTION,
    BATCH,
    CANDIDATES,
    DETERMINISTIC,
    OBS,
    T,
    act,
    make_actor,
    make_critic,
    observe,
)
from torchrl_aca import NoiseSchedule
from torchrl_aca.interop import to_official

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
    assert make_actor(inference_levels=torch.tensor([1, 3, 6])).inference_levels == [1, 3, 6]
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


def test_one_candidate_is_taken_without_a_look_at_its_value(monkeypatch):
    actor = make_actor(num_candidates=1)
    candidates = torch.rand(1, 1, actor.action_dim)
    calls = []
    monkeypatch.setattr(actor.critic, "evaluate", lambda *args: calls.append(args))
    assert torch.equal(actor.select(torch.zeros(1, OBS), candidates), candidates[0])
    assert not calls
