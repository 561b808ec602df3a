"""The reverse chains by themselves: against NumPy, by hand, and differentiated."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

import oracle
from torchrl_aca import NoiseSchedule
from torchrl_aca.chain import (
    StepRunner,
    check_levels,
    denoise,
    inference_levels,
    langevin,
    posterior_step,
    tiles,
)

T, N, BATCH, ACTION = 6, 3, 4, 2
BETAS = {"cosine": oracle.cosine_betas(T), "linear": oracle.linear_betas(T, 0.1, 0.5)}


def draws(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def schedule_of(kind):
    return NoiseSchedule(torch.tensor(BETAS[kind])), oracle.schedule(BETAS[kind])


def network(action, level):
    """Some noise that depends on action and level."""
    return torch.tanh(action * 0.7 - 0.1 * level)


def numpy_network(action, level):
    return np.tanh(action * 0.7 - 0.1 * level)


# --- one step -------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [True, False, 0.5])
@pytest.mark.parametrize("level", [1, 3, T])
@pytest.mark.parametrize("kind", BETAS)
def test_posterior_step_equals_the_oracle(kind, level, clip):
    schedule, constants = schedule_of(kind)
    noisy, predicted, noise = draws(3, 5, ACTION)
    actual = posterior_step(schedule, noisy, predicted, noise, torch.tensor(level), clip)
    arrays = noisy.numpy(), predicted.numpy(), noise.numpy()
    expected = oracle.denoising_step(*arrays, constants, level, clip)
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)


def test_each_action_may_be_at_a_level_of_its_own():
    schedule, _ = schedule_of("linear")
    noisy, predicted, noise = draws(3, T, ACTION)
    levels = torch.arange(1, T + 1)
    together = posterior_step(schedule, noisy, predicted, noise, levels)
    alone = [posterior_step(schedule, *row) for row in zip(noisy, predicted, noise, levels)]  # noqa: B905
    torch.testing.assert_close(together, torch.stack(alone))


def test_posterior_step_by_hand():
    # betas 1/2, 1/2. Level 2: alpha_bar 1/4, clean = 2 a - sqrt(3) eps = 1; both weights
    # sqrt(2)/3; sigma^2 = 1/3, and beta = 1/2.
    schedule, half = NoiseSchedule(torch.tensor([0.5, 0.5])), torch.full((1,), 0.5).double()
    arguments = schedule, half, 0 * half, 2 * half, torch.tensor(2)
    mean = 2**0.5 / 3 * 1.5
    assert posterior_step(*arguments).item() == pytest.approx(mean + 3**-0.5)
    assert posterior_step(*arguments, variance="beta").item() == pytest.approx(mean + 0.5**0.5)


@pytest.mark.parametrize("variance", ["posterior", "beta"])
def test_the_step_from_level_1_adds_no_noise(variance):
    schedule, _ = schedule_of("linear")
    noisy, predicted, noise = draws(3, 5, ACTION)
    both = [
        posterior_step(schedule, noisy, predicted, z, torch.tensor(1), variance=variance)
        for z in (noise, -noise)
    ]
    assert torch.equal(*both)


# --- denoising ------------------------------------------------------------------------------------


def numpy_chain(noise, constants, levels, clip=True, initial_scale=1.0, variance="posterior"):
    """DDIM with eta = 1, which is DDPM where all levels are visited (Song et al. 2021, eq. 12)."""
    x, path = initial_scale * noise[0], [initial_scale * noise[0]]
    signal = constants["alphas_cumprod"]
    for i, z in zip(reversed(range(len(levels))), noise[1:], strict=True):
        now, after = signal[levels[i] - 1], signal[levels[i - 1] - 1] if i else 1.0
        eps = numpy_network(x, levels[i])
        clean = oracle.predict_clean(x, eps, now)
        clean = np.clip(clean, -float(clip), float(clip)) if clip else clean
        eps = (x - np.sqrt(now) * clean) / np.sqrt(1 - now)
        posterior = (1 - after) / (1 - now) * (1 - now / after)
        added = posterior if variance == "posterior" else (1 - now / after) * (i > 0)
        x = np.sqrt(after) * clean + np.sqrt(1 - after - posterior) * eps + np.sqrt(added) * z
        path.append(x)
    return np.stack(path)


@pytest.mark.parametrize("kind", BETAS)
@pytest.mark.parametrize("num_steps", [2, 3, 5, T])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"clip": False},
        {"clip": 0.4},
        {"initial_scale": 0.5},
        {"variance": "beta"},
    ],
    ids=str,
)
def test_denoise_equals_numpy_on_all_levels_and_on_some(kind, num_steps, options):
    if options == {"clip": False} and kind == "cosine":
        options = {"clip": 30.0}  # the unclipped cosine chain leaves float64's exact range
    schedule, constants = schedule_of(kind)
    levels = inference_levels(T, num_steps)
    noise = draws(num_steps + 1, N, BATCH, ACTION)
    path = denoise(network, schedule.restrict(levels), noise, keep_path=True, **options)
    expected = numpy_chain(noise.numpy(), constants, levels, **options)
    np.testing.assert_allclose(path, expected, rtol=1e-5, atol=1e-6)  # DDIM's form cancels digits
    end = denoise(network, schedule.restrict(levels), noise, **options)
    assert torch.equal(end, path[-1])


def test_a_short_chain_visits_the_low_levels_by_a_quartic_law():
    assert inference_levels(20, 2) == [1, 20]
    assert inference_levels(82, 4) == [1, 2, 17, 82]  # 1 + 81 (k / 3)^4
    assert inference_levels(20, 8) == [1, 2, 3, 4, 5, 6, 11, 20]
    assert inference_levels(4, 4) == [1, 2, 3, 4]
    assert inference_levels(1, 1) == [1]


@pytest.mark.parametrize("num_levels", [2, 3, 10, 20, 57, 100])
def test_every_short_chain_rises_from_1_to_the_top_in_growing_strides(num_levels):
    for num_steps in range(2, num_levels + 1):
        levels = inference_levels(num_levels, num_steps)
        assert check_levels(levels, num_levels) == levels
        assert len(levels) == num_steps
        strides = np.diff(levels)
        assert (np.diff(strides) >= -1).all()  # rounding may shorten one by a level


@pytest.mark.parametrize(
    "levels", [[], [6], [1, 3], [2, 6], [1, 3, 3, 6], [1, 5, 3, 6], [1, 2.5, 6], [0, 1, 6], [1, 7]]
)
def test_levels_of_ones_own_must_rise_from_1_to_the_top(levels):
    with pytest.raises(ValueError, match=r"rising integers from 1 to 6, .* such as \[1, 2, 3, 6\]"):
        check_levels(levels, 6)


def test_a_predictor_of_no_noise_at_the_end_need_not_be_asked_there():
    schedule, asked = schedule_of("linear")[0], []

    def guidance(action, level):
        asked.append(level.item())
        return schedule.posterior_variance[level - 1].sqrt() * action

    noise = draws(T + 1, BATCH, ACTION)
    whole = denoise(guidance, schedule, noise)
    assert asked == [6, 5, 4, 3, 2, 1]
    asked.clear()
    torch.testing.assert_close(denoise(guidance, schedule, noise, predict_last=False), whole)
    assert asked == [6, 5, 4, 3, 2]


def test_draws_must_fit_the_number_of_steps():
    with pytest.raises(ValueError, match="argument"):
        denoise(network, schedule_of("cosine")[0], draws(T, BATCH, ACTION))


# --- Langevin -------------------------------------------------------------------------------------


def no_gradient(action, level):
    return torch.zeros_like(action)


@pytest.mark.parametrize("sizes", [0.04, [0.5, 0.25, 0.125]])
@pytest.mark.parametrize("clip", [False, True, 0.5])
def test_langevin_equals_numpy_for_a_constant_and_for_scheduled_steps(sizes, clip):
    noise, weight = draws(4, N, BATCH, ACTION), 3.0
    path = langevin(
        lambda a, level: -a.sin(), noise, sizes, guidance_weight=weight, clip=clip, keep_path=True
    )
    x = noise[0].numpy()
    for k, eps in enumerate(np.broadcast_to(sizes, 3)):
        x = x - eps / 2 * weight * np.sin(x) + np.sqrt(eps) * noise[k + 1].numpy()
        x = np.clip(x, -float(clip), float(clip)) if clip else x
        np.testing.assert_allclose(path[k + 1], x, rtol=1e-12, atol=1e-12)
    options = {"guidance_weight": weight, "clip": clip}
    assert torch.equal(langevin(lambda a, level: -a.sin(), noise, sizes, **options), path[-1])


def test_langevin_starts_from_scaled_noise():
    noise = draws(3, BATCH, ACTION)
    path = langevin(no_gradient, noise, 0.1, initial_scale=0.5, keep_path=True)
    assert torch.equal(path[0], noise[0] / 2)


def test_scheduled_steps_must_be_as_many_as_the_draws():
    with pytest.raises(RuntimeError, match="expand"):
        langevin(no_gradient, draws(4, BATCH, ACTION), [0.1, 0.2])


# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("tile_rows", [None, BATCH])
@pytest.mark.parametrize("sampler", ["denoise", "langevin"])
def test_gradients_flow_through_all_steps(sampler, tile_rows):
    """Against central differences, for a network's parameter that every step reads."""
    schedule, noise = schedule_of("linear")[0], draws(T + 1, N, BATCH, ACTION)

    def total(parameter):
        if sampler == "denoise":
            predict = lambda action, level: torch.tanh(parameter * action) * level / T  # noqa: E731
            end = denoise(predict, schedule, noise, clip=5.0, tile_rows=tile_rows)
        else:
            end = langevin(lambda a, _: torch.tanh(parameter * a), noise, 0.1, tile_rows=tile_rows)
        return (end * torch.arange(ACTION)).sum()

    parameter = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    total(parameter).backward()
    with torch.no_grad():
        slope = (total(parameter + 1e-6) - total(parameter - 1e-6)) / 2e-6
    assert abs(slope) > 0.01
    torch.testing.assert_close(parameter.grad, slope, rtol=1e-7, atol=0)


