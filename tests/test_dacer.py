"""DACER against NumPy: critics that tell a Gaussian, the chain that is climbed, the temperature."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.objectives import SoftUpdate

import oracle
import oracle_diffusion as numpy_of
from loss_cases import (
    ACTION_DIM,
    NUM_STEPS,
    make_dacer,
    make_dacer_critic,
    make_diffusion_policy,
    make_rlpd_data,
)
from test_diffusion_losses import BATCH, EXACT, GAMMA, array, critics_of, make_data, unit
from torchrl_aca import NoiseSchedule
from torchrl_aca.baselines import DACERLoss, DiffusionPolicy, DIPOLoss, NoiseNetwork, TwinCritic
from torchrl_aca.baselines.dacer import distributional_error, running_scale
from torchrl_aca.baselines.gmm import fit_gmm, gmm_entropy

# --- the critics' error ---------------------------------------------------------------------------


def oracle_slopes(q, std, y, y_z, scale, eps=0.1):
    """Per number: the derivative of the critics' error by the mean and by the deviation."""
    by_q, by_std = np.empty_like(q), np.empty_like(q)
    for row, i in np.ndindex(q.shape):
        m, s = scale[i], std[row, i]
        bounded = q[row, i] + np.clip(y_z[row, i] - q[row, i], -3 * m, 3 * m)
        by_q[row, i] = -(m**2 + eps) * (y[row, 0] - q[row, i]) / (s**2 + eps)
        by_std[row, i] = -(m**2 + eps) * ((q[row, i] - bounded) ** 2 - s**2) / (s**3 + eps)
    return by_q, by_std


def numbers(seed=0, rows=9):
    rng = np.random.default_rng(seed)
    q, y_z = rng.normal(size=(2, rows, 2))
    std, y = np.exp(rng.normal(size=(rows, 2))), rng.normal(size=(rows, 1))
    return q, std, y, 4 * y_z, np.array([0.3, 1.2])


def test_errors_and_their_slopes_are_the_oracles():
    q, std, y, y_z, scale = numbers()
    tensors = [torch.from_numpy(value) for value in (q, std, y, y_z, scale)]
    outputs = [tensor.requires_grad_() for tensor in tensors[:2]]
    error = distributional_error(*tensors)
    by_q, by_std = oracle_slopes(q, std, y, y_z, scale)
    np.testing.assert_allclose(error.detach(), q * by_q + std * by_std, rtol=1e-12)
    mean_slope, std_slope = torch.autograd.grad(error.sum(), outputs)
    np.testing.assert_allclose(mean_slope, by_q, rtol=1e-12)
    np.testing.assert_allclose(std_slope, by_std, rtol=1e-12)


def test_the_draw_is_bounded_by_three_deviations_of_the_batch():
    q, std, y, y_z, scale = map(torch.from_numpy, numbers())
    far = q + 100 * (y_z - q).sign() * scale
    bounded = distributional_error(q, std, y, far, scale)
    edge = distributional_error(q, std, y, q + 3 * (y_z - q).sign() * scale, scale)
    torch.testing.assert_close(bounded, edge)
    assert not torch.allclose(distributional_error(q, std, y, y_z, scale), bounded)


def test_the_fixed_point_is_the_targets_mean_and_deviation():
    """Where mean and deviation are the target's, the slopes vanish in the mean over draws."""
    torch.manual_seed(0)
    y_z = 2.0 + 0.5 * torch.randn(200_000, 1, dtype=torch.float64)
    mean = torch.full((200_000, 1), 2.0, dtype=torch.float64, requires_grad=True)
    std = torch.full((200_000, 1), 0.5, dtype=torch.float64, requires_grad=True)
    target, scale = torch.full_like(mean, 2.0).detach(), torch.tensor([10.0]).double()
    error = distributional_error(mean, std, target, y_z, scale).mean()
    slopes = torch.autograd.grad(error, (mean, std))
    weight = 100.1 / (0.125 + 0.1)
    assert slopes[0].abs().max() == 0
    assert abs(slopes[1].sum().item()) < 5 * weight * 0.25 * 2**0.5 / 200_000**0.5


def test_the_running_scale_begins_with_the_first_batch_and_then_moves_slowly():
    std = torch.rand(4, 3, 2, dtype=torch.float64) + 0.1
    first = running_scale(torch.zeros(2).double(), std, 0.25)
    torch.testing.assert_close(first, std.mean((0, 1)))
    second = running_scale(first, 3 * std, 0.25)
    torch.testing.assert_close(second, 1.5 * first)


