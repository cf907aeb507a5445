"""Tests of reading recorded demonstrations."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl import Demonstrations
from handover_marl.errors import DataFormatError, UnknownNameError
from handover_marl.evaluation.demonstrations.demonstration import encode_demonstration


@pytest.fixture
def own(out: Path, tmp_path: Path) -> Path:
    """Return a folder with a copy of the recorded data, which a test may damage."""
    return shutil.copytree(out, tmp_path / "own")


def test_spaces_are_the_environments(out: Path) -> None:
    demonstrations = Demonstrations(out)
    env = handover_marl.parallel_env(dataset="synthetic", obs_mode="state+pointcloud", robot="panda_camera")
    assert demonstrations.observation_space == env.observation_space("receiver")
    assert demonstrations.action_space == env.action_space("receiver")
    assert demonstrations.fps is None
    for demonstration in demonstrations:
        for name, array in demonstration.observations.items():
            space = demonstrations.observation_space[name]
            assert (array.shape, array.dtype) == ((len(demonstration) + 1, *(space.shape or ())), space.dtype)


def test_round_trip(out: Path) -> None:
    """Encoding what was read gives the file's bytes, which NumPy reads without unpickling anything."""
    for demonstration, path in zip(Demonstrations(out), sorted((out / "demonstrations").glob("*.npz")), strict=True):
        assert encode_demonstration(demonstration) == path.read_bytes()
        with np.load(path, allow_pickle=False) as file:
            assert file["actions"].tobytes() == demonstration.actions.tobytes()
            assert json.loads(file["metadata"].item()) == demonstration.metadata


def test_transitions_are_those_of_the_episodes(out: Path) -> None:
    demonstrations = Demonstrations(out)
    first, second = demonstrations
    np.testing.assert_array_equal(demonstrations[-1].actions, second.actions)
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
    with pytest.raises(IndexError):
        demonstrations[2]


def test_flipped_bytes_are_detected(own: Path) -> None:
    """A flipped byte in the middle of a large array, which only a checksum reveals, is an error."""
    path = own / "demonstrations" / "000.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    demonstrations = Demonstrations(own)
    for read in (lambda: demonstrations[0], demonstrations.read_transitions):
        with pytest.raises(DataFormatError, match=r"000\.npz: not a readable demonstration .*; remove it and run"):
            read()
    assert len(demonstrations[1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("actions", np.zeros((3, 9), np.float32)),
        ("observations/time", None),
        ("metadata", np.array('{"scene_id": "five"}')),
        ("metadata", np.array(object())),
    ],
)
def test_malformed_episodes_are_refused(own: Path, name: str, value: Any) -> None:
    path = own / "demonstrations" / "000.npz"
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files if key != name}
    np.savez(path, **arrays, **({} if value is None else {name: value}))
    with pytest.raises(DataFormatError, match=r"000\.npz: not a readable demonstration"):
        Demonstrations(own)[0]