# --- how they run ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tile_rows", [1, BATCH, 2 * BATCH, 1000])
@pytest.mark.parametrize("keep_path", [True, False])
def test_tiles_change_no_result(tile_rows, keep_path):
    schedule, noise = schedule_of("linear")[0], draws(T + 1, N, BATCH, ACTION)
    whole = denoise(network, schedule, noise, keep_path=keep_path)
    tiled = denoise(network, schedule, noise, keep_path=keep_path, tile_rows=tile_rows)
    torch.testing.assert_close(tiled, whole, rtol=0, atol=1e-14)


def test_a_tile_holds_at_least_one_candidate_of_every_state():
    rows = draws(T + 1, 5, BATCH, ACTION)
    sizes = [
        [tile.shape[1] for tile in tiles(rows, tile_rows, dim=1)]
        for tile_rows in (1, BATCH, 3 * BATCH, 99, None)
    ]
    assert sizes == [[1] * 5, [1] * 5, [3, 2], [5], [5]]
    assert len(tiles(rows.to("meta"), 1, dim=1)) == 1


def test_a_runner_compiles_a_function_once_and_takes_no_code_along(monkeypatch):
    compiled = []

    def count(function, **kwargs):
        compiled.append(function)
        return function

    monkeypatch.setattr(torch, "compile", count)
    run, noise = StepRunner(compiled=True), draws(T + 1, BATCH, ACTION)
    schedule = schedule_of("linear")[0]
    expected = denoise(network, schedule, noise)
    for _ in range(2):
        assert torch.equal(denoise(network, schedule, noise, run=run), expected)
    assert len(compiled) == 1
    denoise(network, schedule, noise, run=copy.deepcopy(run))
    assert len(compiled) == 2
    denoise(network, schedule, noise, run=StepRunner(compiled=False))
    assert len(compiled) == 2
