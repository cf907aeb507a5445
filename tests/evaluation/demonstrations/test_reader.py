"""Tests of reading recorded demonstrations, with this library and with Minari."""

import json
import multiprocessing
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import Demonstrations
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, UnknownNameError
from handover_marl.evaluation.demonstrations.minari_layout import METADATA_FILE
from tests.evaluation.deadline import ends_within
from tests.evaluation.demonstrations.recording import SCENES, assert_same, main_file, record
from tests.unreadable import UNREADABLE, refuses_within, replace_by


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recording with point clouds and actions of the giver; do not write to it."""
    folder = tmp_path_factory.mktemp("demonstrations") / "out"
    record(None, folder, obs_mode="state+pointcloud", giver="noisy", robot="panda_camera")
    return folder


@pytest.fixture
def own(out: Path, tmp_path: Path) -> Path:
    """Return a folder with a copy of the recorded data, which a test may damage."""
    (tmp_path / "own" / "data").mkdir(parents=True)
    for path in (out / "data").iterdir():
        (tmp_path / "own" / "data" / path.name).write_bytes(path.read_bytes())
    return tmp_path / "own"


def test_spaces_are_the_environments(out: Path) -> None:
    demonstrations = Demonstrations(out)
    env = handover_marl.parallel_env(dataset="synthetic", obs_mode="state+pointcloud", robot="panda_camera")
    assert demonstrations.observation_space == env.observation_space("receiver")
    assert demonstrations.action_space == env.action_space("receiver")
    alone = handover_marl.parallel_env(dataset="synthetic", obs_mode="pointcloud")
    for demonstration in demonstrations:
        for name, array in demonstration.observations.items():
            space = demonstrations.observation_space[name]
            assert (array.shape, array.dtype) == ((len(demonstration) + 1, *space.shape), space.dtype)
    assert set(alone.observation_space("receiver")) < set(demonstrations.observation_space)


@pytest.mark.parametrize("obs_mode", ["rgbd", "full_pointcloud"])
def test_other_observation_modes(tmp_path: Path, obs_mode: str) -> None:
    options: dict[str, Any] = {"obs_mode": obs_mode, "scenes": [5], "receiver": "hold"}
    (demonstration,) = demonstrations = record(None, tmp_path / "out", **options)
    env = handover_marl.parallel_env(dataset="synthetic", obs_mode=obs_mode, physics="fast", split="train")
    assert demonstrations.observation_space == env.observation_space("receiver")
    seen, _ = env.reset(options={"scene_id": 5})
    for name, array in demonstration.observations.items():
        np.testing.assert_array_equal(array[0], seen["receiver"][name], err_msg=name, strict=True)
    minari = pytest.importorskip("minari")
    (episode,) = minari.MinariDataset(tmp_path / "out" / "data")
    for name, array in demonstration.observations.items():
        np.testing.assert_array_equal(episode.observations[name], array, err_msg=name, strict=True)


def test_transitions_are_those_of_the_episodes(out: Path) -> None:
    demonstrations = Demonstrations(out)
    first, second = demonstrations
    assert_same(demonstrations[-1], second)
    seen, actions = demonstrations.read_transitions()
    assert list(seen) == list(demonstrations.observation_space)
    np.testing.assert_array_equal(actions, np.concatenate([first.actions, second.actions]))
    for name, array in seen.items():
        parts = [first.observations[name][:-1], second.observations[name][:-1]]
        np.testing.assert_array_equal(array, np.concatenate(parts), err_msg=name, strict=True)
    some, actions = demonstrations.read_transitions(["time"], episodes=[1])
    assert list(some) == ["time"]
    np.testing.assert_array_equal(actions, second.actions)
    np.testing.assert_allclose(some["time"][:, 0], second.steps[:-1] * 0.001, rtol=1e-6)
    nothing, none = demonstrations.read_transitions(["wrist_object_points"], episodes=[])
    assert (nothing["wrist_object_points"].shape, none.shape) == ((0, 1024, 3), (0, 9))
    with pytest.raises(UnknownNameError, match="unknown observation 'smell'; valid: "):
        demonstrations.read_transitions(["smell"])
    for number in (2, -3):
        with pytest.raises(IndexError):
            demonstrations[number]
    with pytest.raises(TypeError):
        demonstrations[0:1]  # type: ignore[index]


def test_demonstrations_can_be_pickled(out: Path) -> None:
    demonstrations = pickle.loads(pickle.dumps(Demonstrations(out)))
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(len, [demonstrations]) == [2]
    assert_same(demonstrations[0], Demonstrations(out)[0])


def test_metadata(out: Path) -> None:
    first, second = Demonstrations(out).read_metadata()
    assert (first.scene_id, second.scene_id) == SCENES
    assert (first.object_name, second.object_name) == ("003_cracker_box", "003_cracker_box")
    assert (first.subject, first.side) == ("synthetic-subject-01", "right")
    assert (first.outcome, first.status, first.release_step, first.success) == ("timeout", 8, -1, False)
    assert (first.receiver, first.giver, first.seed) == ("moving", "noisy", 0)
    assert (first.physics, first.dataset, first.robot) == ("fast", "synthetic", "panda_camera")
    assert first.version == handover_marl.__version__
    assert first.fingerprint == "synthetic-1"


def test_minari_reads_the_data_set(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out.parent))
    dataset = minari.load_dataset(out.name)
    ours = Demonstrations(out)
    assert dataset.observation_space == ours.observation_space
    assert dataset.action_space == ours.action_space
    assert (dataset.total_episodes, dataset.total_steps) == (2, sum(map(len, ours)))
    assert dataset.spec.dataset_id == "handover_marl/synthetic-s0-train-moving-noisy-fast-v0"
    for number, (episode, demonstration) in enumerate(zip(dataset, ours, strict=True)):
        assert episode.id == number
        for name in ("actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(demonstration, name), strict=True)
        for name, array in demonstration.observations.items():
            np.testing.assert_array_equal(episode.observations[name], array, err_msg=name, strict=True)
        np.testing.assert_array_equal(episode.infos["steps"], demonstration.steps)
    stored = list(dataset.storage.get_episode_metadata([0, 1]))
    assert [metadata["options"]["scene_id"] for metadata in stored] == list(SCENES)
    assert (stored[0]["outcome"], stored[0]["object_name"], stored[0]["seed"]) == (
        "timeout",
        "003_cracker_box",
        0,
    )
    np.testing.assert_array_equal(stored[1]["giver_actions"], ours[1].giver_actions)
    assert len(dataset.filter_episodes(lambda episode: bool(episode.truncations[-1]))) == 2


def test_missing_data_sets(tmp_path: Path, own: Path) -> None:
    for folder in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(DataNotFoundError, match="has no demonstrations"):
            Demonstrations(folder)
    for wrong in (None, 5, "", "a\0b"):
        with pytest.raises(OptionError, match="folder must be a path"):
            Demonstrations(wrong)  # type: ignore[arg-type]
    demonstrations = Demonstrations(own)
    main_file(own).unlink()
    with pytest.raises(DataFormatError, match=r"main_data\.hdf5: episode 0 cannot be read"):
        demonstrations[0]
    with pytest.raises(DataFormatError, match=r"main_data\.hdf5 cannot be read .* run the same command again"):
        Demonstrations(own)


def test_flipped_bytes_are_detected(own: Path) -> None:
    """A flipped byte in the middle of a large array, which only the array's checksum reveals, is an error."""
    path = main_file(own)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    demonstrations = Demonstrations(own)
    with pytest.raises(DataFormatError, match="cannot be read"):
        list(demonstrations)
    with pytest.raises(DataFormatError, match="cannot be read"):
        demonstrations.read_transitions()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("actions", np.zeros((3, 8), np.float32)),
        ("actions", np.zeros((3, 9), np.float64)),
        ("rewards", np.zeros(10**6)),
        ("infos/steps", np.zeros(3, np.int64)),
        ("observations/time", np.zeros((3, 1), np.float32)),
        ("observations/time", None),
        ("total_steps", 10**12),
        ("total_steps", "many"),
        ("scene_id", "five"),
        ("giver_actions", np.zeros((2, 8), np.float32)),
    ],
)
def test_malformed_episodes_are_refused(own: Path, name: str, value: Any) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(main_file(own), "a") as file:
        group = file["episode_0"]
        if name in group.attrs:
            group.attrs[name] = value
        else:
            del group[name]
            if value is not None:
                group[name] = value
    with pytest.raises(DataFormatError, match="episode 0 cannot be read"):
        Demonstrations(own)[0]


