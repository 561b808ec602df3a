from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

import oracle
from torchrl_aca import NoiseSchedule

T = 20
CONSTANTS = list(oracle.schedule(oracle.cosine_betas(T)))
PAIRS = {
    "cosine": (lambda n: NoiseSchedule.cosine(n), oracle.cosine_betas),
    "linear": (lambda n: NoiseSchedule.linear(n), lambda n: oracle.linear_betas(n, 1e-4, 0.02)),
    "scaled": (
        lambda n: NoiseSchedule.linear(n, 1e-4, 0.999, scale=0.8),
        lambda n: oracle.linear_betas(n, 1e-4, 0.999, 0.8),
    ),
    "vp": (lambda n: NoiseSchedule.vp(n), oracle.vp_betas),
}


# What is left of the signal, alpha_bar, at levels of the schedules that the rivals' codes have.
REMAINING = [
    (NoiseSchedule.linear(20, 1e-4, 0.999, 0.8), {1: 0.99992, 20: 5.27e-6}),
    (NoiseSchedule.linear(20, 1e-4, 0.999, 0.3), {1: 0.99997, 20: 0.0346}),
    (NoiseSchedule.linear(100, 1e-4, 0.999, 0.3), {100: 5.2e-8}),
    (NoiseSchedule.cosine(20), {1: 0.992007, 20: 6.06e-6}),
    (NoiseSchedule.vp(20), {20: 0.00641}),
]


@pytest.mark.parametrize(("schedule", "expected"), REMAINING)
def test_what_the_schedules_of_the_rivals_leave_of_the_signal(schedule, expected):
    for level, value in expected.items():
        assert schedule.alphas_cumprod[level - 1].item() == pytest.approx(value, rel=5e-3)


@pytest.fixture(params=PAIRS)
def pair(request):
    make, betas = PAIRS[request.param]
    return make(T), oracle.schedule(betas(T))


def test_constants_equal_the_oracle(pair):
    schedule, expected = pair
    assert schedule.num_steps == T
    for name, value in expected.items():
        actual = getattr(schedule, name)
        assert actual.dtype == torch.float64 and actual.shape == (T,)
        np.testing.assert_allclose(actual, value, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("schedule", "constant", "level", "expected"),
    [
        (NoiseSchedule.cosine(20), "betas", 1, 0.0079927),
        (NoiseSchedule.cosine(20), "betas", 20, 0.999),
        (NoiseSchedule.cosine(20), "alphas_cumprod", 1, 0.992007),
        (NoiseSchedule.cosine(20), "alphas_cumprod", 20, 6.06e-6),
        (NoiseSchedule.linear(20, 1e-4, 0.999, scale=0.8), "alphas_cumprod", 1, 0.99992),
        (NoiseSchedule.linear(20, 1e-4, 0.999, scale=0.8), "alphas_cumprod", 20, 5.27e-6),
        (NoiseSchedule.vp(20), "alphas_cumprod", 20, 0.00641),
    ],
)
def test_known_values(schedule, constant, level, expected):
    assert getattr(schedule, constant)[level - 1].item() == pytest.approx(expected, rel=2e-3)


def test_constants_by_hand():
    # betas 1/2, 1/2: alpha_bar 1/2, 1/4. Level 2: sigma^2 = 1/2 * 1/2 / (3/4) = 1/3 and both
    # weights 1/2 * sqrt(1/2) / (3/4) = sqrt(2) / 3.
    schedule = NoiseSchedule(torch.tensor([0.5, 0.5]))
    np.testing.assert_allclose(schedule.posterior_variance, [0, 1 / 3])
    np.testing.assert_allclose(schedule.posterior_mean_coef1, [1, 2**0.5 / 3])
    np.testing.assert_allclose(schedule.posterior_mean_coef2, [0, 2**0.5 / 3])


def test_last_step_has_neither_noise_nor_memory_of_the_noisy_action(pair):
    schedule, _ = pair
    assert schedule.posterior_variance[0] == 0
    assert schedule.posterior_mean_coef1[0].item() == pytest.approx(1, abs=1e-12)
    assert schedule.posterior_mean_coef2[0] == 0