def oracle_gaussian(layers, state, action):
    """Mean, deviation, its slope by the raw output, and the tape of the backward pass."""
    output, tape = numpy_of.mlp(layers, np.concatenate([state, action], -1))
    raw = output[:, 1]
    return output[:, 0], np.logaddexp(0, raw), 1 / (1 + np.exp(-raw)), tape


def oracle_targets(loss, data, draw):
    """``y`` and ``y_z``, row by row: both of the target critic with the smaller mean."""
    state, action = array(data["next", "observation"]), array(unit(data["next_action"]))
    gaussians = [
        oracle_gaussian(layers, state, action)[:2]
        for layers in critics_of(loss, "target_qvalue_network_params")
    ]
    target, target_draw = [], []
    for row in range(BATCH):
        means = [mean[row] for mean, _ in gaussians]
        j = int(means[1] < means[0])
        deviation = gaussians[j][1][row] * np.clip(draw[row, j], -3, 3)
        discount = GAMMA * (1 - array(data["next", "terminated"])[row, 0])
        reward = loss.reward_scale * array(data["next", "reward"])[row, 0]
        target.append(reward + discount * means[j])
        target_draw.append(reward + discount * (means[j] + deviation))
    return np.array(target), np.array(target_draw)


@pytest.mark.parametrize("calls", [1, 2])
def test_qvalue_loss_and_gradients_equal_the_oracle(calls):
    """The second call bounds the draws by a running scale that remembers the first."""
    loss = make_dacer(reward_scale=0.5, scale_tau=0.25)
    data = make_data(loss)
    state, action = array(data["observation"]), array(unit(data["action"]))
    gaussians = [oracle_gaussian(layers, state, action) for layers in critics_of(loss)]
    latest = np.array([std.mean() for _, std, _, _ in gaussians])
    scale = latest
    if calls == 2:
        loss.scale.copy_(torch.from_numpy(3 * latest))
        scale = 0.25 * latest + 0.75 * 3 * latest
    torch.manual_seed(4)
    draw = torch.randn(BATCH, 2, dtype=torch.float64)
    target, target_draw = oracle_targets(loss, data, array(draw))
    torch.manual_seed(4)
    out = loss.qvalue_loss(data)
    out["loss_qvalue"].backward()
    mean, std = (np.stack([g[i] for g in gaussians], -1) for i in (0, 1))
    both = np.repeat(target_draw[:, None], 2, -1)
    by_mean, by_std = oracle_slopes(mean, std, target[:, None], both, scale)
    value = (mean * by_mean + std * by_std).sum(-1).mean()
    np.testing.assert_allclose(out["loss_qvalue"].item(), value, **EXACT)
    for member, layers in enumerate(critics_of(loss)):
        _, _, slope, tape = gaussians[member]
        upstream = np.stack([by_mean[:, member], by_std[:, member] * slope], -1) / BATCH
        grads, _ = numpy_of.mlp_backward(layers, tape, upstream)
        for layer, (weight, bias) in zip(loss.qvalue_network.layers, grads, strict=True):
            np.testing.assert_allclose(array(layer.weight.grad)[member], weight, **EXACT)
            np.testing.assert_allclose(array(layer.bias.grad)[member, 0], bias, **EXACT)
    np.testing.assert_allclose(array(data["td_error"]), np.abs(mean - target[:, None]).max(-1))
    np.testing.assert_allclose(out["value_std"].item(), std.mean())
    assert all(p.grad is None for p in loss.policy_network.parameters())
    loss.step_scale()
    np.testing.assert_allclose(array(loss.scale), scale)


def test_the_scale_moves_when_it_is_told_to_and_not_before():
    loss, data = make_dacer(), make_rlpd_data(BATCH)
    for _ in range(2):
        loss.qvalue_loss(data)
        assert (loss.scale == 0).all()
    loss.step_scale()
    assert (loss.scale > 0).all()
    torch.testing.assert_close(loss.scale, loss.next_scale)


def test_truncated_rows_bootstrap_and_terminated_rows_do_not():
    loss, data = make_dacer(), make_rlpd_data(3)
    data["next", "done"] = torch.tensor([[False], [True], [True]])
    data["next", "terminated"] = torch.tensor([[False], [False], [True]])
    data["next", "observation"][2] = float("nan")
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        for param in params.values(True, True):
            param.data.zero_()
    loss.target_qvalue_network_params["layers", "2", "bias"].data[..., 0] = 4.0
    out = loss.qvalue_loss(data)
    bootstrap = torch.tensor([1.0, 1.0, 0.0]).double() * GAMMA * 4
    expected = loss.reward_scale * data["next", "reward"][:, 0] + bootstrap
    torch.testing.assert_close(data["td_error"], expected.abs())
    assert out["loss_qvalue"].isfinite()


