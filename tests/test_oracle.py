"""Checks of the oracle that need no recording: finite differences, constants, closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import oracle

OBS, ACTION, BATCH, T = 4, 3, 6, 20


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def random_critic(rng, num_cells=(7, 5), embedding_dim=8):
    widths = [OBS + ACTION + embedding_dim, *num_cells, 1]
    shapes = [(embedding_dim, 2 * embedding_dim), (2 * embedding_dim, embedding_dim)]
    shapes += zip(widths, widths[1:], strict=False)
    params = {}
    for i, (fan_in, fan_out) in enumerate(shapes):
        name = f"linear_{i}" if i else "linear"
        params[f"{name}.w"] = rng.normal(size=(fan_in, fan_out)) / np.sqrt(fan_in)
        params[f"{name}.b"] = 0.1 * rng.normal(size=fan_out)
    return params


def numerical_gradient(function, x, eps=1e-6):
    """Central differences of a scalar function by every entry of x."""
    gradient = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[index] = eps
        gradient[index] = (function(x + step) - function(x - step)) / (2 * eps)
    return gradient


def perturbed(params, key):
    return lambda value: {**params, key: value}


def test_mish_derivative():
    x = np.linspace(-30, 30, 61)
    expected = (oracle.mish(x + 1e-6) - oracle.mish(x - 1e-6)) / 2e-6
    np.testing.assert_allclose(oracle.mish_derivative(x), expected, atol=1e-8)


def test_sinusoidal_has_sines_first_and_is_scaled():
    expected = [np.sin(3), np.sin(0.03), np.cos(3), np.cos(0.03)]
    np.testing.assert_allclose(oracle.sinusoidal(3, 4), np.array(expected) / 2)


def test_gradients_of_the_critic(rng):
    params = random_critic(rng)
    obs, action = rng.normal(size=(BATCH, OBS)), rng.normal(size=(BATCH, ACTION))
    level, upstream = rng.integers(0, T + 1, BATCH), rng.normal(size=BATCH)
    by_action = numerical_gradient(lambda a: oracle.critic(params, obs, a, level).sum(), action)
    actual = oracle.critic_action_gradient(params, obs, action, level)
    np.testing.assert_allclose(actual, by_action, atol=1e-8)
    grads = oracle.critic_parameter_gradients(params, obs, action, level, upstream)
    assert grads.keys() == params.keys()
    for key, value in params.items():
        new = perturbed(params, key)
        expected = numerical_gradient(
            lambda w, new=new: upstream @ oracle.critic(new(w), obs, action, level), value
        )
        np.testing.assert_allclose(grads[key], expected, atol=1e-8)


def test_critic_broadcasts_observation_and_level_over_candidates(rng):
    params = random_critic(rng)
    obs, action = rng.normal(size=(BATCH, OBS)), rng.normal(size=(2, BATCH, ACTION))
    gradient = oracle.critic_action_gradient(params, obs, action, 5)
    for n in range(2):
        one = oracle.critic_action_gradient(params, obs, action[n], np.full(BATCH, 5))
        np.testing.assert_allclose(gradient[n], one)


@pytest.mark.parametrize("target", ["mean", "self"])
def test_losses_and_their_gradients_hold_the_target_fixed(rng, target):
    critics = [random_critic(rng), random_critic(rng)]
    obs, action = rng.normal(size=(BATCH, OBS)), rng.normal(size=(BATCH, ACTION))
    noise, level = rng.normal(size=(BATCH, ACTION)), rng.integers(1, T + 1, BATCH)
    sched = oracle.schedule(oracle.cosine_betas(T))
    losses, grads = oracle.noise_level_loss(critics, obs, action, noise, level, sched, 1, target)
    clean = [oracle.critic(params, obs, action, 0) for params in critics]
    fixed = [(clean[0] + clean[1]) / 2] * 2 if target == "mean" else clean
    noisy = np.stack(
        [
            np.sqrt(cumprod) * a + np.sqrt(1 - cumprod) * e
            for a, e, cumprod in zip(action, noise, sched["alphas_cumprod"][level - 1], strict=True)
        ]
    )
    for c, params in enumerate(critics):

        def loss(params, c=c):
            return np.mean((oracle.critic(params, obs, noisy, level) - fixed[c]) ** 2)

        np.testing.assert_allclose(losses[c], loss(params))
        for key in ("linear.w", "linear_2.w", "linear_4.b"):
            new = perturbed(params, key)
            expected = numerical_gradient(lambda w, new=new, f=loss: f(new(w)), params[key])
            np.testing.assert_allclose(grads[c][key], expected, atol=1e-8)


def test_td_target_by_hand(rng):
    critics = [random_critic(rng), random_critic(rng)]
    obs, action = rng.normal(size=(2, OBS)), rng.normal(size=(2, ACTION))
    low = min(oracle.critic(params, obs, action, 0)[0] for params in critics)
    target = oracle.td_target(critics, np.array([1.0, 2.0]), np.array([0.0, 1.0]), obs, action)
    np.testing.assert_allclose(target, [0.2 + 0.99 * low, 0.4])


@pytest.mark.parametrize(
    ("betas", "expected"),
    [
        (oracle.cosine_betas(20), {"b_0": 0.0079927, "A_0": 0.992007}),
        (oracle.cosine_betas(20), {"b_-1": 0.999, "A_-1": 6.06e-6}),
        (oracle.linear_betas(20, scale=0.8), {"A_0": 0.99992, "A_-1": 5.27e-6}),
        (oracle.linear_betas(20, scale=0.3), {"A_0": 0.99997, "A_-1": 0.0346}),
        (oracle.linear_betas(100, scale=0.3), {"A_-1": 5.21e-8}),
        (oracle.vp_betas(20), {"A_-1": 0.00641}),
    ],
)
def test_schedule_constants(betas, expected):
    sched = oracle.schedule(betas)
    short = {"b": sched["betas"], "A": sched["alphas_cumprod"]}
    for name, value in expected.items():
        letter, index = name.split("_")
        rtol = 2e-3 if value < 0.1 else 1e-6  # the digits that are stated
        np.testing.assert_allclose(short[letter][int(index)], value, rtol=rtol)
    assert sched["posterior_variance"][0] == sched["posterior_mean_coef2"][0] == 0
    assert sched["posterior_mean_coef1"][0] == pytest.approx(1)


def test_step_through_the_clean_estimate_is_definition_1(rng):
    sched = oracle.schedule(oracle.cosine_betas(T))
    noisy, guided, noise = rng.normal(size=(3, BATCH, ACTION))
    for k in range(1, T + 1):
        b, cumprod = sched["betas"][k - 1], sched["alphas_cumprod"][k - 1]
        before = sched["alphas_cumprod"][k - 2] if k > 1 else 1.0
        sigma = np.sqrt((1 - before) / (1 - cumprod) * b)
        literal = (noisy - b / np.sqrt(1 - cumprod) * guided) / np.sqrt(1 - b) + sigma * noise
        step = oracle.denoising_step(noisy, guided, noise, sched, k, clip=False)
        np.testing.assert_allclose(step, literal, atol=1e-10)


def test_forward_noise_and_clean_estimate_are_inverse(rng):
    action, noise = rng.normal(size=(2, BATCH, ACTION))
    noisy = oracle.add_noise(action, noise, 0.3)
    np.testing.assert_allclose(oracle.predict_clean(noisy, noise, 0.3), action)


def test_last_step_ignores_guidance_and_noise(rng):
    sched = oracle.schedule(oracle.cosine_betas(T))
    noisy, gradient, noise = rng.normal(size=(3, BATCH, ACTION))
    guided = oracle.guided_noise(gradient, sched["posterior_variance"][0], 50.0)
    step = oracle.denoising_step(noisy, guided, noise, sched, 1)
    np.testing.assert_allclose(step, np.clip(noisy / np.sqrt(sched["alphas_cumprod"][0]), -1, 1))


def test_gradient_normalisation():
    np.testing.assert_allclose(oracle.normalize(np.array([[3.0, 4.0]])), [[0.6, 0.8]], rtol=1e-8)
    assert not oracle.normalize(np.zeros((1, 2))).any()


def test_select_best_takes_the_first_largest_minimum(rng):
    critics = [random_critic(rng), random_critic(rng)]
    obs, candidates = rng.normal(size=(2, OBS)), rng.normal(size=(5, 2, ACTION))
    best = oracle.select_best(critics, obs, candidates)
    for b in range(2):
        values = [
            min(oracle.critic(params, obs[b], candidate[b], 0) for params in critics)
            for candidate in candidates
        ]
        np.testing.assert_array_equal(best[b], candidates[values.index(max(values)), b])


def test_alpha_follows_its_open_loop_schedule():
    d, target = 17, -0.9 * 17
    alpha, std = (np.log(5.0), 0.0, 0.0), {}
    for i in range(0, 100_001, 250):
        std[i] = 0.1 * np.exp(alpha[0])  # in force during update i
        alpha = oracle.alpha_step(alpha, i // 250 + 1, d, target)
    recorded = {5_000: 0.279, 10_000: 0.171, 20_000: 0.104, 25_000: 0.098}
    assert {i: round(std[i], 3) for i in recorded} == recorded
    fixed_point = np.exp(-0.9) / np.sqrt(2 * np.pi * np.e)
    assert std[100_000] == pytest.approx(fixed_point, rel=1e-4)
    assert oracle.alpha_gradient(np.log(fixed_point / 0.1), d, target) == pytest.approx(0, abs=1e-9)


def test_learning_rate_decay():
    rates = [oracle.learning_rate(step) for step in (0, 25_000, 50_000, 75_000, 10**6)]
    np.testing.assert_allclose(rates, [1e-3, 1e-3, 5.5e-4, 1e-4, 1e-4])


def test_first_adam_step_is_the_sign_of_the_gradient():
    param, m, v = oracle.adam_step(1.0, -3.0, 0.0, 0.0, 1, 0.01)
    np.testing.assert_allclose([param, m, v], [1.01, -0.3, 0.009])


def test_polyak():
    assert oracle.polyak({"w": 1.0}, {"w": 3.0}, tau=0.25) == {"w": 1.5}


def test_parameter_count_of_humanoid():
    observation, action, embedding, cells = 376, 17, 16, 256
    time_mlp = (16 * 32 + 32) + (32 * 16 + 16)
    first = (observation + action + embedding) * cells + cells
    assert 2 * (time_mlp + first + 2 * (cells * cells + cells) + cells + 1) == 475_746


@pytest.mark.parametrize("cumprod", [0.99, 0.5, 0.01])
@pytest.mark.parametrize("a_t", [-1.0, 0.2, 1.5])
def test_proposition_1_by_quadrature(cumprod, a_t):
    m, s, c = 0.3, 0.5, -0.4
    a_0 = np.linspace(m - 12 * s, m + 12 * s, 200_001)
    prior = np.exp(-((a_0 - m) ** 2) / (2 * s**2))
    likelihood = np.exp(-((a_t - np.sqrt(cumprod) * a_0) ** 2) / (2 * (1 - cumprod)))
    posterior = prior * likelihood / np.sum(prior * likelihood)
    expected = np.sum(posterior * -((a_0 - c) ** 2))
    actual = oracle.proposition_1_closed_form(a_t, cumprod, m, s, c)
    assert actual == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("cumprod", [0.9, 0.3])
def test_proposition_1_is_the_minimiser_of_the_noise_level_loss(rng, cumprod):
    """The minimiser is a quadratic of a_t, so that least squares on one must find it."""
    m, s, c, n = 0.3, 0.5, -0.4, 400_000
    a_0 = rng.normal(m, s, n)
    a_t = oracle.add_noise(a_0, rng.normal(size=n), cumprod)
    coefficients = np.polyfit(a_t, -((a_0 - c) ** 2), 2)
    grid = np.linspace(-1, 1, 9)
    expected = oracle.proposition_1_closed_form(grid, cumprod, m, s, c)
    np.testing.assert_allclose(np.polyval(coefficients, grid), expected, atol=0.01)
