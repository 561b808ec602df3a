"""The losses of an ensemble SAC restated in float64 NumPy, and how a loss is compared with them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from loss_cases import ACTION_DIM, HIGH, LOW

ACT, MEMBERS, BATCH, GAMMA = ACTION_DIM, 4, 40, 0.875
LOW, HIGH = LOW.numpy(), HIGH.numpy()
EXACT = {"rel": 1e-8, "abs": 1e-10}


class Oracle:
    """The three losses from the parameters of a loss module, in NumPy alone."""

    def __init__(self, loss, data, variant):
        self.wsrl = variant == "wsrl"
        self.params = {name: array(param) for name, param in loss.named_parameters()}
        for name, param in loss.target_qvalue_network_params.flatten_keys(".").items():
            self.params[f"target.{name}"] = array(param)
        self.data = {
            "state": array(data["observation"]),
            "action": array(data["action"]),
            "reward": array(data["next", "reward"])[:, 0],
            "next_state": array(data["next", "observation"]),
            "terminated": array(data["next", "terminated"])[:, 0],
        }

    def alpha(self):
        raw = self.params["raw_alpha"]
        return np.log1p(np.exp(raw)) if self.wsrl else np.exp(raw)

    def critic(self, kind, member, state, action):
        prefix = "target.module" if kind == "target" else "qvalue_network_params.module"

        def param(layer, name):
            return self.params[f"{prefix}.layers.{layer}.{name}"][member]

        x = np.concatenate([state, action], -1)
        for layer in (0, 3):  # linear, LayerNorm, ReLU, twice
            x = x @ param(layer, "weight") + param(layer, "bias")
            centred = x - x.mean(-1, keepdims=True)
            x = centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-6)
            x = np.maximum(x * param(layer + 1, "weight") + param(layer + 1, "bias"), 0)
        return (x @ param(6, "weight") + param(6, "bias"))[:, 0]

    def policy(self, state, noise):
        """Actions in env units, and log-probabilities in units of [-1, 1]."""

        def param(layer, name):
            return self.params[f"actor_network.module.0.module.0.{layer}.{name}"]

        hidden = np.maximum(state @ param(0, "weight").T + param(0, "bias"), 0)
        out = hidden @ param(2, "weight").T + param(2, "bias")
        mean, std = out[:, :ACT], np.exp(out[:, ACT:])
        unit = np.tanh(mean + std * noise)
        density = np.exp(-(noise**2) / 2) / (std * np.sqrt(2 * np.pi)) / (1 - unit**2)
        return LOW + (unit + 1) / 2 * (HIGH - LOW), np.log(density).sum(-1)

    def qvalue_loss(self, noise, subset):
        data = self.data
        action, log_prob = self.policy(data["next_state"], noise)
        values = [self.critic("target", i, data["next_state"], action) for i in subset]
        value = np.minimum.reduce(values) - (0 if self.wsrl else self.alpha() * log_prob)
        target = data["reward"] + GAMMA * (1 - data["terminated"]) * value
        errors = [
            self.critic("online", i, data["state"], data["action"]) - target for i in range(MEMBERS)
        ]
        return np.mean(np.square(errors))

    def actor_loss(self, noise):
        state = self.data["state"]
        action, log_prob = self.policy(state, noise)
        values = [self.critic("online", i, state, action) for i in range(MEMBERS)]
        value = np.min(values, 0) if self.wsrl else np.mean(values, 0)
        return np.mean(self.alpha() * log_prob - value)

    def alpha_loss(self, noise):
        _, log_prob = self.policy(self.data["state"], noise)
        target = -1.0 * ACT if self.wsrl else -0.5 * ACT
        return self.alpha() * np.mean(-log_prob - target)

    def slope(self, function, direction):
        """Central difference of ``function()`` along a direction of the parameters."""
        step, ends = 1e-6, []
        for sign in (1, -1):
            before = dict(self.params)
            for name, change in direction.items():
                self.params[name] = before[name] + sign * step * change
            ends.append(function())
            self.params = before
        return (ends[0] - ends[1]) / (2 * step)


def array(tensor):
    return tensor.detach().numpy().astype(float)


def noise_of(seed):
    """The standard normal draws that a policy makes first after this seed."""
    torch.manual_seed(seed)
    return array(torch.randn(BATCH, ACT, dtype=torch.float64))


def seeded(function, *arguments, seed=5):
    torch.manual_seed(seed)
    return function(*arguments)


def assert_slope(loss, value, oracle, function, owns):
    """The gradient of ``value`` is the oracle's, and belongs to the parameters ``owns`` alone."""
    loss.zero_grad(set_to_none=True)
    value.backward()
    rng = np.random.default_rng(0)
    gradients = {n: p.grad for n, p in loss.named_parameters() if p.grad is not None}
    assert gradients.keys() == {n for n, _ in loss.named_parameters() if n.startswith(owns)}
    direction = {name: rng.normal(size=grad.shape) for name, grad in gradients.items()}
    slope = sum((array(grad) * direction[name]).sum() for name, grad in gradients.items())
    assert slope == pytest.approx(oracle.slope(function, direction), rel=1e-5)
