"""NC-LQL's parts: the noise of its levels, its chain, and what its critic learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.objectives import SoftUpdate

import oracle
from loss_cases import make_data, set_constant
from torchrl_aca import ACALoss, CriticGuidedDenoisingActor, NoiseLevelCritic, NoiseSchedule
from torchrl_aca.interop import to_official
from torchrl_aca.langevin_actor import AnnealedLangevinActor
from torchrl_aca.schedule import VarianceExplodingSchedule

OBS, ACTION, BATCH, CANDIDATES, T, M = 3, 2, 6, 4, 3, 2


def make_actor(dtype=torch.float64, **kwargs):
    critic = NoiseLevelCritic(OBS, ACTION, num_steps=T, num_cells=(7, 5), dtype=dtype)
    schedule = VarianceExplodingSchedule(T, 0.01, 0.3)
    return AnnealedLangevinActor(critic, schedule, steps_per_level=M, step_size=1e-3, **kwargs)


def test_the_noise_of_the_levels_grows_geometrically():
    schedule = VarianceExplodingSchedule(9)
    assert schedule.num_steps == 9 and schedule.sigmas.shape == (10,)
    expected = 1e-3 * 100 ** (np.arange(10) / 9)  # 0.001, 0.00167, .. 0.1
    np.testing.assert_allclose(schedule.sigmas, expected, rtol=1e-12)
    action, noise = torch.randn(2, 5, 2)
    level = torch.tensor([1, 2, 9, 9, 5])
    noisy = schedule.add_noise(action, noise, level)
    np.testing.assert_allclose(
        noisy, action + noise * expected[level.numpy(), None], rtol=1e-5, atol=1e-6
    )
    assert schedule.to(torch.float32).sigmas.dtype == torch.float64


@pytest.mark.parametrize("sigmas", [(0.1, 0.1), (0.0, 0.1), (0.2, 0.1)])
def test_noise_that_does_not_grow_is_refused(sigmas):
    with pytest.raises(ValueError, match="0 < sigma_min < sigma_max"):
        VarianceExplodingSchedule(3, *sigmas)


def test_each_chain_takes_the_noise_that_it_is_made_for():
    critic = NoiseLevelCritic(OBS, ACTION, num_steps=T)
    with pytest.raises(ValueError, match="expected a NoiseSchedule, got a VarianceExploding"):
        CriticGuidedDenoisingActor(critic, VarianceExplodingSchedule(T))
    with pytest.raises(ValueError, match="expected a VarianceExplodingSchedule, got a NoiseSched"):
        AnnealedLangevinActor(critic, NoiseSchedule.cosine(T))


@pytest.mark.parametrize("unit", [True, False])
def test_the_chain_equals_its_restatement(unit):
    actor = make_actor(guidance_weight=20.0, normalize_gradient=unit, num_candidates=CANDIDATES)
    observation = torch.randn(BATCH, OBS, dtype=torch.float64)
    noise = torch.randn(M * (T + 1) + 1, CANDIDATES, BATCH, ACTION, dtype=torch.float64)
    critics = to_official(actor.critic)
    states = np.broadcast_to(observation, (CANDIDATES, BATCH, OBS))
    uniform = torch.distributions.Normal(0, 1).cdf(noise[0])
    action, row = 2 * uniform.numpy() - 1, 0
    for level in (3, 2, 1, 0):
        eps = 1e-3 * 30 ** (2 * level / 3)  # sigma_3 is 30 times sigma_0
        for _ in range(M):
            row += 1
            gradient = sum(
                oracle.critic_action_gradient(critic, states, action, level) for critic in critics
            )
            gradient = oracle.normalize(gradient) if unit else gradient
            action = action + eps / 2 * 20 * gradient + np.sqrt(eps) * noise[row].numpy()
            action = np.clip(action, -1, 1)
    actual = actor.denoise(observation, noise)
    np.testing.assert_allclose(actual, action, rtol=1e-9, atol=1e-9)


def test_it_explores_by_its_own_noise_alone_and_stays_in_the_box():
    actor = make_actor(torch.float32, guidance_weight=1.0)
    actions = actor.sample(torch.zeros(500, OBS), [500])
    assert actions.abs().max() <= 1 and actions.std(0).min() > 0
    fixed = actor.sample(torch.zeros(2, OBS), [2], deterministic=True)
    assert torch.equal(fixed[0], fixed[1])


def test_fewer_levels_are_refused():
    with pytest.raises(ValueError, match="visits every level"):
        make_actor(num_inference_steps=2)


def test_its_noisy_levels_learn_the_mean_of_the_target_critics():
    actor = make_actor(torch.float32)
    loss = ACALoss(actor, noise_level_target="target", reduction="none")
    SoftUpdate(loss, tau=0.5)
    set_constant(loss, online=0.0, target=3.0)
    loss.target_qvalue_network_params["value", "bias"].data[1] = 5.0
    error = loss.noise_level_loss(make_data(4))["loss_noise_level"]
    # Both online critics regress on the targets' mean, 4.
    torch.testing.assert_close(error, torch.full((4,), 32.0))


@pytest.mark.parametrize("keyword", ["sampler", "langevin_step_size"])
def test_keywords_of_other_chains_are_refused(keyword):
    with pytest.raises(ValueError, match=f"have no .'{keyword}'.: expected steps_per_level"):
        AnnealedLangevinActor(
            NoiseLevelCritic(3, 2, num_steps=9), VarianceExplodingSchedule(9), **{keyword: None}
        )


def test_the_sizes_of_steps_keep_float64_through_casts():
    actor = make_actor()
    sizes = actor.step_sizes.clone()
    assert torch.equal(actor.float().double().step_sizes, sizes)
