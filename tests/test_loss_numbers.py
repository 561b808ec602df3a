"""The losses, their gradients and whole updates against the float64 oracle."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import oracle
from reference import OfficialAgent, assert_within

OBS, ACT, STEPS, CANDIDATES, BATCH = 3, 2, 5, 3, 7
WEIGHT, LOG_ALPHA = 4.0, 0.7
EXACT = 1e-9
SCHED = oracle.schedule(oracle.cosine_betas(STEPS))


def random_member(rng):
    """Parameters of one official network with two hidden layers and level features of size 4."""
    sizes = [(4, 8), (8, 4), (OBS + ACT + 4, 9), (9, 9), (9, 1)]
    member = {}
    for i, (num_in, num_out) in enumerate(sizes):
        name = f"linear_{i}" if i else "linear"
        member[f"{name}.w"] = rng.normal(size=(num_in, num_out)) / np.sqrt(num_in)
        member[f"{name}.b"] = 0.1 * rng.normal(size=num_out)
    return member


def random_batch(rng, first_level):
    batch = {
        "obs": rng.normal(size=(BATCH, OBS)),
        "action": rng.uniform(-1, 1, size=(BATCH, ACT)),
        "next_obs": rng.normal(size=(BATCH, OBS)),
        "reward": rng.normal(size=BATCH),
        "done": (np.arange(BATCH) % 3 == 0).astype(float),
    }
    draws = {
        "initial_noise": rng.normal(size=(CANDIDATES, BATCH, ACT)),
        "step_noise": rng.normal(size=(STEPS, CANDIDATES, BATCH, ACT)),
        "exploration_noise": rng.normal(size=(BATCH, ACT)),
        "t": rng.integers(first_level, first_level + STEPS, size=BATCH),
        "noise": rng.normal(size=(BATCH, ACT)),
    }
    return batch, draws


class Case:
    """The same networks, batch and draws for the package and for the oracle."""

    def __init__(self, first_level=1, noise_level_target="mean"):
        self.rng = np.random.default_rng(0)
        self.q, self.targets = ([random_member(self.rng) for _ in "12"] for _ in "ab")
        self.batch, self.draws = random_batch(self.rng, first_level)
        self.agent = OfficialAgent(
            self.q,
            self.targets,
            LOG_ALPHA,
            ACT,
            STEPS,
            first_level=first_level,
            noise_level_target=noise_level_target,
            guidance_weight=WEIGHT,
            num_candidates=CANDIDATES,
        )
        self.data = self.agent.data(self.batch, self.draws)

    def assert_loss(self, loss, expected_losses, expected_gradients):
        assert_within(loss.item(), sum(expected_losses), EXACT, "loss")
        loss.backward()
        pairs = zip(self.agent.gradients(), expected_gradients, strict=True)
        for c, (actual, expected) in enumerate(pairs):
            assert actual.keys() == expected.keys()
            for key, gradient in actual.items():
                assert np.abs(gradient).max() > 1e-6
                assert_within(gradient, expected[key], EXACT, f"gradient of critic {c} {key}")

    def oracle_target(self, first_level):
        next_obs, d = self.batch["next_obs"], self.draws
        noises = d["initial_noise"], d["step_noise"]
        candidates = oracle.denoise(self.q, next_obs, *noises, SCHED, WEIGHT, first_level)
        best = oracle.select_best(self.q, next_obs, candidates)
        best = oracle.explore(best, d["exploration_noise"], LOG_ALPHA)
        flags = self.batch["reward"], self.batch["done"]
        return oracle.td_target(self.targets, *flags, next_obs, best)


@pytest.mark.parametrize("first_level", [0, 1])
def test_td_target_loss_and_gradients(first_level):
    case = Case(first_level)
    target = case.oracle_target(first_level)
    out = case.agent.loss.qvalue_loss(case.data)
    assert_within(out["target_value"].item(), target.mean(), EXACT, "mean target")
    obs, action = case.batch["obs"], case.batch["action"]
    values = np.stack([oracle.critic(q, obs, action, 0) for q in case.q])
    td_error = np.abs(values - target).max(0)
    assert_within(case.data["td_error"].numpy(), td_error, EXACT, "td_error")
    case.assert_loss(out["loss_qvalue"], *oracle.td_loss(case.q, obs, action, target))


@pytest.mark.parametrize("target", ["mean", "self"])
@pytest.mark.parametrize("first_level", [0, 1])
def test_noise_level_loss_and_gradients(first_level, target):
    case = Case(first_level, noise_level_target=target)
    loss = case.agent.loss.noise_level_loss(case.data)["loss_noise_level"]
    given = case.batch["obs"], case.batch["action"], case.draws["noise"], case.draws["t"]
    expected = oracle.noise_level_loss(case.q, *given, SCHED, first_level, target)
    case.assert_loss(loss, *expected)


@pytest.mark.parametrize("log_alpha", [-2.0, 0.7, np.log(5)])
def test_alpha_loss_and_gradient(log_alpha):
    agent = Case().agent
    agent.actor.log_alpha.data.fill_(log_alpha)
    out = agent.loss.alpha_loss()
    out["loss_alpha"].backward()
    gradient = oracle.alpha_gradient(log_alpha, ACT, -0.9 * ACT)
    assert_within(out["entropy"].item(), oracle.surrogate_entropy(log_alpha, ACT), EXACT, "entropy")
    assert_within(agent.actor.log_alpha.grad.item(), gradient, EXACT, "gradient")
    assert_within(out["loss_alpha"].item(), log_alpha * gradient, EXACT, "loss")


@pytest.mark.parametrize("first_level", [0, 1])
def test_official_updates(first_level):
    case = Case(first_level)
    state = oracle.initial_state(case.q, case.targets, LOG_ALPHA)
    for i in (0, 1, 2, 3, 250):  # 250: the second step of alpha
        batch, draws = random_batch(case.rng, first_level)
        losses = case.agent.update(batch, draws, i)
        state, expected = oracle.official_update(state, batch, draws, i, SCHED, WEIGHT, first_level)
        for kind, value in losses.items():
            assert_within(value, sum(expected[kind]), 1e-8, f"update {i} {kind} loss")
        for name, members in (
            ("critics", case.agent.critics()),
            ("targets", case.agent.targets()),
        ):
            for member, wanted in zip(members, state[name], strict=True):
                for key, value in member.items():
                    assert_within(value, wanted[key], 1e-8, f"update {i} {name} {key}")
        log_alpha = case.agent.actor.log_alpha.item()
        assert_within(log_alpha, state["alpha"][0], EXACT, f"update {i} log_alpha")
    assert state["step"] == 8 and torch.is_tensor(case.agent.actor.log_alpha)
