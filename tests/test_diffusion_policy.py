"""The networks of the diffusion-policy baselines and the policy that they make."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

import oracle
import oracle_diffusion as numpy_of
from loss_cases import (
    ACTION_DIM,
    HIGH,
    LANGEVIN,
    LOW,
    NUM_STEPS,
    OBSERVATION_DIM,
    make_diffusion_policy,
)
from torchrl_aca import NoiseSchedule, chain
from torchrl_aca.baselines import DiffusionPolicy, NoiseNetwork, TwinCritic
from torchrl_aca.baselines.networks import action_gradient

BATCH, HUMANOID = 5, (376, 17)
array = numpy_of.array


def states(*batch):
    return torch.randn(*batch, OBSERVATION_DIM, dtype=torch.float64)


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


# --- networks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("embedding", "dim", "parameters"),
    [("none", 16, 236_817), ("sinusoidal", 32, 245_009), ("mlp", 16, 241_985)],
)
def test_policies_have_the_parameters_of_the_papers_table(embedding, dim, parameters):
    network = NoiseNetwork(*HUMANOID, embedding=embedding, embedding_dim=dim)
    assert count(network) == parameters


@pytest.mark.parametrize(("outputs", "parameters"), [(1, 232_705), (2, 232_962)])
def test_critics_have_the_parameters_of_the_papers_table(outputs, parameters):
    assert count(TwinCritic(*HUMANOID, num_outputs=outputs)) == 2 * parameters


@pytest.mark.parametrize("network", [NoiseNetwork, TwinCritic])
def test_weights_are_truncated_normal_and_biases_zero(network):
    for name, parameter in network(*HUMANOID).named_parameters():
        if name.endswith("bias"):
            assert (parameter == 0).all()
            continue
        fan_in = parameter.shape[-1] if network is NoiseNetwork else parameter.shape[1]
        std = fan_in**-0.5
        assert parameter.abs().max() <= 2 * std
        if parameter.numel() > 10_000:
            assert parameter.std().item() == pytest.approx(0.88 * std, rel=0.03)


@pytest.mark.parametrize("embedding", ["mlp", "sinusoidal", "none"])
def test_the_policys_network_equals_the_oracle(embedding):
    network = NoiseNetwork(
        OBSERVATION_DIM,
        ACTION_DIM,
        num_steps=NUM_STEPS,
        num_cells=(6, 5),
        embedding=embedding,
        embedding_dim=4,
        dtype=torch.float64,
    )
    for parameter in network.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    state, action = states(BATCH), torch.randn(3, BATCH, ACTION_DIM, dtype=torch.float64)
    features = network.encode(state)
    level = torch.randint(1, NUM_STEPS + 1, (3, BATCH))
    for given in (level, level[0], torch.tensor(NUM_STEPS)):
        actual = network(features, action, given)
        for row, levels in enumerate(given.expand(3, BATCH)):
            expected, _ = numpy_of.policy(network, array(state), array(action[row]), array(levels))
            np.testing.assert_allclose(array(actual[row]), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("outputs", [1, 3])
def test_the_critics_equal_the_oracle_for_any_number_of_candidates(outputs):
    critic = TwinCritic(
        OBSERVATION_DIM, ACTION_DIM, num_outputs=outputs, num_cells=(6, 5), dtype=torch.float64
    )
    state, action = states(BATCH), torch.randn(4, BATCH, ACTION_DIM, dtype=torch.float64)
    values = critic.evaluate(critic.encode(state), action)
    last = () if outputs == 1 else (outputs,)
    assert values.shape == (4, BATCH, 2, *last)
    torch.testing.assert_close(critic(state, action[1]), values[1])
    stack = TensorDict.from_module(critic)
    for member in (0, 1):
        layers = numpy_of.critic_layers(stack, member)
        inputs = np.concatenate([array(state), array(action[2])], -1)
        expected = numpy_of.mlp(layers, inputs)[0].reshape(BATCH, *last)
        np.testing.assert_allclose(array(values[2, :, member]), expected, rtol=1e-10, atol=1e-12)


def test_the_action_gradient_is_that_of_the_chosen_value_and_keeps_no_graph():
    critic = TwinCritic(OBSERVATION_DIM, ACTION_DIM, num_cells=(6,), dtype=torch.float64)
    state = states(BATCH)
    action = torch.randn(BATCH, ACTION_DIM, dtype=torch.float64, requires_grad=True)
    value = critic(state, action)[:, 1].sum()
    (expected,) = torch.autograd.grad(value, action)
    actual = action_gradient(critic, critic.encode(state), action, lambda v: v[:, 1])
    torch.testing.assert_close(actual, expected)
    assert not actual.requires_grad
    with torch.no_grad():
        again = action_gradient(critic, critic.encode(state), action, lambda v: v[:, 1])
    torch.testing.assert_close(again, expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NoiseNetwork(3, 0), "NoiseNetwork expects positive sizes"),
        (lambda: NoiseNetwork(3, 2, num_cells=(0,)), "positive sizes"),
        (lambda: NoiseNetwork(3, 2, embedding_dim=3), "even embedding_dim"),
        (lambda: NoiseNetwork(3, 2, embedding="fourier"), "embedding to be one of"),
        (lambda: TwinCritic(3, 2, num_critics=0), "TwinCritic expects positive sizes"),
    ],
)
def test_sizes_that_make_no_network_are_told(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- chains ---------------------------------------------------------------------------------------


def predict(policy, state):
    """The network as a function of NumPy arrays, for one candidate of each state."""
    return lambda x, k: numpy_of.policy(policy.network, array(state), x, k)[0]


def test_denoising_equals_the_oracle():
    policy = make_diffusion_policy(chain=NoiseSchedule.linear(NUM_STEPS, 1e-4, 0.999, 0.8))
    policy.initial_scale = 0.5
    state, noise = states(BATCH), policy.draws(BATCH)[:-1]
    sched = oracle.schedule(oracle.linear_betas(NUM_STEPS, scale=0.8))
    for candidate, actual in enumerate(policy.denoise(state, noise)):
        draws = array(noise[:, candidate])
        expected = numpy_of.ddpm_chain(predict(policy, state), draws, sched, 0.5)
        np.testing.assert_allclose(array(actual), expected, rtol=1e-8, atol=1e-10)


def test_the_chain_of_qsms_authors_equals_the_oracle():
    how = {"clip_denoised": False, "clip_step": True, "variance": "beta"}
    policy = make_diffusion_policy(chain=NoiseSchedule.vp(NUM_STEPS), **how)
    state, noise = states(BATCH), policy.draws(BATCH)[:-1]
    sched = oracle.schedule(oracle.vp_betas(NUM_STEPS))
    for candidate, actual in enumerate(policy.denoise(state, noise)):
        draws = array(noise[:, candidate])
        expected = numpy_of.authors_qsm_chain(predict(policy, state), draws, sched)
        np.testing.assert_allclose(array(actual), expected, rtol=1e-8, atol=1e-10)


def test_annealed_langevin_sampling_equals_the_oracle():
    policy = make_diffusion_policy(chain=LANGEVIN)
    state, noise = states(BATCH), policy.draws(BATCH)[:-1]
    score = predict(policy, state)
    for candidate, actual in enumerate(policy.denoise(state, noise)):
        draws = array(noise[:, candidate])
        expected = numpy_of.annealed_langevin_chain(lambda x: score(x, 1), draws)
        np.testing.assert_allclose(array(actual), expected, rtol=1e-8, atol=1e-10)


def test_a_number_clips_each_step_to_so_much():
    schedule, noise = NoiseSchedule.vp(3), torch.randn(4, 1, 50, 2)
    path = chain.denoise(
        lambda x, level: -9 * x, schedule, noise, clip=False, clip_step=0.7, keep_path=True
    )
    assert path[1:].abs().max() == pytest.approx(0.7)


def test_the_chain_is_differentiable_through_all_of_its_steps():
    policy = make_diffusion_policy(chain=NoiseSchedule.cosine(NUM_STEPS), clip_denoised=False)
    state, noise = states(BATCH), policy.draws(BATCH, num_candidates=1)[:-1]
    weight = policy.network.layers[-1].weight
    (actual,) = torch.autograd.grad(policy.denoise(state, noise).sum(), weight)
    with torch.no_grad():
        original, step = weight[0, 1].item(), 1e-6
        weight[0, 1] = original + step
        above = policy.denoise(state, noise).sum()
        weight[0, 1] = original - step
        below = policy.denoise(state, noise).sum()
        weight[0, 1] = original
    assert actual[0, 1].item() == pytest.approx(((above - below) / (2 * step)).item(), rel=1e-5)


@pytest.mark.parametrize("chain_of", [NoiseSchedule.cosine(NUM_STEPS), LANGEVIN], ids=["ddpm", "l"])
def test_tiles_change_nothing(chain_of):
    policy = make_diffusion_policy(chain=chain_of, num_candidates=7)
    state, noise = states(BATCH), policy.draws(BATCH)[:-1]
    candidates, values = policy.denoise(state, noise), []
    for rows in (1, 2 * BATCH, 10**6):
        policy.tile_rows = rows
        torch.testing.assert_close(policy.denoise(state, noise), candidates)
        values.append(policy.values(state, candidates))
    torch.testing.assert_close(values[0], values[2])
    torch.testing.assert_close(values[1], values[2])


# --- acting ---------------------------------------------------------------------------------------


def test_the_best_of_the_candidates_acts_in_the_environments_units():
    policy, state = make_diffusion_policy(num_candidates=6), states(BATCH)
    torch.manual_seed(1)
    draws = policy.draws(BATCH)
    candidates = policy.denoise(state, draws[:-1])
    smaller = policy.critic.evaluate(policy.critic.encode(state), candidates).amin(-1)
    best = candidates[smaller.argmax(0), torch.arange(BATCH)]
    torch.manual_seed(1)
    action = policy(TensorDict(observation=state, batch_size=[BATCH]))["action"]
    torch.testing.assert_close(action, (LOW + HIGH) / 2 + best * (HIGH - LOW) / 2)
    assert policy.spec.is_in(TensorDict(action=action, batch_size=[BATCH]))
    torch.testing.assert_close(policy.to_env(policy.from_env(action)), action)


def test_of_equal_candidates_the_first_acts():
    policy, state = make_diffusion_policy(num_candidates=6), states(BATCH)
    for parameter in policy.critic.parameters():
        parameter.data.zero_()
    torch.manual_seed(1)
    first = policy.denoise(state, policy.draws(BATCH)[:-1])[0]
    torch.manual_seed(1)
    torch.testing.assert_close(policy.sample(state), policy.to_env(first).detach())


def test_exploration_noise_is_additive_and_clipped_only_if_wanted():
    how = {"num_candidates": 1, "exploration_noise": 0.5, "alpha_init": 4.0}
    policy, state = make_diffusion_policy(**how), states(2000)
    torch.manual_seed(1)
    noisy = policy.from_env(policy.sample(state))
    torch.manual_seed(1)
    clean = policy.denoise(state, policy.draws(2000)[:-1])[0]
    assert (noisy - clean).std().item() == pytest.approx(2.0, rel=0.05)
    policy.clip_action = True
    torch.manual_seed(1)
    torch.testing.assert_close(policy.from_env(policy.sample(state)), noisy.clamp(-1, 1))


@pytest.mark.parametrize("draws", ["fixed", "fresh"])
def test_without_exploration_only_the_additive_noise_is_dropped(draws):
    how = {"exploration_noise": 5.0, "deterministic_draws": draws}
    policy, data = make_diffusion_policy(**how), TensorDict(observation=states(BATCH))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        one, two = (policy(data.clone())["action"] for _ in "12")
        data["observation"] = data["observation"][:1].expand(BATCH, -1).clone()
        alike = policy(data.clone())["action"]
    assert torch.equal(one, two) == (draws == "fixed")
    assert torch.allclose(alike, alike[:1]) == (draws == "fixed")
    assert policy.from_env(one).abs().max() <= 1 + 1e-9
    with set_exploration_type(ExplorationType.RANDOM):
        assert policy.from_env(policy(data.clone())["action"]).abs().max() > 1


@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)])
def test_states_of_any_batch_shape_have_an_action_each(batch):
    policy = make_diffusion_policy()
    data = policy(TensorDict(observation=states(*batch), batch_size=batch))
    assert data["action"].shape == (*batch, ACTION_DIM) and not data["action"].requires_grad


def test_another_network_shares_critics_and_alpha():
    policy = make_diffusion_policy(exploration_noise=0.1)
    network = NoiseNetwork(OBSERVATION_DIM, ACTION_DIM, num_steps=NUM_STEPS, dtype=torch.float64)
    other = policy.on(network)
    assert other.network is network and policy.network is not network
    assert other.critic is policy.critic and other.log_alpha is policy.log_alpha


def test_a_compiled_step_gives_what_an_eager_one_gives():
    policy = make_diffusion_policy()
    state, noise = states(BATCH), policy.draws(BATCH)[:-1]
    expected = policy.denoise(state, noise).detach()
    policy._run = chain.StepRunner(True)
    with torch.no_grad():
        torch.testing.assert_close(policy.denoise(state, noise), expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_candidates": 2}, "needs critics to choose by"),
        ({"num_candidates": 0}, "num_candidates >= 1"),
        ({"initial_scale": 0.0}, "initial_scale > 0"),
        ({"exploration_noise": -1.0}, "exploration_noise >= 0"),
        ({"alpha_init": 0.0}, "alpha_init > 0"),
        ({"variance": "both"}, "variance to be one of"),
        ({"deterministic_draws": "none"}, "deterministic_draws to be one of"),
        ({"spec": Bounded(-1, 1, (3,))}, "action_dim=2, the spec 3"),
    ],
)
def test_options_that_make_no_policy_are_told(options, message):
    with pytest.raises(ValueError, match=message):
        DiffusionPolicy(NoiseNetwork(3, 2), NoiseSchedule.vp(20), **options)


def test_chains_that_do_not_fit_the_network_are_told():
    with pytest.raises(ValueError, match="num_steps=20 noise levels, the chain 5"):
        DiffusionPolicy(NoiseNetwork(3, 2), NoiseSchedule.vp(5))
    for sizes in ([], [0.1, 0.0]):
        with pytest.raises(ValueError, match="step_size > 0"):
            DiffusionPolicy(NoiseNetwork(3, 2, num_steps=2), sizes)
    policy = DiffusionPolicy(nn.Linear(2, 2), NoiseSchedule.vp(3), action_dim=2)
    with pytest.raises(ValueError, match="draws for 1 candidates"):
        policy.draws(4, num_candidates=2, deterministic=True)
