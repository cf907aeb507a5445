import os
import random
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.dexycb.raw_sequence import read_meta, read_sequence
from handover_marl.errors import DataFormatError, DataNotFoundError
from tests.datasets.dexycb.raw_files import (
    RawScene,
    extrinsics_file,
    hand_poses,
    mano_file,
    object_poses,
    tag_pose,
    write_yaml,
)
from tests.evaluation.deadline import ends_within


def test_recording(tmp_path: Path) -> None:
    scene = RawScene(hand=hand_poses(6, 1, 4))
    raw = read_sequence(scene.write(tmp_path))
    assert raw.meta.ycb_ids == (2, 5)
    assert (raw.meta.ycb_grasp_ind, raw.meta.side) == (1, "right")
    assert raw.meta.extrinsics == "20200702_151821"
    assert raw.betas == tuple(scene.betas)
    np.testing.assert_array_equal(raw.world_from_tag, tag_pose())
    np.testing.assert_array_equal(raw.objects, scene.objects)
    np.testing.assert_array_equal(raw.hand, scene.hand)
    assert raw.objects.dtype == raw.hand.dtype == np.float32


def test_byte_order_does_not_matter(tmp_path: Path) -> None:
    scene = RawScene()
    raw = read_sequence(replace(scene, objects=scene.objects.astype(">f4")).write(tmp_path))
    np.testing.assert_array_equal(raw.objects, scene.objects)
    assert raw.objects.dtype.isnative


def test_betas_keep_their_type(tmp_path: Path) -> None:
    assert [type(beta) for beta in read_sequence(RawScene(betas=[0, *[0.5] * 9]).write(tmp_path)).betas[:2]] == [
        int,
        float,
    ]


def test_identifiers_without_quotes(tmp_path: Path) -> None:
    """An id without quotes, which is an integer with an underscore in YAML 1.1, is read as text."""
    sequence = RawScene().write(tmp_path)
    path = sequence.folder / "meta.yml"
    path.write_text(path.read_text().replace("'20200702_151821'", "20200702_151821").replace('"', ""))
    assert "extrinsics: 20200702_151821\n" in path.read_text()
    assert read_meta(sequence).extrinsics == "20200702_151821"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extrinsics": 20200702}, "20200702 is no id; write ids in quotes"),
        ({"extrinsics": 202007021518210}, "is no id"),
        ({"extrinsics": -20200702151821}, "is no id"),
        ({"extrinsics": "../secret"}, "secret is no id"),
        ({"extrinsics": ""}, "is no id"),
        ({"extrinsics": True}, "True is no id"),
        ({"extrinsics": ["a"]}, "is no id"),
        ({"extrinsics": None}, "it has no extrinsics"),
        ({"mano_calib": ["../../x"]}, "is no id"),
        ({"mano_calib": []}, "expected one hand"),
        ({"mano_calib": ["a", "b"]}, "expected one hand"),
        ({"mano_calib": "text"}, "text where a list belongs"),
        ({"mano_calib": None}, "it has no mano_calib"),
        ({"mano_sides": ["both"]}, "mano_sides"),
        ({"mano_sides": ["right", "left"]}, "mano_sides"),
        ({"mano_sides": None}, "it has no mano_sides"),
        ({"ycb_ids": [2, 19]}, "unknown object class 19"),
        ({"ycb_ids": []}, "0 objects"),
        ({"ycb_ids": [2, 2.5]}, "2.5 is not an integer"),
        ({"ycb_ids": "12"}, "12 where a list belongs"),
        ({"ycb_ids": {2: 5}}, "where a list belongs"),
        ({"ycb_ids": [10**4999]}, "not as DexYCB writes it"),
        ({"ycb_grasp_ind": 2}, "ycb_grasp_ind 2"),
        ({"ycb_grasp_ind": "0"}, "'0' is not an integer"),
        ({"ycb_grasp_ind": None}, "it has no ycb_grasp_ind"),
    ],
)
def test_bad_meta(
    tmp_path: Path, changes: dict[str, object], message: str, unlimited_digits: Callable[[], None]
) -> None:
    sequence = RawScene(meta=changes).write(tmp_path)
    unlimited_digits()
    with pytest.raises(DataFormatError, match=rf"(?s)meta\.yml.*{message}"):
        read_sequence(sequence)


@pytest.fixture
def unlimited_digits() -> Callable[[], None]:
    """Remove the limit of digits of integers, for writing YAML, and return a function that restores it."""
    usual = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(0)
    return lambda: sys.set_int_max_str_digits(usual)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"text",
        b"\xff\xfe\xfa",
        b"a: &a [1]\nb: *a\n",
        b"a: !!python/object/apply:os.system ['true']",
        b"[" * 50_000,
        b"extrinsics: 0x" + b"f" * 20_000 + b"\nycb_ids: [0x" + b"f" * 9_000 + b"]\n",
        b" " * 64_001,
        b"? [a]\n: b\n",
    ],
)
def test_other_yaml_files(tmp_path: Path, content: bytes) -> None:
    sequence = RawScene().write(tmp_path)
    for path in (sequence.folder / "meta.yml", mano_file(tmp_path), extrinsics_file(tmp_path)):
        whole = path.read_bytes()
        path.write_bytes(content)
        with ends_within(10.0), pytest.raises(DataFormatError, match=rf"{path.name}: not as DexYCB.*expand"):
            read_sequence(sequence)
        path.write_bytes(whole)


