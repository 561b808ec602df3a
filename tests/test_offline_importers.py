"""Imports of D4RL's and Minari's data sets, from small files written in their own layout."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data.describe import summary
from import_dataset import import_dataset
from offline_cases import ACTION_DIM, OBSERVATION_DIM, episode, joined
from recipe_cases import composed
from torchrl_aca.errors import RunError
from torchrl_aca.offline import (
    DatasetError,
    DatasetWriter,
    OfflineDataset,
    from_d4rl,
    import_d4rl,
    import_minari,
)

h5py = pytest.importorskip("h5py")
minari = pytest.importorskip("minari")
spaces = pytest.importorskip("gymnasium").spaces

# Ends by the time limit, by a terminal, by the time limit after one step, and by the file's end.
EPISODES = [episode(4), episode(5, "terminated"), episode(1), episode(3, "none")]
NAMES = {
    "observations": "observation",
    "actions": "action",
    "next_observations": "next_observation",
    "rewards": "reward",
    "terminals": "terminated",
    "timeouts": "truncated",
}


def write_d4rl(path: Path, episodes=EPISODES, *, without=(), **replaced) -> Path:
    """A file in D4RL's layout, in float32 and compressed, with infos that nobody reads."""
    arrays = {name: joined(episodes, key) for name, key in NAMES.items()} | replaced
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if name not in without:
                dtype = "f4" if np.asarray(array).dtype == np.float64 else None
                file.create_dataset(name, data=array, dtype=dtype, compression="gzip")
        file["infos/qpos"] = np.zeros((2, 9))
        file["metadata/algorithm"] = "SAC"
    return path


@pytest.mark.parametrize(("module", "importer"), [("h5py", import_d4rl), ("minari", import_minari)])
def test_a_missing_extra_is_told(module, importer, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DatasetError, match=rf"needs {module}: pip install 'torchrl-aca\[offline"):
        importer(tmp_path / "source", tmp_path / "here")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_d4rl(tmp_path / "halfcheetah_test-v2.hdf5")


def assert_rows(dataset: OfflineDataset, expected: dict[str, np.ndarray]) -> None:
    data = dataset.data
    stored = {
        "observation": data["observation"],
        "action": data["action"],
        "next_observation": data["next", "observation"],
        "reward": data["next", "reward"].squeeze(-1),
        "terminated": data["next", "terminated"].squeeze(-1),
        "truncated": data["next", "truncated"].squeeze(-1),
    }
    for name, values in stored.items():
        wanted = expected[name]
        wanted = wanted.astype(np.float32) if wanted.dtype == np.float64 else wanted
        np.testing.assert_array_equal(values, wanted, err_msg=name)
    np.testing.assert_array_equal(data["episode"], expected["episode"])


# --- D4RL -----------------------------------------------------------------------------------------


def test_d4rl_with_next_observations_keeps_every_row(source, tmp_path):
    dataset = import_d4rl(source, tmp_path / "data", env_id="HalfCheetah-v2", progress=False)
    expected = {name: joined(EPISODES, name) for name in NAMES.values()}
    expected["truncated"][-1] = True  # the recording ended here
    expected["episode"] = np.repeat([0, 1, 2, 3], [4, 5, 1, 3])
    assert_rows(dataset, expected)
    assert dataset.metadata["incomplete_episodes"] == [3]
    assert dataset.metadata["name"] == "halfcheetah_test-v2"
    assert dataset.metadata["env_id"] == "HalfCheetah-v2"
    provenance = dataset.metadata["provenance"]
    assert provenance["source"] == source.name and provenance["dropped_rows"] == 0
    assert len(provenance["source_sha256"]) == 64
    assert dataset.normalized_score(12135.0) == 100
    assert dataset.normalized_score(4770.3) == pytest.approx(40.68, abs=0.01)


