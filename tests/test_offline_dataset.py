"""Offline data on disk: what is written is what is read, and half or wrong data never load."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import OfflineToOnlineReplayBuffer
from torchrl.data.datasets import load_dataset

from offline_cases import ACTION_DIM, OBSERVATION_DIM, episode, joined, write
from torchrl_aca.offline import (
    DatasetError,
    DatasetWriter,
    OfflineDataset,
    register_datasets,
    returns_to_go,
)

EPISODES = [episode(4), episode(1, "terminated"), episode(6, "terminated", seed=1)]
STARTS, SIZE = [0, 4, 5], 11


@pytest.fixture
def dataset(tmp_path: Path) -> OfflineDataset:
    return write(tmp_path / "data", EPISODES)


# --- writing and loading --------------------------------------------------------------------------


def test_rows_come_back_in_float32_under_exactly_the_canonical_keys(dataset):
    expected = {
        "observation": joined(EPISODES, "observation"),
        "action": joined(EPISODES, "action"),
        ("next", "observation"): joined(EPISODES, "next_observation"),
        ("next", "reward"): joined(EPISODES, "reward")[:, None],
        ("next", "terminated"): joined(EPISODES, "terminated")[:, None],
        ("next", "truncated"): joined(EPISODES, "truncated")[:, None],
        ("next", "done"): np.isin(np.arange(SIZE), [3, 4, 10])[:, None],
        "episode": np.repeat([0, 1, 2], [4, 1, 6]),
    }
    assert set(dataset.data.keys(True, True)) == expected.keys()
    for key, values in expected.items():
        stored = dataset.data[key].numpy()
        wanted = values.astype(np.float32) if values.dtype == np.float64 else values
        assert stored.dtype == wanted.dtype
        np.testing.assert_array_equal(stored, wanted, err_msg=str(key))


def test_tensordict_alone_can_read_the_directory(dataset):
    assert (TensorDict.load_memmap(dataset.path) == dataset.data).all()


def test_metadata_describe_the_data(dataset):
    returns = np.array([e["reward"].astype(np.float32).sum(dtype=np.float64) for e in EPISODES])
    metadata = json.loads((dataset.path / "metadata.json").read_text())
    assert metadata == dataset.metadata
    assert metadata["transitions"] == SIZE and metadata["episodes"] == 3
    statistics = {"mean": returns.mean(), "std": returns.std(), "min": returns.min()}
    assert metadata["returns"] == pytest.approx({**statistics, "max": returns.max()})
    assert metadata["lengths"] == pytest.approx(
        {"mean": 11 / 3, "std": np.std([4, 1, 6]), "min": 1, "max": 6}
    )
    np.testing.assert_allclose(dataset.episode_returns(), returns)


def test_an_episode_cut_by_the_recording_is_stored_but_does_not_count(tmp_path):
    cut = {**episode(5, seed=2), "complete": False}
    dataset = write(tmp_path / "data", [*EPISODES, cut])
    assert dataset.metadata["incomplete_episodes"] == [3]
    assert dataset.metadata["episodes"] == 4 and len(dataset.data) == SIZE + 5
    whole = [e["reward"].sum() for e in EPISODES]
    assert dataset.metadata["returns"]["mean"] == pytest.approx(np.mean(whole))
    assert dataset.metadata["lengths"]["max"] == 6


def test_provenance_of_any_type_is_kept(tmp_path):
    with DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer:
        writer.add_episode(**EPISODES[0])
        facts = {"seed": 3, "file": Path("a/b"), "versions": {"python": "3"}}
        dataset = writer.finish(name="test", provenance=facts)
    assert dataset.metadata["provenance"] == {**facts, "file": "a/b"}


def test_changing_rows_in_memory_leaves_the_files_alone(dataset):
    dataset.data["observation"].zero_()
    again = OfflineDataset.load(dataset.path, verify=True)
    assert again.data["observation"].abs().sum() > 0


def test_actions_can_be_clipped_inside_their_bounds(tmp_path):
    edge = episode(3)
    edge["action"] = np.array([[-1.0, 4.0], [1.0, 0.0], [0.5, 3.0]])
    path = write(tmp_path / "data", [edge], action_bounds=([-1, 0], [1, 4])).path
    clipped = OfflineDataset.load(path, clip_actions=1e-3).data["action"]
    expected = [[-0.999, 3.998], [0.999, 0.002], [0.5, 3.0]]
    torch.testing.assert_close(clipped, torch.tensor(expected))
    stored = OfflineDataset.load(path, verify=True).data["action"]
    np.testing.assert_array_equal(stored, edge["action"])


# --- complete or not at all -----------------------------------------------------------------------


def test_an_error_while_writing_leaves_nothing(tmp_path):
    with (
        pytest.raises(KeyboardInterrupt),
        DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer,
    ):
        writer.add_episode(**EPISODES[0])
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_nothing(tmp_path):
    def fail():
        raise OSError(28, "No space left on device")

    with (
        pytest.raises(OSError, match="No space left"),
        DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer,
    ):
        writer._open.callback(fail)  # where rows that were held back are written
    assert not list(tmp_path.iterdir())


def test_what_a_killed_writer_left_does_not_load_and_is_replaced(tmp_path):
    path = tmp_path / "data"
    killed = DatasetWriter(path, OBSERVATION_DIM, ACTION_DIM)
    killed.__enter__()
    killed.add_episode(**EPISODES[0])
    (left,) = tmp_path.iterdir()
    for half in (path, left):
        with pytest.raises(DatasetError, match="never finished|no metadata.json"):
            OfflineDataset.load(half)
    assert len(write(path, EPISODES).data) == SIZE
    assert list(tmp_path.iterdir()) == [path]


def test_of_two_writers_with_one_path_the_second_one_finishes(tmp_path):
    first, second = (DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) for _ in "12")
    with pytest.raises(DatasetError, match="another one has begun to write"), first:
        second.__enter__()  # while the first one is at work
        first.add_episode(**EPISODES[0])
        first.finish(name="first")
    for each in EPISODES:
        second.add_episode(**each)
    dataset = second.finish(name="second")
    second.__exit__(None, None, None)
    assert dataset.metadata["name"] == "second" and len(dataset.data) == SIZE
    assert list(tmp_path.iterdir()) == [dataset.path]
    assert not (dataset.path / "owner").exists()


def test_a_path_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").touch()
    writer = DatasetWriter(tmp_path / "file" / "data", OBSERVATION_DIM, ACTION_DIM)
    with pytest.raises(DatasetError, match="file/data cannot be made: .*Choose another path"):
        writer.__enter__()


def test_a_directory_of_another_program_is_left_alone(tmp_path):
    (tmp_path / "data.partial").mkdir()
    (tmp_path / "data.partial" / "thesis.txt").write_text("years")
    with pytest.raises(
        DatasetError, match=r"data.partial is in the way, and no writer has made it"
    ):
        write(tmp_path / "data", EPISODES)
    assert (tmp_path / "data.partial" / "thesis.txt").read_text() == "years"


def test_a_path_that_was_taken_meanwhile_is_told_and_nothing_is_kept(tmp_path):
    path = tmp_path / "data"
    with (
        pytest.raises(DatasetError, match="data cannot be made .*nothing was kept"),
        DatasetWriter(path, OBSERVATION_DIM, ACTION_DIM) as writer,
    ):
        for each in EPISODES:
            writer.add_episode(**each)
        path.mkdir()
        (path / "thesis.txt").write_text("years")
        writer.finish(name="test")
    assert [left.name for left in tmp_path.iterdir()] == ["data"]
    assert [left.name for left in path.iterdir()] == ["thesis.txt"]


def test_a_writer_writes_one_data_set(tmp_path):
    writer = DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM)
    with pytest.raises(KeyError), writer:
        writer.add_episode(**EPISODES[0])
        raise KeyError
    with pytest.raises(DatasetError, match="one data set"):
        writer.__enter__()
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_lost_rows_on_the_way_is_found(tmp_path):
    with (
        pytest.raises(DatasetError, match=r"reward.memmap has \d+ bytes; expected"),
        DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer,
    ):
        for each in EPISODES:
            writer.add_episode(**each)
        file = writer._files["next", "reward"]
        file.flush()
        file.truncate(4)
        writer.finish(name="test")
    assert list(tmp_path.iterdir()) == []


def test_sizes_may_be_numpy_integers(tmp_path):
    sizes = np.int64(OBSERVATION_DIM), np.int64(ACTION_DIM)
    with DatasetWriter(tmp_path / "data", *sizes) as writer:
        for each in EPISODES:
            writer.add_episode(**each)
        dataset = writer.finish(name="test")
    assert dataset.metadata["observation_dim"] == OBSERVATION_DIM


def test_forgetting_finish_is_an_error(tmp_path):
    with (
        pytest.raises(DatasetError, match="finish"),
        DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer,
    ):
        writer.add_episode(**EPISODES[0])
    assert list(tmp_path.iterdir()) == []


def test_forgetting_with_is_an_error(tmp_path):
    with pytest.raises(DatasetError, match="with DatasetWriter"):
        DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM).add_episode(**EPISODES[0])


def test_a_finished_data_set_is_neither_overwritten_nor_extended(tmp_path):
    with DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer:
        writer.add_episode(**EPISODES[0])
        writer.finish(name="test")
        with pytest.raises(ValueError, match="closed"):
            writer.add_episode(**EPISODES[0])
    with pytest.raises(DatasetError, match="exists already"):
        DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM)
    assert len(OfflineDataset.load(tmp_path / "data", verify=True).data) == 4


# --- checks before it is finished -----------------------------------------------------------------


def changed(name: str, index: object, value: object) -> dict[str, np.ndarray]:
    """An episode of five steps with one thing changed."""
    case = episode(5)
    case[name][index] = value
    return case


@pytest.mark.parametrize(
    ("case", "message"),
    [
        (changed("reward", 2, np.nan), r"episode 1 .*next.reward is nan at step 2"),
        (changed("observation", (1, 2), np.inf), r"observation is inf at step 1, column 2"),
        (changed("next_observation", (4, 0), 1e39), r"next.observation is inf at step 4"),
        (changed("action", (3, 1), 1.5), r"action is 1.5 at step 3, column 1.*\[-1.0, 1.0\]"),
        (changed("truncated", 4, False), r"expected the last step, 4, .*got ends at \[\]"),
        (changed("terminated", 1, True), r"got ends at \[1, 4\]"),
        ({**episode(5), "action": np.zeros((5, 3))}, r"action has shape \(5, 3\); .*\(5, 2\)"),
        ({**episode(5), "reward": np.zeros((5, 1))}, r"reward has shape \(5, 1\); .*\(5,\)"),
        ({**episode(5), "reward": np.zeros(4)}, r"reward has shape \(4,\); expected \(5,\)"),
        ({**episode(5), "terminated": np.zeros(5)}, r"terminated has dtype .*expected booleans"),
        ({name: values[:0] for name, values in episode(5).items()}, "not empty"),
    ],
)
def test_a_wrong_episode_is_refused_at_once(tmp_path, case, message):
    with DatasetWriter(tmp_path / "data", OBSERVATION_DIM, ACTION_DIM) as writer:
        writer.add_episode(**EPISODES[0])
        with pytest.raises(DatasetError, match=message):
            writer.add_episode(**case)
        assert len(writer.finish(name="test").data) == 4, "the wrong episode was stored"


def with_constant(name: str, columns: object) -> list[dict[str, np.ndarray]]:
    episodes = [episode(4), episode(5)]
    for each in episodes:
        each[name][..., columns] = 0.25
        if name == "observation":
            each["next_observation"][..., columns] = 0.25
    return episodes


@pytest.mark.parametrize("name", ["observation", "action", "reward"])
def test_columns_that_never_vary_are_refused_unless_allowed(tmp_path, name):
    column = slice(None) if name == "reward" else 1
    episodes = with_constant(name, column)
    listed = [0] if name == "reward" else [1]
    with pytest.raises(DatasetError) as error:
        write(tmp_path / "data", episodes)
    assert f"{name}: columns {listed}" in str(error.value) and "allow_constant" in str(error.value)
    assert list(tmp_path.iterdir()) == []
    dataset = write(tmp_path / "data", episodes, allow_constant=(name,))
    assert dataset.metadata["constant_columns"] == {name: listed}


@pytest.mark.parametrize("name", ["observation", "action"])
def test_a_vector_of_which_nothing_varies_is_always_refused(tmp_path, name):
    with pytest.raises(DatasetError, match=f"Nothing of {name} varies"):
        write(tmp_path / "data", with_constant(name, slice(None)), allow_constant=(name,))


def test_a_column_that_varies_between_episodes_alone_is_fine(tmp_path):
    first, second = with_constant("observation", 0)
    second["observation"][:, 0] = second["next_observation"][:, 0] = 0.5
    assert write(tmp_path / "data", [first, second]).metadata["constant_columns"] == {}


def test_rows_that_do_not_follow_each_other_are_refused_unless_allowed(tmp_path):
    jumping = episode(6)
    jumping["next_observation"][2, 1] += 0.5
    jumping["next_observation"][5, 0] += 0.5  # the last one: nothing follows it
    episodes = [EPISODES[0], jumping]
    message = r"1 of 8 transitions .*\(12 %\).* first is row 6 \(step 2 of episode 1\), off by 0.5"
    with pytest.raises(DatasetError, match=message):
        write(tmp_path / "data", episodes)
    assert write(tmp_path / "data", episodes, check_continuity=False).metadata["jumps"] == 1


@pytest.mark.parametrize("wrong", ["zeros", "the first observation of the episode after it"])
def test_time_limits_that_lead_nowhere_are_refused_unless_allowed(tmp_path, wrong):
    episodes = [episode(4, seed=n) for n in range(3)]
    for number, each in enumerate(episodes):
        following = episodes[(number + 1) % 3]["observation"][0]
        each["next_observation"][-1] = 0 if wrong == "zeros" else following
    with pytest.raises(DatasetError, match=f"at every time limit next.observation is {wrong}"):
        write(tmp_path / "data", episodes)
    write(tmp_path / "data", episodes, check_continuity=False)
    # One right time limit tells that the recorder reads what was reached.
    episodes[0]["next_observation"][-1] = 0.5
    write(tmp_path / "right", episodes)


def test_terminal_states_and_cut_recordings_may_lead_anywhere(tmp_path):
    episodes = [episode(4, "terminated", seed=n) for n in range(2)]
    for each in episodes:
        each["next_observation"][-1] = 0
    cut = {**episode(3, seed=5), "complete": False}
    cut["next_observation"][-1] = 0
    data = write(tmp_path / "data", [*episodes, cut]).data
    ends = [3, 7, 10]  # of 4, 4 and 3 rows
    assert (data["next", "observation"][ends] == 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"allow_constant": "observation"}, "expected a collection"),
        ({"allow_constant": ("obs",)}, "expected a collection of some of"),
        ({"action_bounds": (1, -1)}, "low < high"),
        ({"action_bounds": (-np.inf, np.inf)}, "finite"),
        ({"action_bounds": ([-1] * 3, [1] * 3)}, "two lists of 2 numbers"),
        ({"action_bounds": 2}, r"action_bounds=2: expected \(low, high\)"),
        ({"action_bounds": [1]}, r"action_bounds=\[1\]: expected \(low, high\)"),
        ({"allow_constant": None}, "allow_constant=None: expected a collection"),
        ({"observation_dim": 0}, "observation_dim=0: expected an integer of at least 1"),
        ({"action_dim": 2.5}, "action_dim=2.5: expected an integer"),
    ],
)
def test_senseless_options_are_refused_before_any_file_is_made(tmp_path, options, message):
    sizes = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM}
    with pytest.raises(DatasetError, match=message):
        DatasetWriter(tmp_path / "data", **{**sizes, **options})
    assert list(tmp_path.iterdir()) == []


def test_no_episode_is_no_data_set(tmp_path):
    with pytest.raises(DatasetError, match="no episode"):
        write(tmp_path / "data", [])


# --- damaged and foreign directories --------------------------------------------------------------


def test_foreign_directories_are_told_apart(tmp_path, dataset):
    with pytest.raises(DatasetError, match="found nothing"):
        OfflineDataset.load(tmp_path / "none")
    with pytest.raises(DatasetError, match="no data set of torchrl_aca"):
        OfflineDataset.load(tmp_path)
    metadata = dataset.path / "metadata.json"
    metadata.write_text(json.dumps({**dataset.metadata, "format": "torchrl-aca dataset 99"}))
    with pytest.raises(DatasetError, match="dataset 99.*expected 'torchrl-aca dataset 1'"):
        OfflineDataset.load(dataset.path)
    metadata.write_text("[]")
    with pytest.raises(DatasetError, match="has format None"):
        OfflineDataset.load(dataset.path)
    metadata.write_text('{"format": ')
    with pytest.raises(DatasetError, match="damaged"):
        OfflineDataset.load(dataset.path)


def test_a_file_of_another_size_is_found_without_verify(dataset):
    file = dataset.path / "next" / "observation.memmap"
    os.truncate(file, 100)
    with pytest.raises(DatasetError, match=r"observation.memmap has 100 bytes; expected 132"):
        OfflineDataset.load(dataset.path)
    assert file.stat().st_size == 100, "loading must not repair sizes with zeros"
    file.unlink()
    with pytest.raises(DatasetError, match="is missing"):
        OfflineDataset.load(dataset.path)


@pytest.mark.parametrize("name", ["observation", "episode", "next/reward", "next/terminated"])
def test_verify_finds_a_changed_byte(dataset, name):
    file = dataset.path / f"{name}.memmap"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    OfflineDataset.load(dataset.path)
    with pytest.raises(DatasetError, match=f"{name}.memmap has SHA-256"):
        OfflineDataset.load(dataset.path, verify=True)


# --- returns --------------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
def test_returns_to_go_are_the_discounted_sums_of_each_episode(dataset, gamma):
    expected = []
    for each in EPISODES:
        rewards = each["reward"].astype(np.float32).astype(np.float64)
        for t in range(len(rewards)):
            weights = gamma ** np.arange(len(rewards) - t)
            expected.append([float(weights @ rewards[t:])])
    values = returns_to_go(dataset.data, gamma)
    assert values.dtype == torch.float32
    np.testing.assert_allclose(values, expected, rtol=1e-6)


def test_returns_to_go_do_not_lose_digits_over_long_episodes():
    reward = torch.full((100_000, 1), 0.1)
    data = TensorDict(
        {"next": {"reward": reward, "done": torch.zeros(100_000, 1).bool()}}, [100_000]
    )
    assert returns_to_go(data, 1.0)[0].item() == pytest.approx(100_000 * float(reward[0]), rel=1e-7)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan")])
def test_returns_to_go_refuse_other_discounts(dataset, gamma):
    with pytest.raises(ValueError, match=r"gamma in \[0, 1\]"):
        returns_to_go(dataset.data, gamma)


def test_normalised_score_is_linear_between_the_references(dataset, tmp_path):
    assert [dataset.normalized_score(r) for r in (-2, 0, 6, 8)] == [0, 25, 100, 125]
    assert dataset.normalized_score(torch.tensor([0.0, 6.0])).tolist() == [25, 100]
    with DatasetWriter(tmp_path / "other", OBSERVATION_DIM, ACTION_DIM) as writer:
        writer.add_episode(**EPISODES[0])
        with pytest.raises(DatasetError, match="low < high"):
            writer.finish(name="other", reference_scores=(6, -2))
        other = writer.finish(name="other")
    with pytest.raises(DatasetError, match="no reference scores"):
        other.normalized_score(1.0)


# --- replay ---------------------------------------------------------------------------------------


def test_samples_are_whole_rows_drawn_uniformly_with_replacement(dataset):
    torch.manual_seed(0)
    sample = dataset.replay_buffer(batch_size=11_000).sample()
    assert set(sample.keys(True, True)) == set(dataset.data.keys(True, True))
    drawn = (sample["observation"][:, None] == dataset.data["observation"]).all(-1).int().argmax(-1)
    assert (sample == dataset.data[drawn]).all()
    # 1000 draws of each row are expected; 150 are about five standard deviations.
    assert (torch.bincount(drawn, minlength=SIZE) - 1000).abs().max() < 150


def test_the_buffer_of_a_data_set_cannot_be_extended(dataset):
    buffer = dataset.replay_buffer(batch_size=2)
    with pytest.raises(RuntimeError):
        buffer.extend(dataset.data[:2].clone())
    assert len(buffer) == SIZE


def test_torchrl_finds_data_sets_by_name(dataset):
    register_datasets()
    register_datasets()
    root = dataset.path.parent
    buffer = load_dataset("aca:data", batch_size=7, root=root, clip_actions=0.5, verify=True)
    sample = buffer.sample()
    assert sample.shape == (7,) and sample["action"].abs().max() <= 0.5
    with pytest.raises(DatasetError, match="missing"):
        load_dataset("aca:missing", batch_size=7, root=root)


def test_torchrl_mixes_them_with_online_data(dataset):
    register_datasets()
    mixed = OfflineToOnlineReplayBuffer(
        "aca:data", root=dataset.path.parent, online_capacity=20, batch_size=10
    )
    online = dataset.data[:5].clone()
    online["observation"] += 100
    mixed.extend(online)
    sample = mixed.sample()
    assert (sample["observation"][:, 0] > 50).sum() == 5 and sample.shape == (10,)