def test_missing_files_are_named(tmp_path: Path) -> None:
    sequence = RawScene().write(tmp_path)
    for path in (sequence.folder / "meta.yml", mano_file(tmp_path), extrinsics_file(tmp_path)):
        whole = path.read_bytes()
        path.unlink()
        with pytest.raises(DataNotFoundError, match=rf"{path.name} is missing.*expand"):
            read_sequence(sequence)
        os.mkfifo(path)
        with ends_within(5.0), pytest.raises(DataFormatError, match=path.name):
            read_sequence(sequence)
        path.unlink()
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"extrinsics": {"master": [1.0] * 12}}, "no extrinsics of the apriltag"),
        ({"extrinsics": [1.0] * 12}, "no extrinsics of the apriltag"),
        ({"extrinsics": {"apriltag": [1.0] * 11}}, "expected 12 numbers"),
        ({"extrinsics": {"apriltag": [1.0] * 12}}, "apriltag is not orthogonal"),
        (
            {"extrinsics": {"apriltag": [-1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0]}},
            "apriltag is not orthogonal",
        ),
        ({"extrinsics": {"apriltag": [float("nan")] * 12}}, "holds nan, expected finite"),
        ({"extrinsics": {"apriltag": [True] * 12}}, "holds True, expected finite"),
        ({"extrinsics": {"apriltag": [10**400] * 12}}, "expected finite"),
    ],
)
def test_bad_extrinsics(tmp_path: Path, content: object, message: str) -> None:
    sequence = RawScene().write(tmp_path)
    write_yaml(extrinsics_file(tmp_path), content)
    with pytest.raises(DataFormatError, match=rf"(?s)extrinsics\.yml.*{message}"):
        read_sequence(sequence)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("betas: [0.1, 0.2]", "expected 10 numbers"),
        ("shape: 3", "betas is None, expected 10 numbers"),
        (f"betas: [{'0.1, ' * 9} 1e-5]", "holds the text 1e-5"),
        (f"betas: [{'0.1, ' * 9} .inf]", "holds inf"),
    ],
)
def test_bad_shape(tmp_path: Path, text: str, message: str) -> None:
    sequence = RawScene().write(tmp_path)
    mano_file(tmp_path).write_text(text)
    with pytest.raises(DataFormatError, match=rf"mano\.yml.*{message}"):
        read_sequence(sequence)


def spoilt(array: np.ndarray, index: tuple[int | slice, ...], value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


OBJECTS, HAND = object_poses(n_objects=2), hand_poses()


@pytest.mark.parametrize(
    ("objects", "hand", "message"),
    [
        (object_poses(n_objects=1), HAND, r"pose_y has shape \(6, 1, 7\), expected \(F, 2, 7\)"),
        (OBJECTS[:, :, :6], HAND, "pose_y has shape"),
        (OBJECTS, HAND[:, :48], "pose_m has shape"),
        (OBJECTS, HAND[:5], "pose_y has 6 frames, pose_m 5"),
        (OBJECTS.astype(np.float64), HAND, "pose_y is float64, expected float32"),
        (OBJECTS, HAND.astype(np.int32), "pose_m is int32"),
        (spoilt(OBJECTS, (1, 1, 5), np.nan), HAND, "pose_y holds values that are not finite"),
        (OBJECTS, spoilt(HAND, (1, 5), np.inf), "pose_m holds values that are not finite"),
        (OBJECTS, spoilt(HAND, (1, 5), 1e9), "pose_m holds values that are not finite, or beyond"),
        (spoilt(OBJECTS, (2, 1, slice(None)), 0.0), HAND, "object 1 is absent in frame 2"),
        (spoilt(OBJECTS, (0, 0, slice(None)), 0.0), HAND, "object 0 is absent in frame 0"),
        (spoilt(OBJECTS, (3, 0, slice(4)), 0.7), HAND, "object 0 has no unit quaternion in frame 3"),
        (OBJECTS, spoilt(HAND, (3, slice(None)), 0.0), "the hand is absent in frame 3"),
        (OBJECTS, spoilt(HAND, (slice(3), slice(None)), 0.0), "3 frames with a hand, expected at least 4"),
        (OBJECTS, 0.0 * HAND, "0 frames with a hand"),
        (OBJECTS[:3], HAND[:3], "3 frames, expected at least 4"),
        (OBJECTS[:0], HAND[:0], "0 frames, expected at least 4"),
        (object_poses(7, 2), hand_poses(7), "7 frames, a number for which HandoverSim's conversion fails"),
        (object_poses(57, 2), hand_poses(57), "57 frames, a number"),
        (object_poses(9000, 2), hand_poses(9000), "unpacks to more than 2 MB"),
    ],
)
def test_bad_poses(tmp_path: Path, objects: np.ndarray, hand: np.ndarray, message: str) -> None:
    with pytest.raises(DataFormatError, match=rf"pose\.npz.*{message}"):
        read_sequence(RawScene(objects=objects, hand=hand).write(tmp_path))


def test_other_files_as_poses(tmp_path: Path) -> None:
    sequence, rng = RawScene().write(tmp_path), random.Random(0)
    path = sequence.folder / "pose.npz"
    whole = path.read_bytes()
    wrong = [b"", b"PK", whole[: len(whole) // 2], whole[:-3]]
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    wrong.append(path.read_bytes())
    np.savez(path, pose_y=np.array([{}], dtype=object), pose_m=HAND)
    wrong.append(path.read_bytes())
    np.savez(path, pose_y=OBJECTS)
    wrong.append(path.read_bytes())
    wrong += [whole[:position] + b"\xff" + whole[position + 1 :] for position in rng.sample(range(70, 200), 20)]
    for content in wrong:
        path.write_bytes(content)
        with pytest.raises(DataFormatError, match=r"pose\.npz"):
            read_sequence(sequence)