def test_arrays_that_exceed_the_memory_are_refused(own: Path) -> None:
    """Arrays of more than 8 GB are refused, because a file of a few bytes can declare them."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(main_file(own), "a") as file:
        group = file["episode_0"]
        group.attrs["total_steps"] = 10**9
        for name, shape in (("wrist_object_points", (10**9 + 1, 1024, 3)), ("wrist_hand_points", (10**9 + 1, 1024, 3))):
            del group["observations"][name]
            group["observations"].create_dataset(name, shape, np.float32, chunks=(1, 1024, 3))
    with pytest.raises(DataFormatError, match="at most 8 GB"):
        Demonstrations(own).read_transitions(["wrist_object_points"])


@pytest.mark.parametrize(
    "change",
    [
        {"observation_space": "{}"},
        {
            "observation_space": '{"type": "Dict", "subspaces": {"x": {"type": "Box", "shape": [99999999], '
            '"dtype": "float32", "low": 0, "high": 1}}}'
        },
        {"action_space": '{"type": "Box", "shape": [9], "dtype": "O", "low": 0, "high": 1}'},
        {"handover_marl": {}},
        {"handover_marl": None},
        {"total_steps": "many"},
        {"handover_marl": {"recorded": {"success": 10**18}}},
        {"handover_marl": {"evaluation": {"receiver": "x" * 5_000_000}}},
        {"handover_marl": {"evaluation": {"physics": "bullet"}}},
    ],
)
def test_malformed_metadata_are_refused(own: Path, change: dict[str, Any]) -> None:
    path = own / "data" / METADATA_FILE
    content = json.loads(path.read_text())
    section = change.get("handover_marl")
    if section:
        ours = content["handover_marl"]
        change = {"handover_marl": {**ours, **{key: {**ours[key], **value} for key, value in section.items()}}}
    path.write_text(json.dumps({**content, **change}))
    with pytest.raises(DataFormatError, match=r"metadata\.json: not a description of demonstrations"):
        Demonstrations(own)


@pytest.mark.parametrize("content", ["", "[]", "{", "[" * 100_000, "\0"])
def test_foreign_metadata_are_refused(own: Path, content: str) -> None:
    (own / "data" / METADATA_FILE).write_text(content)
    with pytest.raises(DataFormatError, match="not a description of demonstrations"):
        Demonstrations(own)


@pytest.mark.parametrize("kind", UNREADABLE)
def test_unreadable_files(kind: str, own: Path) -> None:
    demonstrations = Demonstrations(own)
    if kind != "large":  # the file of a data set may be large
        replace_by(kind, main_file(own))
        with refuses_within(5.0, DataFormatError, kind):
            demonstrations[0]
    replace_by(kind, own / "data" / METADATA_FILE)
    with refuses_within(5.0, DataFormatError, kind):
        Demonstrations(own)


def link_array(file: Any, group: Any, other: Path) -> None:
    h5py = pytest.importorskip("h5py")
    group["actions"] = h5py.ExternalLink(str(other), "episode_0/actions")


def link_within_the_file(file: Any, group: Any, other: Path) -> None:
    h5py = pytest.importorskip("h5py")
    group["actions"] = h5py.SoftLink("/episode_1/actions")


def link_group(file: Any, group: Any, other: Path) -> None:
    h5py = pytest.importorskip("h5py")
    del file["episode_0"]
    file["episode_0"] = h5py.ExternalLink(str(other), "episode_0")


def store_elsewhere(file: Any, group: Any, other: Path) -> None:
    size = int(group.attrs["total_steps"]), 9
    group.create_dataset("actions", size, np.float32, external=[(str(other), 0, 4 * size[0] * size[1])])


def make_virtual(file: Any, group: Any, other: Path) -> None:
    h5py = pytest.importorskip("h5py")
    size = int(group.attrs["total_steps"]), 9
    layout = h5py.VirtualLayout(size, np.float32)
    layout[:] = h5py.VirtualSource(str(other), "episode_0/actions", size)
    group.create_virtual_dataset("actions", layout)


def link_in_circles(file: Any, group: Any, other: Path) -> None:
    group["actions"] = group
    group["infos"]["again"] = group


@pytest.mark.parametrize(
    "change", [link_array, link_within_the_file, link_group, store_elsewhere, make_virtual, link_in_circles]
)
def test_arrays_outside_of_the_file_are_refused(change: Callable[[Any, Any, Path], None], own: Path, out: Path) -> None:
    """Links and arrays in other files are refused: they could be any file of the machine that reads the data set."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(main_file(own), "a") as file:
        del file["episode_0"]["actions"]
        change(file, file["episode_0"], main_file(out))
    demonstrations = Demonstrations(own)
    for read in (demonstrations.read_metadata, demonstrations.read_transitions, lambda: demonstrations[0]):
        with ends_within(5.0), pytest.raises(DataFormatError, match=r"missing, or a link|in another file|1000 members"):
            read()


@pytest.mark.parametrize("name", ["actions", "rewards", "giver_actions"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_actions_that_are_not_finite_are_refused(name: str, value: float, own: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(main_file(own), "a") as file:
        group = file["episode_0"]
        if name in group.attrs:
            group.attrs[name] = np.full_like(group.attrs[name], value)
        else:
            group[name][-1] = value
    demonstrations = Demonstrations(own)
    with pytest.raises(DataFormatError, match=f"{name} must be finite"):
        demonstrations[0]
    if name == "actions":
        with pytest.raises(DataFormatError, match="actions must be finite"):
            demonstrations.read_transitions()