# --- the policy -----------------------------------------------------------------------------------


def oracle_actions(loss, state, draws, log_alpha):
    """Actions of the chain with their noise, clipped, for draws of shape ``(T + 2, B, A)``."""
    network = loss.policy_network

    def predict(action, level):
        return numpy_of.policy(network, state, action, level)[0]

    schedule = oracle.schedule(oracle.cosine_betas(NUM_STEPS))
    action = numpy_of.ddpm_chain(predict, draws[:-1], schedule, loss.actor_network.initial_scale)
    return np.clip(action + 0.1 * np.exp(log_alpha) * draws[-1], -1, 1)


def oracle_actor_loss(loss, state, draws, log_alpha):
    actions = oracle_actions(loss, state, draws, log_alpha)
    means = [oracle_gaussian(layers, state, actions)[0] for layers in critics_of(loss)]
    return -np.min(means, axis=0).mean()


def test_actor_loss_and_its_gradient_through_the_whole_chain_equal_the_oracle():
    """Gradients by finite differences of the chain in NumPy, of some entries of each parameter."""
    loss = make_dacer()
    for name, param in loss.policy_network.named_parameters():
        if name.startswith("layers.2"):
            param.data.mul_(0.3)  # so that not every estimate is at the bounds
    loss.log_alpha.data.fill_(np.log(0.5))
    data = make_rlpd_data(BATCH)
    state = array(data["observation"])
    torch.manual_seed(6)
    draws = array(loss.actor_network.draws(BATCH))[:, 0]
    torch.manual_seed(6)
    value = loss.actor_loss(data)["loss_actor"]
    value.backward()
    log_alpha = np.log(0.5)
    expected = oracle_actor_loss(loss, state, draws, log_alpha)
    np.testing.assert_allclose(value.item(), expected, **EXACT)
    inside = np.abs(oracle_actions(loss, state, draws, log_alpha)) < 1
    assert 0.2 < inside.mean() < 1
    rng = np.random.default_rng(0)
    for name, parameter in loss.policy_network.named_parameters():
        flat, gradient = parameter.data.view(-1), array(parameter.grad).reshape(-1)
        for index in rng.choice(len(flat), size=min(4, len(flat)), replace=False):
            ends, start = [], flat[index].item()
            for shift in (1e-6, -1e-6):
                flat[index] = start + shift
                ends.append(oracle_actor_loss(loss, state, draws, log_alpha))
            flat[index] = start
            slope = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(gradient[index], slope, rtol=1e-5, atol=1e-8, err_msg=name)
    assert all(p.grad is None for p in loss.qvalue_network.parameters())
    assert loss.log_alpha.grad is None


def test_an_action_at_the_bounds_has_no_gradient():
    loss, data = make_dacer(), make_rlpd_data(BATCH)
    loss.log_alpha.data.fill_(-30.0)
    last = loss.policy_network.layers[-1]
    last.weight.data.zero_()
    last.bias.data.fill_(-50.0)  # noise so negative that every clean estimate is above the box
    loss.actor_loss(data)["loss_actor"].backward()
    assert all(not p.grad.any() for p in loss.policy_network.parameters())


# --- the temperature ------------------------------------------------------------------------------


def test_the_entropy_is_that_of_mixtures_fitted_to_the_policys_actions():
    loss, data = make_dacer(num_entropy_samples=25, num_components=2), make_rlpd_data(BATCH)
    state = array(data["observation"])
    torch.manual_seed(1)
    draws = array(loss.actor_network.draws(BATCH, 25))
    alpha = loss.log_alpha.item()
    actions = np.stack([oracle_actions(loss, state, draws[:, k], alpha) for k in range(25)], 1)
    expected = gmm_entropy(fit_gmm(torch.from_numpy(actions), 2))
    torch.manual_seed(1)
    actual = loss.entropy(data)
    assert actual.shape == (BATCH,) and not actual.requires_grad
    torch.testing.assert_close(actual, expected)


