"""The losses of QSM, SDAC and QVPO against a float64 restatement in NumPy, and their corners."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.objectives import SoftUpdate

import oracle_diffusion as numpy_of
from loss_cases import (
    ACTION_DIM,
    HIGH,
    LANGEVIN,
    LOW,
    NUM_STEPS,
    OBSERVATION_DIM,
    make_diffusion_policy,
    make_qsm,
    make_qvpo,
    make_rlpd_data,
    make_sdac,
)
from torchrl_aca import NoiseSchedule
from torchrl_aca.baselines import (
    DiffusionPolicy,
    NoiseNetwork,
    QSMLoss,
    QVPOLoss,
    SDACLoss,
    TwinCritic,
)
from torchrl_aca.baselines.qvpo import advantage_weight, cutoff_weight, entropy_coefficient
from torchrl_aca.baselines.sdac import reverse_sampling_target

BATCH, GAMMA = 9, 0.875
MAKE = {"qsm": make_qsm, "qvpo": make_qvpo, "sdac": make_sdac}
EXACT = {"rtol": 1e-9, "atol": 1e-11}
array = numpy_of.array


def unit(action):
    """Environment units to [-1, 1]."""
    return (action - (HIGH + LOW) / 2) / ((HIGH - LOW) / 2)


def make_data(loss):
    """Transitions with draws: no chain runs, and noise and levels are known."""
    data = make_rlpd_data(BATCH)
    span = HIGH - LOW
    data["next_action"] = LOW + span * torch.rand(BATCH, ACTION_DIM, dtype=torch.float64)
    data["policy_action"] = LOW + span * torch.rand(BATCH, ACTION_DIM, dtype=torch.float64)
    data["policy_weight"] = torch.rand(BATCH, dtype=torch.float64)
    data["noise_level"] = torch.randint(1, NUM_STEPS + 1, (BATCH,))
    data["noise"] = torch.randn(BATCH, ACTION_DIM, dtype=torch.float64)
    return data


def critics_of(loss, kind="qvalue_network_params"):
    return [numpy_of.critic_layers(getattr(loss, kind), member) for member in (0, 1)]


def noised(action, data, schedule):
    """``a_t`` of actions in [-1, 1], and its ``alpha_bar_t``."""
    cumprod = array(schedule.alphas_cumprod)[array(data["noise_level"]).astype(int) - 1][:, None]
    return np.sqrt(cumprod) * action + np.sqrt(1 - cumprod) * array(data["noise"]), cumprod


def assert_policy_loss(loss, value, saved, upstream, expected):
    """Value and gradients of an actor loss; none reaches the critics."""
    loss.zero_grad(set_to_none=True)
    value.backward()
    np.testing.assert_allclose(value.item(), expected, **EXACT)
    gradients = numpy_of.policy_gradients(saved, upstream)
    parameters = dict(loss.policy_network.named_parameters())
    assert parameters.keys() == gradients.keys()
    for name, parameter in parameters.items():
        np.testing.assert_allclose(array(parameter.grad), gradients[name], **EXACT)
        assert np.abs(gradients[name]).max() > 1e-6
    assert all(p.grad is None for p in loss.qvalue_network.parameters())


# --- the critics ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MAKE)
def test_qvalue_loss_and_gradients_equal_the_oracle(name):
    loss = MAKE[name](reward_scale=0.5)
    data = make_data(loss)
    state, action = array(data["observation"]), array(unit(data["action"]))
    target = numpy_of.td_target(
        critics_of(loss, "target_qvalue_network_params"),
        array(data["next", "reward"])[:, 0],
        array(data["next", "terminated"])[:, 0],
        array(data["next", "observation"]),
        array(unit(data["next_action"])),
        GAMMA,
        0.5,
    )
    out = loss.qvalue_loss(data)
    out["loss_qvalue"].backward()
    errors, inputs = [], np.concatenate([state, action], -1)
    for member, layers in enumerate(critics_of(loss)):
        value, tape = numpy_of.mlp(layers, inputs)
        errors.append(value[:, 0] - target)
        grads, _ = numpy_of.mlp_backward(layers, tape, 2 * errors[-1][:, None] / BATCH)
        for layer, (weight, bias) in zip(loss.qvalue_network.layers, grads, strict=True):
            np.testing.assert_allclose(array(layer.weight.grad)[member], weight, **EXACT)
            np.testing.assert_allclose(array(layer.bias.grad)[member, 0], bias, **EXACT)
    np.testing.assert_allclose(out["loss_qvalue"].item(), np.mean(np.square(errors), 1).sum())
    np.testing.assert_allclose(array(data["td_error"]), np.abs(errors).max(0), **EXACT)
    np.testing.assert_allclose(out["target_value"].item(), target.mean(), **EXACT)
    assert all(p.grad is None for p in loss.policy_network.parameters())


@pytest.mark.parametrize("name", MAKE)
def test_truncated_rows_bootstrap_and_terminated_rows_do_not(name):
    loss, data = MAKE[name](), make_rlpd_data(3)
    data["next", "done"] = torch.tensor([[False], [True], [True]])
    data["next", "terminated"] = torch.tensor([[False], [False], [True]])
    data["next", "observation"][2] = float("nan")
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        for param in params.values(True, True):
            param.data.zero_()
    loss.target_qvalue_network_params["layers", "2", "bias"].data.fill_(4.0)
    loss.qvalue_loss(data)
    bootstrap = torch.tensor([1.0, 1.0, 0.0]).double() * GAMMA * 4
    expected = loss.reward_scale * data["next", "reward"][:, 0] + bootstrap
    torch.testing.assert_close(data["td_error"], expected.abs())


@pytest.mark.parametrize("name", MAKE)
def test_the_target_is_of_the_policys_best_candidate(name):
    loss, data = MAKE[name](), make_rlpd_data(BATCH)
    torch.manual_seed(3)
    expected = loss.qvalue_loss(data)
    torch.manual_seed(3)
    data["next_action"] = loss.actor_network.sample(data["next", "observation"])
    torch.testing.assert_close(loss.qvalue_loss(data), expected, rtol=0, atol=0)


# --- QSM ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["min", "mean"])
@pytest.mark.parametrize("chain", [LANGEVIN, NoiseSchedule.vp(NUM_STEPS)], ids=["score", "noise"])
def test_score_matching_and_its_gradients_equal_the_oracle(chain, which):
    policy = make_diffusion_policy(chain=chain)
    loss = make_qsm(policy=policy, score_scale=3.0, gradient_of=which)
    data = make_data(loss)
    state, action = array(data["observation"]), array(unit(data["action"]))
    level, scale = array(data["noise_level"]).astype(int), 3.0
    if policy.schedule is not None:
        action, _ = noised(action, data, policy.schedule)
        scale = -3.0  # noise points away from where the score leads
    target = numpy_of.score_target(critics_of(loss), state, action, scale, which)
    output, saved = numpy_of.policy(policy.network, state, action, level)
    expected, upstream = numpy_of.regression(output, target)
    out = loss.actor_loss(data)
    assert_policy_loss(loss, out["loss_actor"], saved, upstream, expected)
    norm = np.linalg.norm(target / scale, axis=-1).mean()
    np.testing.assert_allclose(out["gradient_norm"].item(), norm, **EXACT)


def test_of_equal_critics_the_first_is_differentiated():
    loss = make_qsm()
    for param in loss.qvalue_network.parameters():
        param.data[1] = param.data[0]
    data = make_data(loss)
    smaller = loss.actor_loss(data)["loss_actor"]
    loss.gradient_of = "mean"
    torch.testing.assert_close(smaller, loss.actor_loss(data)["loss_actor"])


# --- SDAC -----------------------------------------------------------------------------------------


def sdac_parts(loss, data, seed):
    """What the actor loss is made of, in NumPy: state, noised action, level, draws, weights."""
    loss.log_alpha.data.fill_(0.4)
    torch.manual_seed(seed)
    size = loss.num_proposals, BATCH, ACTION_DIM
    draws = array(torch.randn(size, dtype=torch.float64))
    state, action = array(data["observation"]), array(unit(data["policy_action"]))
    noisy, cumprod = noised(action, data, loss.actor_network.schedule)
    level, beta = array(data["noise_level"]).astype(int), 5 / np.exp(0.4)
    average, weights = numpy_of.average_noise(critics_of(loss), state, noisy, draws, cumprod, beta)
    return state, noisy, level, draws, weights, average


def test_reverse_sampling_score_matching_and_its_gradients_equal_the_oracle():
    loss = make_sdac()
    data = make_data(loss)
    state, noisy, level, _, _, target = sdac_parts(loss, data, seed=7)
    output, saved = numpy_of.policy(loss.policy_network, state, noisy, level)
    expected, upstream = numpy_of.regression(output, target)
    torch.manual_seed(7)
    value = loss.actor_loss(data)["loss_actor"]
    assert_policy_loss(loss, value, saved, upstream, expected)
    assert loss.log_alpha.grad is None


def test_one_evaluation_for_each_state_has_the_gradient_of_one_for_each_proposal():
    """The authors' loss, mean over (k, b, j) of w_k (eps - e_k)^2, has 1/K of the gradient."""
    loss = make_sdac(num_proposals=64)
    data = make_data(loss)
    state, noisy, level, draws, weights, _ = sdac_parts(loss, data, seed=8)
    rows = {"observation": state, "noisy": noisy, "draws": draws, "weights": weights}
    rows = {key: torch.from_numpy(value) for key, value in rows.items()}
    network = loss.policy_network
    output = network(
        network.encode(rows["observation"]),
        rows["noisy"].expand(64, -1, -1),
        torch.from_numpy(level),
    )
    authors = (rows["weights"].unsqueeze(-1) * (output - rows["draws"]).square()).mean()
    expected = torch.autograd.grad(authors, list(network.parameters()))
    torch.manual_seed(8)
    ours = loss.actor_loss(data)["loss_actor"]
    actual = torch.autograd.grad(ours, list(network.parameters()))
    for one, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(one, 64 * other)
        assert one.abs().max() > 1e-6