def test_d4rl_without_next_observations_drops_rows_whose_next_one_is_needed(tmp_path):
    source = write_d4rl(tmp_path / "x.hdf5", without=["next_observations"])
    dataset = import_d4rl(source, tmp_path / "data", progress=False)
    # Of the first episode 3 of 4 rows are left, all 5 of the second, none of the third, 2 of 3 of
    # the last. A terminal row's own observation stands in for the next one, which is not used.
    first, second, _, last = EPISODES
    kept = [{k: v[:3] for k, v in first.items()}, second, {k: v[:2] for k, v in last.items()}]
    expected = {name: joined(kept, name).copy() for name in NAMES.values()}
    expected["next_observation"][7] = second["observation"][-1]
    expected["truncated"][:] = np.isin(np.arange(10), [2, 9])
    expected["episode"] = np.repeat([0, 1, 2], [3, 5, 2])
    assert_rows(dataset, expected)
    assert dataset.metadata["incomplete_episodes"] == [2]
    assert dataset.metadata["provenance"]["dropped_rows"] == 3


@pytest.mark.parametrize("without", [[], ["next_observations"]])
@pytest.mark.parametrize("block", [1, 6, 7])
def test_the_size_of_a_block_does_not_matter(tmp_path, monkeypatch, without, block):
    source = write_d4rl(tmp_path / "x.hdf5", without=without)
    whole = import_d4rl(source, tmp_path / "whole", progress=False)
    monkeypatch.setattr(from_d4rl, "BLOCK", block)
    pieces = import_d4rl(source, tmp_path / "pieces", progress=False)
    assert (whole.data == pieces.data).all() and len(whole.data) == len(pieces.data)


def test_flags_may_be_numbers_as_some_files_have_them(source, tmp_path):
    numbers = {
        name: joined(EPISODES, NAMES[name]).astype("u1") for name in ("terminals", "timeouts")
    }
    other = write_d4rl(tmp_path / "numbers.hdf5", **numbers)
    first = import_d4rl(source, tmp_path / "first", progress=False)
    assert (import_d4rl(other, tmp_path / "other", progress=False).data == first.data).all()


def test_the_byte_order_of_a_file_does_not_matter(source, tmp_path):
    swapped = {name: joined(EPISODES, NAMES[name]).astype(">f4") for name in ("actions", "rewards")}
    other = write_d4rl(tmp_path / "swapped.hdf5", **swapped)
    first = import_d4rl(source, tmp_path / "first", progress=False)
    assert (import_d4rl(other, tmp_path / "other", progress=False).data == first.data).all()


def test_other_reference_scores_and_other_bounds_can_be_given(source, tmp_path):
    options = {"reference_scores": (0, 10), "action_bounds": (-2, 2), "progress": False}
    dataset = import_d4rl(source, tmp_path / "data", env_id="HalfCheetah-v2", **options)
    assert dataset.normalized_score(5) == 50
    assert dataset.metadata["action_bounds"] == {"low": [-2, -2], "high": [2, 2]}
    unknown = import_d4rl(source, tmp_path / "unknown", env_id="Mine-v0", progress=False)
    assert unknown.metadata["reference_scores"] is None


ROWS = len(joined(EPISODES, "reward"))


def shifted() -> np.ndarray:
    """Next observations as a recorder has them that reads the next row, whatever begins there."""
    observations = joined(EPISODES, "observation")
    return np.concatenate([observations[1:], observations[-1:]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"without": ["timeouts", "actions"]}, r"has no \['actions', 'timeouts'\].*found"),
        ({"rewards": np.zeros(ROWS - 1)}, "equal length"),
        ({"next_observations": np.zeros((ROWS, 2))}, "equal shape"),
        ({"rewards": np.zeros((ROWS, 1))}, r"'rewards' is .*expected .*\(rows,\)"),
        ({"observations": np.zeros(ROWS)}, r"'observations' is .*expected .*\(rows, columns\)"),
        ({"actions": np.full((ROWS, 2), b"left")}, "'actions' is .*array of numbers"),
        ({"terminals": np.zeros(ROWS, bool), "timeouts": np.zeros(ROWS, bool)}, "none of its 13"),
        ({"episodes": [{k: v[:0] for k, v in EPISODES[0].items()}]}, "is empty"),
        ({"observations": np.zeros((ROWS, 3))}, "Nothing of observation varies"),
        ({"observations": np.random.default_rng(9).normal(size=(ROWS, 3))}, "inside episodes"),
        ({"rewards": np.full(ROWS, np.nan)}, "next.reward is nan"),
        ({"terminals": np.full(ROWS, 0.5)}, "'terminals' has a value of 0.5; expected 0 and 1"),
        ({"timeouts": np.full(ROWS, np.nan)}, "'timeouts' has a value of nan; expected 0 and 1"),
        ({"next_observations": shifted()}, "first observation of the episode after it"),
        ({"actions": joined(EPISODES, "action") * 9}, r"expected a number in \[-1.0, 1.0\]"),
    ],
)
def test_wrong_d4rl_files_are_refused_with_the_reason(tmp_path, changes, message):
    source = write_d4rl(tmp_path / "x.hdf5", **changes)
    with pytest.raises(DatasetError, match=message):
        import_d4rl(source, tmp_path / "data", progress=False)
    assert list(tmp_path.iterdir()) == [source]


