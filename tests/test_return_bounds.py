"""Cal-QL's lower bounds against a hand loop, and rows that wait for the end of their episode."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_aca.offline import DatasetError, return_bounds
from torchrl_aca.replay import FinishedEpisodes

GAMMA, HORIZON = 0.9, 3
# (length, how it ended): three whole episodes and one that the recording cut.
EPISODES = [(6, "limit"), (4, "terminal"), (2, "limit"), (5, "limit"), (3, "recording")]


def rows_of(episodes=EPISODES, seed=0, observation_dim=2) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    num = sum(length for length, _ in episodes)
    done = torch.zeros(num, 1, dtype=torch.bool)
    terminated, episode, last = done.clone(), torch.zeros(num, dtype=torch.int64), -1
    for number, (length, end) in enumerate(episodes):
        episode[last + 1 : last + 1 + length] = number
        last += length
        done[last], terminated[last] = end != "recording", end == "terminal"
    states = torch.randn(num + 1, observation_dim, generator=generator)
    following = {
        "observation": states[1:],
        "reward": torch.randn(num, 1, generator=generator),
        "done": done,
        "terminated": terminated,
    }
    rows = {"observation": states[:-1], "action": torch.zeros(num, 1), "episode": episode}
    return TensorDict({**rows, "next": following}, batch_size=[num])


def by_hand(data, tail):
    rewards, bounds, start = data["next", "reward"].flatten().tolist(), [], 0
    for length, end in EPISODES:
        for step in range(length):
            rest = rewards[start + step : start + length]
            value = sum(GAMMA**k * reward for k, reward in enumerate(rest))
            if end != "terminal" and tail == "bootstrap_rate":
                value += GAMMA ** len(rest) * rest[-1] / (1 - GAMMA)
            if end != "terminal" and tail == "mask" and len(rest) <= HORIZON:
                value = -math.inf
            bounds.append(value)
        start += length
    return torch.tensor(bounds).unsqueeze(-1)


@pytest.mark.parametrize("tail", ["truncate", "mask", "bootstrap_rate"])
def test_bounds_equal_a_hand_loop_across_the_ends_of_episodes(tail):
    data = rows_of()
    before = data.clone()
    bounds = return_bounds(data, GAMMA, tail=tail, horizon=HORIZON)
    assert bounds.shape == (20, 1) and bounds.dtype == torch.float32
    torch.testing.assert_close(bounds, by_hand(data, tail))
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()


def test_a_recording_that_breaks_off_in_the_middle_ends_its_episode():
    """As in a data set whose fifth of six episodes is incomplete: only `episode` tells."""
    data = torch.cat([rows_of(), rows_of()])
    data["episode"][20:] += len(EPISODES)
    expected = return_bounds(rows_of(), GAMMA)
    torch.testing.assert_close(return_bounds(data, GAMMA), torch.cat([expected, expected]))


def test_data_without_the_end_of_an_episode_are_told():
    with pytest.raises(DatasetError, match="none of 7 rows ends an episode.*time limits"):
        return_bounds(rows_of([(7, "recording")]), GAMMA)
    with pytest.raises(ValueError, match="needs gamma below 1"):
        return_bounds(rows_of(), 1.0, tail="bootstrap_rate")


# --- waiting for the end --------------------------------------------------------------------------


def label(rows):
    return rows.set("mc_return", return_bounds(rows, GAMMA))


def collected(steps_per_call):
    """Two environments with episodes of other lengths, in pieces, as a collector gives them."""
    envs = [rows_of(seed=1)[:17], rows_of(EPISODES[::-1][1:], seed=2)]
    return torch.stack([env.exclude("episode") for env in envs]).split(steps_per_call, 1), envs


@pytest.mark.parametrize("steps_per_call", [1, 3, 17])
def test_only_finished_episodes_come_out_whole_and_labelled(steps_per_call):
    pieces, envs = collected(steps_per_call)
    finished = FinishedEpisodes(label)
    out, seen = [], 0
    for piece in pieces:
        seen += piece.shape[1]
        out.append(finished(piece))
        done = torch.cat([env["next", "done"][:seen] for env in envs])
        lasts = [env["next", "done"][:seen].nonzero()[:, 0] for env in envs]
        assert sum(map(len, out)) == sum(int(last[-1]) + 1 for last in lasts if len(last))
        assert sum(int(rows["next", "done"].sum()) for rows in out if len(rows)) == done.sum()
    rows = torch.cat([part for part in out if len(part)])
    expected = torch.cat([label(env.exclude("episode")) for env in envs])

    def in_order(data):
        return data[data["observation"][:, 0].argsort()].select("observation", "mc_return")

    torch.testing.assert_close(in_order(rows), in_order(expected))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"tail": "masked"}, "Expected tail to be one of .*'mask'.*got 'masked'"),
        ({"tail": "mask", "horizon": 0}, "Expected horizon >= 1, got horizon=0"),
    ],
)
def test_a_wrong_setting_is_told(setting, message):
    with pytest.raises(ValueError, match=message):
        return_bounds(rows_of(), GAMMA, **setting)


def test_bounds_are_made_where_the_data_are():
    data = rows_of()
    expected = return_bounds(data, GAMMA, tail="mask", horizon=2)
    with torch.device("meta"):  # where a tensor that does not ask would go
        bounds = return_bounds(data, GAMMA, tail="mask", horizon=2)
    assert torch.equal(bounds, expected)


def test_what_waits_is_saved_and_restored():
    pieces, _ = collected(1)
    whole, restored = FinishedEpisodes(label), FinishedEpisodes(label)
    for piece in pieces[:9]:
        whole(piece)
    restored.load_state_dict(whole.state_dict())
    for piece in pieces[9:]:
        expected, rows = whole(piece), restored(piece)
        assert len(rows) == len(expected)
        if len(rows):
            assert (rows == expected).all()
    assert whole.state_dict() == {"pending": {}}  # every episode has ended


def test_an_episode_that_was_broken_off_is_dropped():
    finished = FinishedEpisodes(label)
    first, second = rows_of([(4, "recording")], seed=3), rows_of([(3, "limit")], seed=4)
    assert len(finished(first.exclude("episode").unsqueeze(0))) == 0
    rows = finished(second.exclude("episode").unsqueeze(0))
    assert torch.equal(rows["observation"], second["observation"])