def test_the_averaged_noise_leads_to_the_better_actions():
    draws, values = torch.tensor([[[1.0]], [[-2.0]]]), torch.tensor([[0.0], [0.0]])
    torch.testing.assert_close(reverse_sampling_target(draws, values, 5.0), torch.tensor([[-0.5]]))
    values[1] = 50.0
    torch.testing.assert_close(reverse_sampling_target(draws, values, 5.0), torch.tensor([[-2.0]]))
    torch.testing.assert_close(reverse_sampling_target(draws, values, 0.0), torch.tensor([[-0.5]]))


def test_the_exploration_of_sdac_follows_its_open_loop():
    """Standard deviations at updates 5k, 10k, 20k, 30k, 50k, 70k and 100k, one step in 250."""
    loss = make_sdac()
    loss.log_alpha.data.fill_(np.log(5.0))
    optimizer = torch.optim.Adam([loss.log_alpha], lr=7e-3)
    stds = []
    for _ in range(400):
        optimizer.zero_grad()
        loss.alpha_loss()["loss_alpha"].backward()
        optimizer.step()
        stds.append(0.1 * loss.log_alpha.exp().item())
    updates = np.array([5, 10, 20, 30, 50, 70, 100]) * 1000
    expected = [0.435, 0.380, 0.295, 0.236, 0.165, 0.130, 0.108]
    np.testing.assert_allclose([stds[k // 250 - 1] for k in updates], expected, atol=2e-3)


def test_sdac_acts_by_the_moving_average_and_learns_from_the_online_policy():
    loss, data = make_sdac(), make_rlpd_data(BATCH)
    updater = SoftUpdate(loss, tau=0.25)
    state, noise = data["observation"], loss.actor_network.draws(BATCH)[:-1]
    online, average = loss.actor_network, loss.average_actor_network
    before = average.denoise(state, noise)
    torch.testing.assert_close(online.denoise(state, noise), before)
    for param in loss.policy_network.parameters():
        param.data.add_(1.0)
    torch.testing.assert_close(average.denoise(state, noise), before)
    updater.step()
    assert (average.denoise(state, noise) - before).abs().max() > 1e-3
    torch.manual_seed(0)
    expected = online.sample(state)
    torch.manual_seed(0)
    torch.testing.assert_close(loss.sample_policy_action(data), expected)


# --- QVPO -----------------------------------------------------------------------------------------


def test_weighted_denoising_and_its_gradients_equal_the_oracle():
    loss = make_qvpo(num_uniform=3, entropy_coefficient=0.3)
    data = make_data(loss)
    torch.manual_seed(9)
    uniform = 2 * torch.rand(3, BATCH, ACTION_DIM, dtype=torch.float64) - 1
    level = array(torch.randint(1, NUM_STEPS + 1, (4, BATCH))).astype(int).reshape(-1)
    noise = array(torch.randn(4, BATCH, ACTION_DIM, dtype=torch.float64)).reshape(-1, ACTION_DIM)
    actions = torch.cat([unit(data["policy_action"])[None], uniform]).reshape(-1, ACTION_DIM)
    cumprod = array(loss.actor_network.schedule.alphas_cumprod)[level - 1][:, None]
    noisy = np.sqrt(cumprod) * array(actions) + np.sqrt(1 - cumprod) * noise
    state = np.tile(array(data["observation"]), (4, 1))
    weight = array(data["policy_weight"])
    weight = np.concatenate([weight, *3 * [0.3 * weight]])
    output, saved = numpy_of.policy(loss.policy_network, state, noisy, level)
    expected, upstream = numpy_of.regression(output, noise, weight)
    torch.manual_seed(9)
    value = loss.actor_loss(data)["loss_actor"]
    assert_policy_loss(loss, value, saved, upstream, expected)


@pytest.mark.parametrize("weight", ["advantage", "cutoff"])
def test_the_best_candidate_and_its_weight_equal_the_oracle(weight):
    loss, data = make_qvpo(weight=weight), make_rlpd_data(BATCH)
    torch.manual_seed(2)
    noise = loss.actor_network.draws(BATCH)[:-1]
    candidates = array(loss.actor_network.denoise(data["observation"], noise))
    state = array(data["observation"])
    values = np.stack(
        [np.min([numpy_of.critic(c, state, a) for c in critics_of(loss)], 0) for a in candidates]
    )
    best = values.argmax(0)
    torch.manual_seed(2)
    action, weights = loss.sample_policy_action(data)
    np.testing.assert_allclose(
        array(unit(action)), candidates[best, np.arange(BATCH)], rtol=1e-9, atol=1e-9
    )
    top = values.max(0)
    expected = top - values.mean(0) if weight == "advantage" else np.where(top > 1, top, 0)
    np.testing.assert_allclose(array(weights), expected, **EXACT)
    assert not action.requires_grad and not weights.requires_grad


def test_advantages_are_positive_whatever_the_sign_of_the_values_and_cutoffs_are_not():
    values = torch.tensor([[-7.0, 2.0, 0.5], [-5.0, 2.0, 0.1]])
    torch.testing.assert_close(advantage_weight(values), torch.tensor([1.0, 0.0, 0.2]))
    torch.testing.assert_close(cutoff_weight(values), torch.tensor([0.0, 2.0, 0.0]))
    torch.testing.assert_close(advantage_weight(values - 100), torch.tensor([1.0, 0.0, 0.2]))


def test_the_weight_of_uniform_actions_falls_to_its_floor():
    updates = (0, 1, 50_000, 100_000, 180_000, 10**6)
    actual = [entropy_coefficient(update) for update in updates]
    assert actual == pytest.approx([0.02, 0.02, 0.015, 0.01, 0.002, 0.002], abs=2e-7)


def test_without_uniform_actions_the_best_one_alone_is_regressed():
    loss = make_qvpo(num_uniform=0)
    data = make_data(loss)
    data["policy_weight"].zero_()
    assert loss.actor_loss(data)["loss_actor"].item() == 0
    data["policy_weight"].fill_(1.0)
    assert loss.actor_loss(data)["loss_actor"].item() > 0


# --- corners --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["qsm", "sdac", "qvpo"])
def test_one_candidate_and_one_action_dimension(name):
    policy = DiffusionPolicy(
        NoiseNetwork(OBSERVATION_DIM, 1, num_steps=NUM_STEPS, num_cells=(6,)),
        NoiseSchedule.cosine(NUM_STEPS),
        critic=TwinCritic(OBSERVATION_DIM, 1, num_cells=(6,)),
    )
    kwargs = {"weight": "cutoff"} if name == "qvpo" else {}
    loss = {"qsm": QSMLoss, "sdac": SDACLoss, "qvpo": QVPOLoss}[name](policy, **kwargs)
    SoftUpdate(loss, tau=0.1)
    data = make_rlpd_data(BATCH)
    data = data.apply(lambda x: x.float() if x.is_floating_point() else x)
    data["action"] = data["action"][:, :1].clamp(-1, 1)
    assert all(value.isfinite() for value in loss(data).values())


@pytest.mark.parametrize("name", MAKE)
def test_an_update_reads_no_value_and_stays_on_its_device(name):
    """As a CUDA graph asks: on the device `meta`, which has no values, both would raise."""
    exploration = {"exploration_noise": 0.1} if name == "sdac" else {}
    policy = make_diffusion_policy(chain=LANGEVIN if name == "qsm" else None, **exploration)
    loss = {"qsm": QSMLoss, "sdac": SDACLoss, "qvpo": QVPOLoss}[name](policy.to("meta"))
    data = make_rlpd_data(BATCH).to("meta")
    out = loss(data)
    sum(value for key, value in out.items() if key.startswith("loss")).backward()
    devices = {param.grad.device.type for param in loss.parameters()}
    assert devices == {"meta"} == {data["td_error"].device.type}


def test_what_a_loss_cannot_work_with_is_told():
    policy = make_diffusion_policy()
    with pytest.raises(ValueError, match="num_candidates >= 2, got 1"):
        QVPOLoss(make_diffusion_policy(num_candidates=1))
    with pytest.raises(ValueError, match="weight to be one of"):
        QVPOLoss(policy, weight="rank")
    with pytest.raises(ValueError, match="num_uniform >= 0"):
        QVPOLoss(policy, num_uniform=-1)
    with pytest.raises(ValueError, match="num_proposals >= 1"):
        SDACLoss(policy, num_proposals=0)
    with pytest.raises(ValueError, match="inverse_temperature >= 0"):
        SDACLoss(policy, inverse_temperature=-1.0)
    for loss_class in (SDACLoss, QVPOLoss):
        with pytest.raises(ValueError, match="build the policy with a NoiseSchedule"):
            loss_class(make_diffusion_policy(chain=LANGEVIN))
    with pytest.raises(ValueError, match="gradient_of to be one of"):
        QSMLoss(policy, gradient_of="max")
    with pytest.raises(ValueError, match="score_scale > 0"):
        QSMLoss(policy, score_scale=0.0)
    with pytest.raises(ValueError, match="reward_scale > 0"):
        QSMLoss(policy, reward_scale=0.0)
    with pytest.raises(ValueError, match="num_target_candidates >= 1"):
        QSMLoss(policy, num_target_candidates=0)
    sees_levels = make_diffusion_policy(chain=list(LANGEVIN))
    with pytest.raises(ValueError, match='expected a network .* got embedding="mlp"'):
        QSMLoss(sees_levels)
    without = DiffusionPolicy(NoiseNetwork(3, 2), NoiseSchedule.vp(20))
    with pytest.raises(ValueError, match="must have critics"):
        QSMLoss(without)