def test_alpha_moves_by_the_entropys_distance_from_its_target(monkeypatch):
    loss, data = make_dacer(), make_rlpd_data(2, 3)
    assert loss.target_entropy.item() == pytest.approx(-0.9 * ACTION_DIM)
    entropy = torch.tensor([-1.0, -2.0, -3.0, 0.0, 1.0, -1.0]).double()
    monkeypatch.setattr(loss, "entropy", lambda tensordict: entropy)
    out = loss.alpha_loss(data)
    (slope,) = torch.autograd.grad(out["loss_alpha"], loss.log_alpha)
    assert slope.item() == pytest.approx(-1.0 + 0.9 * ACTION_DIM)
    assert out["loss_alpha"].item() == pytest.approx(np.log(2) * slope.item())
    assert out["entropy"].item() == -1 and out["exploration_std"].item() == pytest.approx(0.2)


def test_more_noise_more_entropy():
    loss, data = make_dacer(num_entropy_samples=100), make_rlpd_data(BATCH)
    entropies = []
    for log_alpha in (-3.0, 0.0, 1.0):
        loss.log_alpha.data.fill_(log_alpha)
        torch.manual_seed(0)
        entropies.append(loss.entropy(data).mean().item())
    assert entropies == sorted(entropies)


# --- corners --------------------------------------------------------------------------------------


def test_one_action_dimension_and_equal_critics():
    policy = DiffusionPolicy(
        NoiseNetwork(3, 1, num_steps=NUM_STEPS, num_cells=(6,)),
        NoiseSchedule.vp(NUM_STEPS),
        critic=TwinCritic(3, 1, num_outputs=2, num_cells=(6,)),
        exploration_noise=0.1,
        clip_action=True,
    )
    for param in policy.critic.parameters():
        param.data[1] = param.data[0]
    loss = DACERLoss(policy)
    SoftUpdate(loss, tau=0.1)
    data = make_rlpd_data(BATCH)
    data = data.apply(lambda x: x.float() if x.is_floating_point() else x)
    data["action"] = data["action"][:, :1].clamp(-1, 1)
    assert all(value.isfinite() for value in loss(data).values())


def test_the_best_of_several_candidates_is_that_of_the_largest_mean():
    policy = make_diffusion_policy(critic=make_dacer_critic(), num_candidates=4)
    data = make_rlpd_data(BATCH)
    draws = policy.draws(BATCH)
    candidates = policy.denoise(data["observation"], draws[:-1])
    features = policy.critic.encode(data["observation"])
    means = policy.critic.evaluate(features, candidates)[..., 0]  # (N, B, E)
    assert torch.equal(policy.values(data["observation"], candidates), means)
    with torch.no_grad():
        torch.manual_seed(3)
        action = policy.sample(data["observation"])
        torch.manual_seed(3)
        chosen = policy.denoise(data["observation"], policy.draws(BATCH)[:-1])
        best = policy.values(data["observation"], chosen).amin(-1).argmax(0)
    assert torch.equal(action, policy.to_env(chosen[best, torch.arange(BATCH)]))
    assert DACERLoss(policy, num_target_candidates=4)(data)["loss_qvalue"].isfinite()


def test_an_update_reads_no_value_and_stays_on_its_device():
    """As a CUDA graph asks: on the device `meta`, which has no values, both would raise."""
    loss = DACERLoss(make_dacer().actor_network.to("meta"))
    data = make_rlpd_data(BATCH).to("meta")
    for name in ("qvalue", "actor", "alpha"):
        getattr(loss, f"{name}_loss")(data)[f"loss_{name}"].backward()
    loss.step_scale()
    assert {param.grad.device.type for param in loss.parameters()} == {"meta"}


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_components": 0}, "num_components >= 1"),
        ({"num_entropy_samples": 2}, "num_entropy_samples >= 3"),
        ({"scale_tau": 0.0}, "scale_tau > 0"),
    ],
)
def test_settings_out_of_range_are_refused(kwargs, message):
    policy = make_diffusion_policy(critic=make_dacer_critic(), num_candidates=1)
    with pytest.raises(ValueError, match=message):
        DACERLoss(policy, **kwargs)


@pytest.mark.parametrize(("kind", "expected", "got"), [(DACERLoss, 2, 1), (DIPOLoss, 1, 2)])
def test_critics_of_other_outputs_are_refused(kind, expected, got):
    critic = TwinCritic(3, 2, num_outputs=got)
    policy = DiffusionPolicy(NoiseNetwork(3, 2), NoiseSchedule.vp(20), critic=critic)
    message = f"{kind.__name__} is for critics of num_outputs={expected}, got num_outputs={got}"
    with pytest.raises(ValueError, match=message):
        kind(policy)