@pytest.mark.parametrize("level", [1, 7, 20])
def test_add_noise_equals_the_oracle(pair, level):
    schedule, expected = pair
    action, noise = torch.randn(2, 5, 3, dtype=torch.float64)
    actual = schedule.add_noise(action, noise, torch.tensor(level))
    alpha_cumprod = expected["alphas_cumprod"][level - 1]
    np.testing.assert_allclose(
        actual, oracle.add_noise(action.numpy(), noise.numpy(), alpha_cumprod), atol=1e-12
    )


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
def test_add_noise_takes_one_level_per_action(batch):
    schedule = NoiseSchedule.cosine(T)
    action, noise = torch.randn(2, *batch, 3)
    level = torch.randint(1, T + 1, batch)
    together = schedule.add_noise(action, noise, level)
    assert together.shape == action.shape and together.dtype == action.dtype
    rows = zip(action.view(-1, 3), noise.view(-1, 3), level.view(-1), strict=True)
    alone = [schedule.add_noise(*row) for row in rows]
    torch.testing.assert_close(together.view(-1, 3), torch.stack(alone))


@pytest.mark.parametrize("levels", [[1, 20], [1, 2, 9, 20]])
def test_a_restricted_schedule_keeps_what_is_left_of_the_signal(pair, levels):
    schedule, expected = pair
    short = schedule.restrict(levels)
    assert short.num_steps == len(levels) and short.noise_levels.tolist() == levels
    kept = expected["alphas_cumprod"][np.array(levels) - 1]
    np.testing.assert_allclose(short.alphas_cumprod, kept, rtol=1e-10)
    np.testing.assert_allclose(short.alphas, kept / np.append(1, kept[:-1]), rtol=1e-10)


def test_restricted_to_all_its_levels_a_schedule_is_itself():
    schedule = NoiseSchedule.cosine(T)
    assert schedule.restrict(range(1, T + 1)) is schedule


@pytest.mark.parametrize(
    "cast", [lambda m: m.to(torch.float32), lambda m: m.float(), lambda m: m.half()]
)
def test_constants_keep_float64_when_the_module_is_cast(cast):
    schedule = NoiseSchedule.cosine(T)
    before = schedule.betas.clone()
    assert cast(schedule) is schedule
    assert schedule.betas.dtype == torch.float64
    assert torch.equal(schedule.betas, before)


def test_constants_follow_device_moves_in_float64():
    schedule = NoiseSchedule.cosine(T).to("meta", torch.float32)
    for name in CONSTANTS:
        constant = getattr(schedule, name)
        assert constant.device.type == "meta" and constant.dtype == torch.float64


def test_deepcopy_is_equal_and_apart():
    schedule = NoiseSchedule.cosine(T)
    copied = copy.deepcopy(schedule)
    for name in CONSTANTS:
        assert torch.equal(getattr(copied, name), getattr(schedule, name))
        assert getattr(copied, name).data_ptr() != getattr(schedule, name).data_ptr()


def test_state_dict_is_empty():
    assert not NoiseSchedule.cosine(T).state_dict()


@pytest.mark.parametrize("num_steps", [0, -3, 2.0, "20"])
@pytest.mark.parametrize("make", [NoiseSchedule.cosine, NoiseSchedule.linear, NoiseSchedule.vp])
def test_number_of_steps_must_be_a_positive_integer(make, num_steps):
    with pytest.raises(ValueError, match="num_steps must be a positive integer, got"):
        make(num_steps)


@pytest.mark.parametrize(
    "betas", [[], [0.0, 0.5], [0.5, 1.0], [-0.1], [float("nan")], [[0.1, 0.2]], 0.5]
)
def test_betas_must_be_a_vector_in_the_open_unit_interval(betas):
    with pytest.raises(ValueError, match=r"numbers in \(0, 1\), got shape"):
        NoiseSchedule(torch.tensor(betas))