def test_files_that_are_not_hdf5_are_refused(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        import_d4rl(tmp_path / "x.hdf5", tmp_path / "data")
    (tmp_path / "x.hdf5").write_text("observations")
    with pytest.raises(DatasetError, match="is no HDF5 file"):
        import_d4rl(tmp_path / "x.hdf5", tmp_path / "data")


def test_a_file_that_was_cut_short_is_refused(source, tmp_path):
    source.write_bytes(source.read_bytes()[:-500])
    with pytest.raises(DatasetError, match="cannot be read to its end.*truncated"):
        import_d4rl(source, tmp_path / "data", progress=False)
    assert list(tmp_path.iterdir()) == [source]


def test_damage_that_shows_up_in_the_middle_leaves_nothing(source, tmp_path, monkeypatch):
    monkeypatch.setattr(from_d4rl, "BLOCK", 4)
    size = len(joined(EPISODES, "reward"))
    random = np.random.default_rng(0)
    with h5py.File(source, "r+") as file:
        del file["rewards"]
        rewards = random.normal(size=size).astype("f4")
        file.create_dataset("rewards", data=rewards, chunks=(5,), compression="gzip")
        last = file["rewards"].id.get_chunk_info(2)
    content = bytearray(source.read_bytes())
    content[last.byte_offset : last.byte_offset + last.size] = bytes(last.size)
    source.write_bytes(content)
    with pytest.raises(DatasetError, match="cannot be read to its end"):
        import_d4rl(source, tmp_path / "data", progress=False)
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize("damage", range(40))
def test_damage_anywhere_is_told_in_one_message(source, tmp_path, damage):
    content = bytearray(source.read_bytes())
    start = damage * (len(content) - 24) // 39  # the first byte to the last
    content[start : start + 24] = bytes(24)
    source.write_bytes(content)
    try:
        damaged = import_d4rl(source, tmp_path / "data", progress=False)
    except DatasetError:
        assert list(tmp_path.iterdir()) == [source]
    else:  # it was of no consequence
        whole = import_d4rl(write_d4rl(tmp_path / "whole.hdf5"), tmp_path / "whole", progress=False)
        assert (damaged.data == whole.data).all()


def test_a_link_that_leads_nowhere_is_named(source, tmp_path):
    with h5py.File(source, "r+") as file:
        del file["actions"]
        file["actions"] = h5py.SoftLink("/nowhere")
    with pytest.raises(DatasetError, match="cannot be read to its end"):
        import_d4rl(source, tmp_path / "data", progress=False)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_wrong_reference_scores_are_told_before_the_work(source, tmp_path, monkeypatch):
    monkeypatch.delattr(DatasetWriter, "add_episode")  # the work
    sources = {import_d4rl: source, import_minari: make_minari(tmp_path / "minari", monkeypatch)}
    for importer in (import_d4rl, import_minari):
        source = sources[importer]
        for scores in (5, (1,), ("a", "b"), (2, 1), (0, np.inf)):
            with pytest.raises(DatasetError, match="reference_scores=.*expected .low, high."):
                importer(source, tmp_path / "data", reference_scores=scores)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from /proc")
def test_memory_does_not_grow_with_the_file(tmp_path):
    """Peak memory of a process that imports two blocks of rows, and of one that imports ten."""
    peaks = []
    for count in (100, 500):
        one = write_d4rl(tmp_path / f"{count}.hdf5", [episode(1000, seed=n) for n in range(count)])
        with h5py.File(one, "r+") as file:  # wide rows: 28 and 140 MB of them
            for name in ("observations", "next_observations"):
                narrow = file[name][:]
                del file[name]
                file[name] = np.repeat(narrow, 11, axis=1)
        script = (
            "import re, sys\n"
            "from pathlib import Path\n"
            "from torchrl_aca.offline import import_d4rl\n"
            "import_d4rl(*sys.argv[1:], progress=False)\n"
            "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])"
        )
        typed = [sys.executable, "-c", script, str(one), str(tmp_path / f"data{count}")]
        output = subprocess.run(typed, capture_output=True, text=True, check=True).stdout
        peaks.append(int(output) / 1024)
    assert peaks[1] - peaks[0] < 30  # MiB


def test_an_interrupted_import_leaves_nothing_and_can_be_repeated(source, tmp_path, monkeypatch):
    add = DatasetWriter.add_episode

    def interrupt(writer, **episode):
        if writer.lengths:
            raise KeyboardInterrupt
        add(writer, **episode)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(DatasetWriter, "add_episode", interrupt)
        import_d4rl(source, tmp_path / "data", progress=False)
    assert list(tmp_path.iterdir()) == [source]
    assert len(import_d4rl(source, tmp_path / "data", progress=False).data) == ROWS


def test_progress_goes_to_stderr_when_asked_for(source, tmp_path, capsys):
    import_d4rl(source, tmp_path / "quiet", progress=False)
    assert capsys.readouterr().err == ""
    import_d4rl(source, tmp_path / "shown")
    assert f"{ROWS}/{ROWS}" in capsys.readouterr().err


# --- Minari ---------------------------------------------------------------------------------------


def make_minari(folder: Path, monkeypatch, episodes=EPISODES[:3], **keywords) -> Path:
    """A data set of the real package in `folder`, and its directory."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    buffers = [
        minari.data_collector.EpisodeBuffer(
            id=i,
            observations=np.vstack([each["observation"], each["next_observation"][-1:]]),
            actions=each["action"],
            rewards=each["reward"],
            terminations=each["terminated"],
            truncations=each["truncated"],
        )
        for i, each in enumerate(episodes)
    ]
    box = {
        "observation_space": spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float64),
        "action_space": spaces.Box(-2, 3, (ACTION_DIM,), np.float64),
    }
    minari.create_dataset_from_buffers("toy/test-v0", buffers, **{**box, **keywords})
    return folder / "toy" / "test-v0"


@pytest.mark.filterwarnings("ignore::UserWarning")  # Minari's, about authors left out
@pytest.mark.parametrize("by", ["id", "directory"])
def test_minari_rows_bounds_and_scores_come_over(tmp_path, monkeypatch, by):
    directory = make_minari(tmp_path / "minari", monkeypatch)
    source = "toy/test-v0" if by == "id" else directory
    dataset = import_minari(source, tmp_path / "data", progress=False)
    expected = {name: joined(EPISODES[:3], name) for name in NAMES.values()}
    expected["episode"] = np.repeat([0, 1, 2], [4, 5, 1])
    assert_rows(dataset, expected)
    metadata = dataset.metadata
    assert metadata["name"] == "toy/test-v0" and metadata["incomplete_episodes"] == []
    assert metadata["action_bounds"] == {"low": [-2, -2], "high": [3, 3]}
    assert metadata["reference_scores"] is None and metadata["env_id"] is None
    assert len(metadata["provenance"]["source_sha256"]) == 64


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_tells_environment_and_scores_where_it_knows_them(tmp_path, monkeypatch):
    pendulum = [{**e, "action": e["action"][:, :1]} for e in EPISODES[:2]]
    scores = {"ref_min_score": -100.0, "ref_max_score": 0.0}
    directory = make_minari(
        tmp_path / "minari",
        monkeypatch,
        pendulum,
        env="Pendulum-v1",
        observation_space=None,
        action_space=None,
        **scores,
    )
    dataset = import_minari(directory, tmp_path / "data", progress=False)
    assert dataset.metadata["env_id"] == "Pendulum-v1"
    assert dataset.normalized_score(-25.0) == 75


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_episode_without_end_is_truncated_and_incomplete(tmp_path, monkeypatch):
    directory = make_minari(tmp_path / "minari", monkeypatch, EPISODES[:1] + EPISODES[3:])
    dataset = import_minari(directory, tmp_path / "data", progress=False)
    truncated = dataset.data["next", "truncated"].squeeze(-1)
    assert truncated.nonzero().squeeze(-1).tolist() == [3, 6]
    assert dataset.metadata["incomplete_episodes"] == [1]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_spaces_that_are_no_vectors_are_refused(tmp_path, monkeypatch):
    discrete = {"action_space": spaces.Discrete(3)}
    chosen = [{**EPISODES[0], "action": np.zeros(4, np.int64)}]
    directory = make_minari(tmp_path / "minari", monkeypatch, chosen, **discrete)
    with pytest.raises(DatasetError, match=r"action space is Discrete\(3\); expected a Box"):
        import_minari(directory, tmp_path / "data", progress=False)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_data_that_are_damaged_or_not_there_are_refused(tmp_path, monkeypatch):
    directory = make_minari(tmp_path / "minari", monkeypatch)
    for missing in ("toy/other-v0", "no id", str(tmp_path / "minari")):
        with pytest.raises(DatasetError, match="is no Minari data set on this machine"):
            import_minari(missing, tmp_path / "data", progress=False)
    file = directory / "data" / "main_data.hdf5"
    with h5py.File(file, "r+") as content:
        del content["episode_1"]
    with pytest.raises(DatasetError, match="cannot be read to its end.*episode_1"):
        import_minari(directory, tmp_path / "data", progress=False)
    file.write_bytes(file.read_bytes()[:-500])
    with pytest.raises(DatasetError, match="cannot be read to its end"):
        import_minari(directory, tmp_path / "data", progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["minari"]


# --- the recipe -----------------------------------------------------------------------------------


def imported(*overrides: str) -> OfflineDataset:
    return import_dataset(composed(*overrides, name="import_dataset"))


def test_recipe_imports_and_sums_up(source, tmp_path):
    overrides = [f"source={source}", f"path={tmp_path / 'data'}", "format=d4rl", "name=mine"]
    dataset = imported(*overrides, "env_id=HalfCheetah-v2")
    assert dataset.metadata["name"] == "mine"
    lines = summary(dataset).splitlines()
    assert lines[0].endswith("13 transitions in 4 episodes")
    mean = np.mean([each["reward"].sum() for each in EPISODES[:3]])
    assert lines[1].startswith(f"returns: mean {mean:.1f}")
    assert lines[2].endswith(f"{100 * (mean + 280.178953) / 12415.178953:.1f}")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_recipe_takes_the_bounds_of_minari(tmp_path, monkeypatch):
    directory = make_minari(tmp_path / "minari", monkeypatch)
    dataset = imported(f"source={directory}", f"path={tmp_path / 'data'}", "format=minari")
    assert dataset.metadata["action_bounds"] == {"low": [-2, -2], "high": [3, 3]}


def test_a_number_may_be_a_name():
    with pytest.raises(DatasetError, match="^2024 does not exist"):
        imported("source=2024", "format=d4rl", "path=5")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["source=x"], "format=???: expected a value"),
        (["source=x", "path=null", "format=d4rl"], "path=None: expected a valid string"),
        (["source=x", "path=y", "format=csv"], "format='csv': expected 'd4rl' or 'minari'"),
        (["source=x", "path=y", "format=d4rl", "check_continuity=5"], "expected a valid boolean"),
        (["source=x", "path=y", "format=d4rl", "allow_constant=[a]"], "allow_constant.0='a': exp"),
        (["source=x", "path=y", "format=d4rl", "+speed=3"], "speed=3: there is no such key"),
    ],
)
def test_recipe_names_each_mistake(overrides, message):
    with pytest.raises(RunError, match=re.escape(message)):
        imported(*overrides)
