"""The oracle against numbers recorded from the official implementation (float32, on a CPU).

``data/README.md`` describes the recording, whose indices are the oracle's. The tolerances tell the
readings of the algorithm apart: the closest wrong one found, targets that follow the critics before
instead of after the noise-level step, is off by 1e-5 in the target parameters and nowhere else.
"""

from __future__ import annotations

import pytest

import oracle
from reference import CRITICS, TARGETS, assert_within, load_recording, subtree

# Worst absolute errors allowed; in brackets those found.
VALUE = 1e-6  # schedule, critic values, actions [3e-8, 9e-8, 2e-7], log_alpha [1.5e-7]
LOSS = 1e-7  # [1.6e-8]
PARAMETER = 3e-5  # [9.9e-6: Adam amplifies rounding where a gradient is as small as its epsilon]
TARGET_PARAMETER = 1e-6  # [1.2e-7]


@pytest.fixture(scope="module")
def reference():
    return load_recording()


@pytest.fixture
def sched(reference):
    return oracle.schedule(oracle.cosine_betas(int(reference["meta"][2])))


@pytest.fixture
def state(reference):
    critics, targets = (
        [subtree(reference, f"init/{name}") for name in names] for names in (CRITICS, TARGETS)
    )
    return oracle.initial_state(critics, targets, float(reference["init/log_alpha"]))


def test_schedule(reference, sched):
    recorded = subtree(reference, "schedule")
    for key in recorded.keys() & sched.keys():
        assert_within(sched[key], recorded[key], VALUE, key)
    assert len(recorded.keys() & sched.keys()) == 5


def test_critic_values(reference, state):
    data = subtree(reference, "critic")
    for name, params in zip(CRITICS, state["critics"], strict=True):
        values = oracle.critic(params, data["obs"], data["action"], data["t"])
        assert_within(values, data[name], VALUE, name)


def test_actions(reference, state, sched):
    obs, draws = reference["critic/obs"].astype(float), subtree(reference, "actor")
    noises = draws["initial_noise"], draws["step_noise"]
    weight = float(reference["guidance_weight"])
    candidates = oracle.denoise(state["critics"], obs, *noises, sched, weight, first_level=0)
    greedy = oracle.select_best(state["critics"], obs, candidates)
    assert_within(greedy, draws["greedy_action"], VALUE, "greedy action")
    action = oracle.explore(greedy, draws["exploration_noise"], state["alpha"][0])
    assert_within(action, draws["action"], VALUE, "action")


def test_three_updates(reference, state, sched):
    weight = float(reference["guidance_weight"])
    for i in range(int(reference["meta"][5])):
        batch = subtree(reference, f"update{i}")
        draws = subtree(reference, f"update{i}/next_action") | {k: batch[k] for k in ("t", "noise")}
        state, losses = oracle.official_update(state, batch, draws, i, sched, weight)
        for c in (0, 1):
            for kind, key in (("td", f"td_q{c + 1}_loss"), ("noise_level", f"qt{c + 1}_loss")):
                assert_within(losses[kind][c], batch[f"info/{key}"], LOSS, f"update {i} {key}")
            for group, name, tolerance in (
                ("critics", CRITICS[c], PARAMETER),
                ("targets", TARGETS[c], TARGET_PARAMETER),
            ):
                after = subtree(reference, f"update{i}/after/{name}")
                assert after.keys() == state[group][c].keys()
                for key, value in state[group][c].items():
                    assert_within(value, after[key], tolerance, f"update {i} {name} {key}")
        assert_within(state["alpha"][0], batch["after/log_alpha"], VALUE, f"update {i} log_alpha")
    assert state["step"] == 5  # 3 TD steps and, at updates 0 and 2, a noise-level step
