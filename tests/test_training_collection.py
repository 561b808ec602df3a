"""Episode sums and NaN checks of what was collected."""

from __future__ import annotations

import pytest
import torch

from recipe_cases import collected
from torchrl_aca.errors import RunError
from torchrl_aca.training.collection import EpisodeTracker, check_finite


def test_episode_tracker_sums_per_environment_and_restores():
    tracker, other = EpisodeTracker(2), EpisodeTracker(2)
    data = collected(num_envs=2, steps=4)
    data["next", "reward"] = torch.tensor([[1.0, 1, 1, 1], [2, 2, 2, 2]]).unsqueeze(-1)
    data["next", "done"][0, 1] = True
    tracker.add(data)
    assert tracker.metrics() == {
        "train_episodes": 1.0,
        "train_return": 2.0,
        "train_episode_length": 2.0,
    }
    other.load_state_dict(tracker.state_dict())
    data["next", "done"][:, 3] = True
    for each in (tracker, other):
        each.add(data)
    assert tracker.metrics() == other.metrics()
    assert list(tracker.latest) == [(2.0, 2), (4.0, 4), (2.0, 2), (16.0, 8)]


@pytest.mark.parametrize("key", ["action", ("next", "reward"), ("next", "observation")])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_check_finite_names_frames_and_key(key, value):
    data = collected()
    check_finite(data, 10)
    data[key][2, 0, 0] = value
    name = key if isinstance(key, str) else ".".join(key)
    with pytest.raises(RunError, match=f"{name}.*after 10 frames"):
        check_finite(data, 10)
