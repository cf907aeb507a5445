"""Tests of reading recorded demonstrations."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import Demonstrations
from handover_marl.errors import DataFormatError, UnknownNameError
from handover_marl.evaluation.demonstrations.demonstration import encode_demonstration
from tests.evaluation.demonstrations.recording import SCENES, assert_same, record


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recording with point clouds and actions of the giver; do not write to it."""
    folder = tmp_path_factory.mktemp("demonstrations") / "out"
    record(None, folder, obs_mode="state+pointcloud", giver="noisy", robot="panda_camera")
    return folder


@pytest.fixture
def own(out: Path, tmp_path: Path) -> Path:
    """Return a folder with a copy of the recorded data, which a test may damage."""
    (tmp_path / "own" / "demonstrations").mkdir(parents=True)
    for path in (out / "config.yaml", *(out / "demonstrations").iterdir()):
        (tmp_path / "own" / path.relative_to(out)).write_bytes(path.read_bytes())
    return tmp_path / "own"


def first_file(folder: Path) -> Path:
    return folder / "demonstrations" / "000.npz"


@pytest.mark.slow
def test_spaces_are_the_environments(out: Path) -> None:
    demonstrations = Demonstrations(out)
    env = handover_marl.parallel_env(dataset="synthetic", obs_mode="state+pointcloud", robot="panda_camera")
    assert demonstrations.observation_space == env.observation_space("receiver")
    assert demonstrations.action_space == env.action_space("receiver")
    assert demonstrations.fps is None
    for demonstration in demonstrations:
        for name, array in demonstration.observations.items():
            space = demonstrations.observation_space[name]
            assert (array.shape, array.dtype) == ((len(demonstration) + 1, *space.shape), space.dtype)


def test_round_trip(out: Path) -> None:
    """Encoding what was read gives the file's bytes, which NumPy reads without unpickling anything."""
    for demonstration, path in zip(Demonstrations(out), sorted((out / "demonstrations").glob("*.npz")), strict=True):
        assert encode_demonstration(demonstration) == path.read_bytes()
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        assert arrays["actions"].tobytes() == demonstration.actions.tobytes()
        assert json.loads(arrays["metadata"].item())["scene_id"] == demonstration.metadata["scene_id"]


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


def test_metadata(out: Path) -> None:
    first, second = Demonstrations(out).read_metadata()
    assert (first["scene_id"], second["scene_id"]) == SCENES
    assert (first["object_name"], second["object_name"]) == ("003_cracker_box", "003_cracker_box")
    assert (first["subject"], first["side"]) == ("synthetic-subject-01", "right")
    assert (first["outcome"], first["status"], first["release_step"]) == ("timeout", 8, -1)
    assert (first["receiver"], first["giver"], first["seed"]) == ("moving", "noisy", 0)
    assert (first["physics"], first["dataset"], first["robot"]) == ("fast", "synthetic", "panda_camera")
    assert first["version"] == handover_marl.__version__
    assert first["fingerprint"] == "synthetic-1"


def test_flipped_bytes_are_detected(own: Path) -> None:
    """A flipped byte in the middle of a large array, which only a checksum reveals, is an error."""
    data = bytearray(first_file(own).read_bytes())
    data[len(data) // 2] ^= 0xFF
    first_file(own).write_bytes(data)
    demonstrations = Demonstrations(own)
    for read in (lambda: demonstrations[0], demonstrations.read_transitions):
        with pytest.raises(DataFormatError, match=r"000\.npz cannot be read .* remove it and run the same command"):
            read()
    assert len(demonstrations[1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("actions", np.zeros((3, 8), np.float32)),
        ("actions", np.full((6, 9), np.nan, np.float32)),
        ("steps", np.zeros(3, np.int64)),
        ("observations/time", None),
        ("metadata", None),
        ("metadata", np.array('{"scene_id": "five"}')),
        ("metadata", np.array(object())),
    ],
)
def test_malformed_episodes_are_refused(own: Path, name: str, value: Any) -> None:
    with np.load(first_file(own)) as file:
        arrays = {key: file[key] for key in file.files if key != name}
    np.savez(first_file(own), **arrays, **({} if value is None else {name: value}))
    with pytest.raises(DataFormatError, match=r"000\.npz cannot be read"):
        Demonstrations(own)[0]
