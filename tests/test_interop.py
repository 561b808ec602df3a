from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_aca import NoiseLevelCritic
from torchrl_aca.interop import load_official, to_official


def make_critic(**kwargs):
    return NoiseLevelCritic(4, 3, num_cells=(7, 5), embedding_dim=8, **kwargs)


def state(critic):
    return {name: value.clone() for name, value in critic.state_dict().items()}


def test_names_and_shapes_are_those_of_the_official_networks():
    expected = {
        "linear.w": (8, 16),
        "linear_1.w": (16, 8),
        "linear_2.w": (4 + 3 + 8, 7),
        "linear_3.w": (7, 5),
        "linear_4.w": (5, 1),
    }
    expected |= {name.replace(".w", ".b"): shape[1:] for name, shape in expected.items()}
    members = to_official(make_critic())
    assert len(members) == 2
    for member in members:
        assert {name: array.shape for name, array in member.items()} == expected


def test_round_trip_keeps_every_parameter_and_the_members_in_order():
    source, critic = make_critic(), make_critic()
    for parameter in source.parameters():  # biases are zero after construction
        torch.nn.init.normal_(parameter)
    parameters = list(critic.parameters())
    assert load_official(critic, *to_official(source)) is critic
    for name, value in source.state_dict().items():
        assert torch.equal(critic.state_dict()[name], value)
    assert all(a is b for a, b in zip(parameters, critic.parameters(), strict=True))


def test_arrays_of_another_dtype_are_cast():
    critic = make_critic()
    members = [{k: v.astype(np.float64) + 1 for k, v in m.items()} for m in to_official(critic)]
    load_official(critic, *members)
    assert {p.dtype for p in critic.parameters()} == {torch.float32}
    np.testing.assert_allclose(
        to_official(critic)[1]["linear.w"], members[1]["linear.w"], rtol=1e-6
    )


def test_exported_arrays_do_not_follow_the_critic():
    critic = make_critic()
    arrays = to_official(critic)[0]
    before = arrays["linear.w"].copy()
    torch.nn.init.ones_(critic.level_in.weight)
    np.testing.assert_array_equal(arrays["linear.w"], before)


def drop_a_name(member):
    del member["linear_4.b"]


def rename(member):
    member["linear_9.w"] = member.pop("linear_1.w")


def transpose(member):
    member["linear_3.w"] = member["linear_3.w"].T


@pytest.mark.parametrize("spoil", [drop_a_name, rename, transpose])
def test_names_and_shapes_that_do_not_fit_leave_the_critic_untouched(spoil):
    critic = make_critic()
    before = state(critic)
    good, bad = to_official(make_critic())
    spoil(bad)
    with pytest.raises(ValueError, match="Critic 1 does not fit: expected .* got .* Build"):
        load_official(critic, good, bad)
    assert all(torch.equal(before[name], value) for name, value in critic.state_dict().items())


@pytest.mark.parametrize("num_members", [0, 1, 3])
def test_a_wrong_number_of_members_leaves_the_critic_untouched(num_members):
    critic = make_critic()
    before = state(critic)
    members = to_official(make_critic(num_critics=3))[:num_members]
    with pytest.raises(ValueError, match=f"Expected 2 critics, got {num_members}"):
        load_official(critic, *members)
    assert all(torch.equal(before[name], value) for name, value in critic.state_dict().items())
