"""The diffusion-policy baselines restated in float64 NumPy, sharing no code with the package.

A layer is a pair (weight of shape (in, out), bias of shape (out,)); a network is a list of them.
B = batch, A = action dimension, K = proposals. Noise levels are 1..T; a network sees 0..T-1.
"""

from __future__ import annotations

import numpy as np

from oracle import mish, mish_derivative, sinusoidal

# --- networks -------------------------------------------------------------------------------------


def array(tensor):
    return tensor.detach().double().numpy()


def policy_layers(network):
    """The layers of a policy's network, and those of its level features."""
    layers = [(array(layer.weight).T, array(layer.bias)) for layer in network.layers]
    if network.embedding != "mlp":
        return layers, []
    pair = network.level_in, network.level_out
    return layers, [(array(layer.weight).T, array(layer.bias)) for layer in pair]


def critic_layers(params, member):
    """The layers of one of the critics, from a stack of parameters."""
    stacks = [params["layers", str(i)] for i in range(len(params["layers"].keys()))]
    return [(array(s["weight"])[member], array(s["bias"])[member, 0]) for s in stacks]


def mlp(layers, x):
    """Outputs, and per layer its input and the slope of its activation; the last has none."""
    tape = []
    for i, (weight, bias) in enumerate(layers):
        pre, last = x @ weight + bias, i == len(layers) - 1
        tape.append((x, np.ones_like(pre) if last else mish_derivative(pre)))
        x = pre if last else mish(pre)
    return x, tape


def mlp_backward(layers, tape, upstream):
    """Gradients of ``sum(upstream * outputs)`` by (weight, bias) of each layer, and by inputs."""
    grads = []
    for (weight, _), (x, slope) in zip(reversed(layers), reversed(tape), strict=True):
        upstream = upstream * slope
        grads.append((x.T @ upstream, upstream.sum(0)))
        upstream = upstream @ weight.T
    return grads[::-1], upstream


def policy(network, observation, action, level):
    """The policy's output ``(B, A)``, and what its backward pass needs."""
    layers, level_layers = policy_layers(network)
    parts, level_tape = [observation, action], None
    if network.embedding != "none":
        features = sinusoidal(np.asarray(level) - 1, network.embedding_dim)
        features = np.broadcast_to(features, (len(action), features.shape[-1]))
        if level_layers:
            features, level_tape = mlp(level_layers, features)
        parts.append(features)
    output, tape = mlp(layers, np.concatenate(parts, -1))
    return output, (layers, level_layers, tape, level_tape)


def policy_gradients(saved, upstream):
    """Gradients of ``sum(upstream * output)`` by parameter name, in torch's shapes."""
    layers, level_layers, tape, level_tape = saved
    grads, by_input = mlp_backward(layers, tape, upstream)
    named = {f"layers.{i}": pair for i, pair in enumerate(grads)}
    if level_layers:
        level_grads, _ = mlp_backward(
            level_layers, level_tape, by_input[:, -level_layers[-1][1].size :]
        )
        named.update(zip(("level_in", "level_out"), level_grads, strict=True))
    weights = {f"{name}.weight": weight.T for name, (weight, _) in named.items()}
    return weights | {f"{name}.bias": bias for name, (_, bias) in named.items()}


def critic(layers, observation, action):
    return mlp(layers, np.concatenate([observation, action], -1))[0][:, 0]


def critic_action_gradient(layers, observation, action):
    output, tape = mlp(layers, np.concatenate([observation, action], -1))
    by_input = mlp_backward(layers, tape, np.ones_like(output))[1]
    return by_input[:, observation.shape[-1] :]


# --- losses ---------------------------------------------------------------------------------------


def td_target(critics, reward, terminated, next_state, next_action, gamma, scale):
    values = np.min([critic(layers, next_state, next_action) for layers in critics], axis=0)
    return scale * reward + gamma * (1 - terminated) * values


def regression(output, target, weight=1.0):
    """``mean_b w_b mean_j (output - target)^2`` and its gradient by the output."""
    rows, size = output.shape
    weight = np.broadcast_to(weight, rows)[:, None]
    error = output - target
    return (weight * error**2).mean(), 2 * weight * error / (rows * size)


def score_target(critics, observation, action, scale, which):
    values = np.stack([critic(layers, observation, action) for layers in critics])
    gradients = [critic_action_gradient(layers, observation, action) for layers in critics]
    if which == "mean":
        return scale * np.mean(gradients, axis=0)
    return scale * np.where((values[0] <= values[1])[:, None], *gradients)


def average_noise(critics, observation, noisy, draws, alpha_cumprod, beta):
    """``sum_k w_k e_k``: clean actions of all draws, their smaller values, softmax, average."""
    clean = (noisy - np.sqrt(1 - alpha_cumprod) * draws) / np.sqrt(alpha_cumprod)
    clean = np.clip(clean, -1, 1)
    values = np.stack(
        [np.min([critic(layers, observation, a) for layers in critics], axis=0) for a in clean]
    )
    weights = np.exp(beta * (values - values.max(0)))
    weights /= weights.sum(0)
    return (weights[..., None] * draws).sum(0), weights


# --- chains ---------------------------------------------------------------------------------------


def ddpm_chain(predict, noise, sched, scale):
    """The sampler of the code base in which ACA's paper compares: the clean estimate is clipped."""
    x = scale * noise[0]
    for k in range(len(noise) - 1, 0, -1):
        A, previous = sched["alphas_cumprod"][k - 1], sched["alphas_cumprod_prev"][k - 1]
        beta = sched["betas"][k - 1]
        clean = x / np.sqrt(A) - np.sqrt(1 / A - 1) * predict(x, k)
        clean = np.clip(clean, -1, 1)
        x = (
            beta * np.sqrt(previous) / (1 - A) * clean
            + (1 - previous) * np.sqrt(1 - beta) / (1 - A) * x
        )
        x = x + np.sqrt(beta * (1 - previous) / (1 - A)) * noise[len(noise) - k]
    return x


def authors_qsm_chain(predict, noise, sched):
    """QSM's own: mean from the noise itself, standard deviation sqrt(beta), the action clipped."""
    x = noise[0]
    for k in range(len(noise) - 1, 0, -1):
        A, beta = sched["alphas_cumprod"][k - 1], sched["betas"][k - 1]
        x = (x - beta / np.sqrt(1 - A) * predict(x, k)) / np.sqrt(1 - beta)
        x = np.clip(x + (k > 1) * np.sqrt(beta) * noise[len(noise) - k], -1, 1)
    return x


def annealed_langevin_chain(score, noise):
    """Step sizes 1 - k / T, the action clipped after each; the last step is noisy as well."""
    x, steps = noise[0], len(noise) - 1
    for k in range(steps):
        size = 1 - k / steps
        x = np.clip(x + size / 2 * score(x) + np.sqrt(size) * noise[k + 1], -1, 1)
    return x
