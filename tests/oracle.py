"""The equations of ACA restated in float64 NumPy, sharing no code with the package.

Every function is pure. B = batch, N = candidates, A = action dimension, T = denoising steps.
``level`` is the index that a critic sees: 0 is the clean action, ``first_level`` the least noisy
one (1 in the paper; 0 in the official code, which shares it with the clean action). Row ``k - 1``
of a schedule belongs to noise level k = 1..T. A critic is a dict ``{"linear.w": (in, out),
"linear.b": (out,), "linear_1.w": ...}``: two layers of time MLP, hidden layers, output layer.
"""

from __future__ import annotations

import numpy as np


def cosine_betas(T):
    signal = np.cos((np.arange(T + 1) / T + 0.008) / 1.008 * np.pi / 2) ** 2
    return np.minimum(1 - signal[1:] / signal[:-1], 0.999)


def linear_betas(T, start=1e-4, end=0.999, scale=1.0):
    return scale * np.linspace(start, end, T)


def vp_betas(T, beta_min=0.1, beta_max=10.0):
    k = np.arange(1, T + 1)
    return 1 - np.exp(-beta_min / T - 0.5 * (beta_max - beta_min) * (2 * k - 1) / T**2)


def schedule(betas):
    cumprod = np.cumprod(1 - betas)
    previous = np.concatenate([[1.0], cumprod[:-1]])
    return {
        "betas": betas,
        "alphas": 1 - betas,
        "alphas_cumprod": cumprod,
        "alphas_cumprod_prev": previous,
        "posterior_variance": betas * (1 - previous) / (1 - cumprod),
        "posterior_mean_coef1": betas * np.sqrt(previous) / (1 - cumprod),  # of the clean action
        "posterior_mean_coef2": (1 - previous) * np.sqrt(1 - betas) / (1 - cumprod),  # of the noisy
    }


