"""The package against numbers recorded from the official implementation (float32, on a CPU).

The tolerances tell the readings of the algorithm apart: targets that follow the critics before
instead of after the noise-level step are off by 1e-5 in the target parameters and nowhere else.
"""

from __future__ import annotations

import pytest
import torch

from reference import CRITICS, TARGETS, OfficialAgent, assert_within, load_recording, subtree

VALUE = 1e-6
LOSS = 1e-6
PARAMETER = 3e-5  # Adam amplifies rounding where a gradient is as small as its epsilon.
TARGET_PARAMETER = 1e-6


@pytest.fixture(scope="module")
def recording():
    return load_recording()


@pytest.fixture(params=[torch.float32, torch.float64], ids=str)
def agent(recording, request):
    _, action_dim, num_steps, num_candidates, _, _ = (int(n) for n in recording["meta"])
    critics, targets = (
        [subtree(recording, f"init/{name}") for name in names] for names in (CRITICS, TARGETS)
    )
    return OfficialAgent(
        critics,
        targets,
        float(recording["init/log_alpha"]),
        action_dim,
        num_steps,
        dtype=request.param,
        guidance_weight=float(recording["guidance_weight"]),
        num_candidates=num_candidates,
    )


def test_schedule(recording, agent):
    recorded = subtree(recording, "schedule")
    constants = dict(agent.actor.schedule.named_buffers())
    assert len(recorded.keys() & constants.keys()) == 5
    for key in recorded.keys() & constants.keys():
        assert_within(constants[key].numpy(), recorded[key], VALUE, key)


def test_critic_values(recording, agent):
    data = subtree(recording, "critic")
    level = torch.as_tensor(data["t"]) + 1  # the official indices are 0..T-1
    inputs = agent.tensor(data["obs"]), agent.tensor(data["action"]), level
    values = agent.critic(*inputs).detach().numpy()
    for c, name in enumerate(CRITICS):
        assert_within(values[:, c], data[name], VALUE, name)


def test_actions(recording, agent):
    obs, draws = recording["critic/obs"], subtree(recording, "actor")
    greedy = agent.greedy_action(obs, draws).numpy()
    assert_within(greedy, draws["greedy_action"], VALUE, "greedy action")
    assert_within(agent.action(obs, draws).numpy(), draws["action"], VALUE, "action")


def test_three_updates(recording, agent):
    num_updates = int(recording["meta"][5])
    assert num_updates == 3
    for i in range(num_updates):
        batch = subtree(recording, f"update{i}")
        draws = subtree(recording, f"update{i}/next_action") | {k: batch[k] for k in ("t", "noise")}
        losses = agent.update(batch, draws, i)
        for kind, name in (("td", "td_q{}_loss"), ("noise_level", "qt{}_loss")):
            recorded = sum(batch[f"info/{name.format(c)}"] for c in (1, 2))
            assert_within(losses[kind], recorded, LOSS, f"update {i} {kind} loss")
        for names, members, tolerance in (
            (CRITICS, agent.critics(), PARAMETER),
            (TARGETS, agent.targets(), TARGET_PARAMETER),
        ):
            for name, member in zip(names, members, strict=True):
                after = subtree(recording, f"update{i}/after/{name}")
                assert after.keys() == member.keys()
                for key, value in member.items():
                    assert_within(value, after[key], tolerance, f"update {i} {name} {key}")
        log_alpha = agent.actor.log_alpha.item()
        assert_within(log_alpha, batch["after/log_alpha"], VALUE, f"update {i} log_alpha")
