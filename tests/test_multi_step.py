"""n-step returns do not bootstrap through the end of an episode."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.postprocs import MultiStep
from torchrl.envs.transforms import MultiStepTransform

from loss_cases import make_data, make_loss, set_constant
from torchrl_aca.replay import with_last_flags

GAMMA, STEPS, VALUE = 0.5, 3, 100.0
FLAGS = ("done", "terminated", "truncated")


def episodes(num_frames=8, end=3, terminated=True):
    """One environment with reward 1; an episode ends with the frame ``end``, counted from 0."""
    data = make_data(1, num_frames)
    data["next", "reward"].fill_(1.0)
    data["next", "truncated"] = torch.zeros(1, num_frames, 1, dtype=torch.bool)
    for flag in ("done", "terminated" if terminated else "truncated"):
        data["next", flag][:, end] = True
    data["frame"] = torch.arange(num_frames).view(1, -1, 1)
    data["next", "frame"] = data["frame"] + 1
    return data


def by_postproc(data, wrap=with_last_flags):
    return wrap(MultiStep(gamma=GAMMA, n_steps=STEPS))(data).reshape(-1)


def by_transform(data, wrap=with_last_flags):
    """The rows of a replay buffer, filled in two pieces that cut the episode."""
    transform = wrap(MultiStepTransform(n_steps=STEPS, gamma=GAMMA))
    storage = LazyTensorStorage(100, ndim=2)
    buffer = TensorDictReplayBuffer(storage=storage, transform=transform, batch_size=1)
    cut = data.shape[1] // 2 + 1
    for piece in (data[:, :cut], data[:, cut:]):
        buffer.extend(piece)
    return buffer[:].reshape(-1)


def targets(data):
    """The TD target of each row: ``td_error`` where every online value is 0."""
    loss = make_loss(reward_scale=1.0)
    loss.make_value_estimator(gamma=GAMMA)
    set_constant(loss, online=0.0, target=VALUE)
    loss.qvalue_loss(data)
    return data["td_error"].tolist()


@pytest.mark.parametrize("way", [by_postproc, by_transform])
def test_rows_before_a_terminal_state_do_not_bootstrap(way):
    # Row 0: 1 + 1/2 + 1/4 + 100/8. Rows 1 to 3 end with the episode: 1.75, 1.5 and 1.
    expected = [14.25, 1.75, 1.5, 1.0, 14.25]
    assert targets(way(episodes()))[:5] == pytest.approx(expected)
    # What TorchRL does by itself, and why this is needed:
    wrong = [14.25, 14.25, 26.5, 1.0, 14.25]
    assert targets(way(episodes(), wrap=lambda steps: steps))[:5] == pytest.approx(wrong)


@pytest.mark.parametrize("way", [by_postproc, by_transform])
def test_rows_before_a_truncated_one_bootstrap_from_its_end(way):
    expected = [14.25, 1.75 + VALUE / 8, 1.5 + VALUE / 4, 1 + VALUE / 2]
    assert targets(way(episodes(terminated=False)))[:4] == pytest.approx(expected)


@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("way", [by_postproc, by_transform])
def test_rows_take_all_flags_of_the_last_row_of_their_window(way, terminated):
    given = episodes(20, end=7, terminated=terminated)
    data = way(given.clone())
    last = data["frame"] + data["steps_to_next_obs"].view(-1, 1) - 1
    assert torch.equal(data["next", "frame"], last + 1)
    for flag in FLAGS:
        assert torch.equal(data["next", flag], given["next", flag][0][last.view(-1)])
    assert data["next", "done"].sum() == STEPS


def test_one_step_returns_are_left_as_they_were():
    data = episodes()
    one = with_last_flags(MultiStep(gamma=GAMMA, n_steps=1))(data.clone())
    for key in ("reward", *FLAGS):
        assert torch.equal(one["next", key], data["next", key])