def sinusoidal(t, dim):
    frequencies = 10000.0 ** (-np.arange(dim // 2) / (dim // 2))
    angles = np.asarray(t, dtype=float)[..., None] * frequencies
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1) / np.sqrt(dim)


def mish(x):
    return x * np.tanh(np.logaddexp(0, x))


def mish_derivative(x):
    gate = np.tanh(np.logaddexp(0, x))
    return gate + x * (1 - gate**2) * (1 + np.tanh(x / 2)) / 2


def forward(params, obs, action, level):
    """Q of shape (*batch,) and, per layer, its input and the slope of its activation."""
    action = np.asarray(action, dtype=float)
    obs = np.broadcast_to(obs, action.shape[:-1] + np.shape(obs)[-1:])
    x = sinusoidal(np.broadcast_to(level, action.shape[:-1]), len(params["linear.w"]))
    names, tape = ["linear"] + [f"linear_{i}" for i in range(1, len(params) // 2)], {}
    for name in names:
        if name == "linear_2":  # the time features join observation and action
            x = np.concatenate([obs, action, x], axis=-1)
        pre = x @ params[f"{name}.w"] + params[f"{name}.b"]
        is_linear = name in ("linear_1", names[-1])
        tape[name] = (x, 1.0 if is_linear else mish_derivative(pre))
        x = pre if is_linear else mish(pre)
    return x[..., 0], tape


def backward(params, tape, upstream):
    """Gradients of ``sum(upstream * Q)``: by every parameter, and by (observation, action)."""
    grads, delta = {}, np.asarray(upstream, dtype=float)[..., None]
    for name, (x, slope) in reversed(tape.items()):
        delta = delta * slope
        rows = delta.reshape(-1, delta.shape[-1])
        grads[f"{name}.w"], grads[f"{name}.b"] = x.reshape(-1, x.shape[-1]).T @ rows, rows.sum(0)
        delta = delta @ params[f"{name}.w"].T
        if name == "linear_2":
            by_input, delta = np.split(delta, [-len(params["linear_1.b"])], axis=-1)
    return grads, by_input


def critic(params, obs, action, level):
    return forward(params, obs, action, level)[0]


def critic_action_gradient(params, obs, action, level):
    values, tape = forward(params, obs, action, level)
    return backward(params, tape, np.ones_like(values))[1][..., np.shape(obs)[-1] :]


def critic_parameter_gradients(params, obs, action, level, upstream):
    return backward(params, forward(params, obs, action, level)[1], upstream)[0]


def add_noise(action, noise, alpha_cumprod):
    return np.sqrt(alpha_cumprod) * action + np.sqrt(1 - alpha_cumprod) * noise


def predict_clean(noisy, noise, alpha_cumprod):
    return (noisy - np.sqrt(1 - alpha_cumprod) * noise) / np.sqrt(alpha_cumprod)


def normalize(gradient, eps=1e-8):
    return gradient / (np.sqrt((gradient**2).sum(-1, keepdims=True)) + eps)


def guided_noise(gradient, variance, weight):
    """Definition 1: ``-w * sigma_t * grad Q``; the official code bounds sigma below by 1e-10."""
    return -weight * np.sqrt(variance) * gradient


def denoising_step(noisy, guided, noise, sched, k, clip=True):
    """a_k -> a_(k-1) through the clean estimate; without ``clip`` this is Definition 1 itself."""
    row = {key: values[k - 1] for key, values in sched.items()}
    clean = predict_clean(noisy, guided, row["alphas_cumprod"])
    clean = np.clip(clean, -float(clip), float(clip)) if clip else clean
    mean = row["posterior_mean_coef1"] * clean + row["posterior_mean_coef2"] * noisy
    return mean + np.sqrt(row["posterior_variance"]) * noise  # the variance is 0 at k = 1


def denoise(
    critics, obs, initial_noise, step_noise, sched, weight=50.0, first_level=1, unit=True, clip=True
):
    """Candidates (N, B, A) from initial noise (N, B, A) and step noise (T, N, B, A), a_T first."""
    x = np.asarray(initial_noise, dtype=float)
    for k, noise in zip(range(len(step_noise), 0, -1), step_noise, strict=True):
        gradient = sum(critic_action_gradient(q, obs, x, k - 1 + first_level) for q in critics)
        gradient = normalize(gradient) if unit else gradient
        guided = guided_noise(gradient, sched["posterior_variance"][k - 1], weight)
        x = denoising_step(x, guided, noise, sched, k, clip)
    return x


def ddim_chain(
    critics, obs, initial_noise, step_noise, sched, levels, weight=50.0, first_level=1, unit=True
):
    """As ``denoise`` over ``levels`` (rising) alone, in the form of DDIM's equation 12, eta = 1."""
    x, cumprod = np.asarray(initial_noise, dtype=float), sched["alphas_cumprod"]
    for i, noise in zip(range(len(levels) - 1, -1, -1), step_noise, strict=True):
        now, after = cumprod[levels[i] - 1], cumprod[levels[i - 1] - 1] if i else 1.0
        gradient = sum(
            critic_action_gradient(q, obs, x, levels[i] - 1 + first_level) for q in critics
        )
        gradient = normalize(gradient) if unit else gradient
        guided = guided_noise(gradient, sched["posterior_variance"][levels[i] - 1], weight)
        clean = np.clip(predict_clean(x, guided, now), -1, 1)
        direction = (x - np.sqrt(now) * clean) / np.sqrt(1 - now)
        variance = (1 - after) / (1 - now) * (1 - now / after)
        rest = np.sqrt(np.maximum(1 - after - variance, 0))
        x = np.sqrt(after) * clean + rest * direction + np.sqrt(variance) * noise
    return x


def langevin(critics, obs, initial_noise, step_noise, weight=50.0, step_size=1e-3, unit=True):
    """As ``denoise``, by Langevin steps along the gradient at the clean level 0."""
    x = np.asarray(initial_noise, dtype=float)
    for noise in step_noise:
        gradient = sum(critic_action_gradient(q, obs, x, 0) for q in critics)
        gradient = normalize(gradient) if unit else gradient
        x = x + 0.5 * step_size * weight * gradient + np.sqrt(step_size) * noise
    return x


def select_best(critics, obs, candidates):
    """Per state, the (first) candidate with the largest minimum over the critics at level 0."""
    values = np.min([critic(params, obs, candidates, 0) for params in critics], axis=0)
    return np.stack([candidates[np.argmax(values[:, b]), b] for b in range(values.shape[1])])


def explore(action, noise, log_alpha, noise_scale=0.1):
    return action + noise_scale * np.exp(log_alpha) * noise


def td_target(targets, reward, terminated, next_obs, next_action, gamma=0.99, reward_scale=0.2):
    next_values = np.min([critic(p, next_obs, next_action, 0) for p in targets], axis=0)
    return reward_scale * reward + gamma * (1 - terminated) * next_values


def squared_errors(critics, obs, action, level, targets):
    """Per critic the loss mean((Q - target)^2), and per critic its parameter gradients."""
    errors = [critic(q, obs, action, level) - y for q, y in zip(critics, targets, strict=True)]
    grads = [
        critic_parameter_gradients(q, obs, action, level, 2 * error / len(error))
        for q, error in zip(critics, errors, strict=True)
    ]
    return [np.mean(error**2) for error in errors], grads


def td_loss(critics, obs, action, target):
    return squared_errors(critics, obs, action, 0, [target] * len(critics))


def noise_level_loss(critics, obs, action, noise, level, sched, first_level=1, target="mean"):
    """``target``: each critic's own clean value ("self", paper) or their "mean" (official)."""
    alpha_cumprod = sched["alphas_cumprod"][np.asarray(level) - first_level][:, None]
    clean = [critic(q, obs, action, 0) for q in critics]
    targets = {"mean": [np.mean(clean, axis=0)] * len(critics), "self": clean}[target]
    return squared_errors(critics, obs, add_noise(action, noise, alpha_cumprod), level, targets)


def surrogate_entropy(log_alpha, action_dim, noise_scale=0.1):
    return action_dim / 2 * np.log(2 * np.pi * np.e * (noise_scale * np.exp(log_alpha)) ** 2)


def alpha_gradient(log_alpha, action_dim, target_entropy):
    """Derivative of ``log_alpha * stop_gradient(entropy - target_entropy)`` by log_alpha."""
    return surrogate_entropy(log_alpha, action_dim) - target_entropy


def proposition_1_closed_form(a_t, alpha_cumprod, m, s, c):
    """E[Q(a_0) | a_t] for a_0 ~ N(m, s^2) and Q(a_0) = -(a_0 - c)^2, per coordinate."""
    noisy_variance = alpha_cumprod * s**2 + 1 - alpha_cumprod
    mean = m + np.sqrt(alpha_cumprod) * s**2 / noisy_variance * (a_t - np.sqrt(alpha_cumprod) * m)
    return -((mean - c) ** 2) - s**2 * (1 - alpha_cumprod) / noisy_variance


def learning_rate(step, start=1e-3, end=1e-4, begin=25_000, length=50_000):
    """Of the critics' optimiser after ``step`` of its own steps: constant, linear, constant."""
    return end + (start - end) * (1 - np.clip(step - begin, 0, length) / length)


def adam_step(param, grad, m, v, step, lr, beta1=0.9, beta2=0.999, eps=1e-8):
    """New (param, m, v); ``step`` counts from 1."""
    m = beta1 * m + (1 - beta1) * grad
    v = beta2 * v + (1 - beta2) * grad**2
    m_hat, v_hat = m / (1 - beta1**step), v / (1 - beta2**step)
    return param - lr * m_hat / (np.sqrt(v_hat) + eps), m, v


def polyak(target, source, tau=0.005):
    return {key: (1 - tau) * target[key] + tau * source[key] for key in target}


def initial_state(critics, targets, log_alpha):
    """``moments`` and ``alpha`` = (log_alpha, m, v) hold what Adam carries on."""
    moments, alpha = [{k: (0.0, 0.0) for k in params} for params in critics], (log_alpha, 0.0, 0.0)
    return {"critics": critics, "targets": targets, "moments": moments, "step": 0, "alpha": alpha}


def critic_step(state, grads):
    """One Adam step of every critic; both objectives share the moments and the step count."""
    lr, step = learning_rate(state["step"]), state["step"] + 1
    critics, moments = [], []
    for q, moment, grad in zip(state["critics"], state["moments"], grads, strict=True):
        new = {k: adam_step(q[k], grad[k], *moment[k], step, lr) for k in q}
        critics.append({k: value[0] for k, value in new.items()})
        moments.append({k: value[1:] for k, value in new.items()})
    return {**state, "critics": critics, "moments": moments, "step": step}


def alpha_step(alpha, step, action_dim, target, lr=3e-2):
    return adam_step(alpha[0], alpha_gradient(alpha[0], action_dim, target), *alpha[1:], step, lr)


def official_update(state, batch, draws, i, sched, weight=50.0, first_level=0, entropy_scale=0.9):
    """Update i of the official code: the new state, and the losses of each critic by objective."""
    critics, alpha, d = state["critics"], state["alpha"], batch["action"].shape[-1]
    obs, action, next_obs = batch["obs"], batch["action"], batch["next_obs"]
    # 1. TD step: a'_0 comes from the online critics with the current alpha, and is not clipped.
    noises = draws["initial_noise"], draws["step_noise"]
    candidates = denoise(critics, next_obs, *noises, sched, weight, first_level)
    best = select_best(critics, next_obs, candidates)
    best = explore(best, draws["exploration_noise"], alpha[0])
    target = td_target(state["targets"], batch["reward"], batch["done"], next_obs, best)
    td, grads = td_loss(critics, obs, action, target)
    state = critic_step(state, grads)
    # 2. Noise-level step with the critics that the TD step left; reported, not taken, at odd i.
    critics, noise, level = state["critics"], draws["noise"], draws["t"]
    noisy, grads = noise_level_loss(critics, obs, action, noise, level, sched, first_level)
    state = critic_step(state, grads) if i % 2 == 0 else state
    # 3. At every update the targets follow the critics that both steps left.
    targets = [polyak(t, q) for t, q in zip(state["targets"], state["critics"], strict=True)]
    if i % 250 == 0:  # 4. alpha, which uses no data
        alpha = alpha_step(alpha, i // 250 + 1, d, -entropy_scale * d)
    return {**state, "targets": targets, "alpha": alpha}, {"td": td, "noise_level": noisy}
