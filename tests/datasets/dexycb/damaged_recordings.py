"""Damages to a recording of raw DexYCB, and the errors that the import reports for them."""

import io
import os
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.datasets.dexycb.raw_files import hand_poses, object_poses

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Files:
    """Paths of the four files of a recording."""

    meta: Path
    pose: Path
    extrinsics: Path
    mano: Path


Damage = Callable[[Files], object]


def meta(**changes: object) -> Damage:
    """Return a damage that changes entries of meta.yml."""
    return lambda files: _changed(files.meta, changes)


def tag(numbers: object) -> Damage:
    return lambda files: _changed(files.extrinsics, {"extrinsics": {"apriltag": numbers}})


def betas(numbers: object) -> Damage:
    return lambda files: _changed(files.mano, {"betas": numbers})


def _changed(path: Path, changes: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}))


def content(which: str, data: bytes) -> Damage:
    """Return a damage that overwrites a file with other bytes."""
    return lambda files: getattr(files, which).write_bytes(data)


def instead(which: str, put: Callable[[Path], object]) -> Damage:
    """Return a damage that removes a file and calls `put` to create something else at its path."""

    def damage(files: Files) -> None:
        path = getattr(files, which)
        path.unlink()
        put(path)

    return damage


def nothing(_: Path) -> None:
    """Create nothing, so that the file is missing."""


def link(target: str) -> Callable[[Path], object]:
    return lambda path: path.symlink_to(target)


def stranger(path: Path) -> None:
    """Create a link to a text file outside of the dataset."""
    other = path.parents[3] / "somebody_elses.txt"
    other.write_text("password: 12345\n")
    path.symlink_to(other)


def sparse(path: Path) -> None:
    """Create a sparse file of 1 TiB, which takes no disk space."""
    with path.open("wb") as stream:
        stream.truncate(1 << 40)


def poses(objects: Array | None = None, hand: Array | None = None, **others: Array) -> Damage:
    """Return a damage that writes pose.npz with these arrays; by default those of two objects and a hand."""
    pose_y = object_poses(n_objects=2) if objects is None else objects
    pose_m = (hand_poses() if hand is None else hand)[:, None]
    return lambda files: np.savez(files.pose, **{"pose_y": pose_y, "pose_m": pose_m, **others})


def frames(count: int) -> Damage:
    return poses(object_poses(count, 2), hand_poses(count))


def changed(array: Array, where: object, value: float) -> Array:
    array = array.copy()
    array[where] = value
    return array


def objects_with(where: object, value: float) -> Damage:
    return poses(objects=changed(object_poses(n_objects=2), where, value))


def hand_with(where: object, value: float) -> Damage:
    return poses(hand=changed(hand_poses(), where, value))


def archive(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> Damage:
    """Return a damage that writes pose.npz as a zip archive with these members (name, content)."""

    def damage(files: Files) -> None:
        with zipfile.ZipFile(files.pose, "w", method) as target, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # two members have the same name
            for name, data in members:
                target.writestr(name, data)

    return damage


def npy(array: Array) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_of_shape(shape: tuple[int, ...], data: bytes) -> bytes:
    """Return an .npy file whose header declares a shape, which may need more data than the file has."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def lying_bomb(files: Files) -> None:
    """Write an archive with 100 MB of zeros whose central directory declares 1000 bytes."""
    size = 100_000_000
    archive([("pose_y.npy", npy_of_shape((size // 56, 2, 7), bytes(size))), ("pose_m.npy", HAND)])(files)
    data = bytearray(files.pose.read_bytes())
    at = data.index(b"PK\x01\x02") + 24  # unpacked size in the central directory
    data[at : at + 4] = (1000).to_bytes(4, "little")
    files.pose.write_bytes(bytes(data))


def locked(files: Files) -> None:
    """Mark the first member of the archive as encrypted."""
    data = bytearray(files.pose.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(mark) + offset] |= 1
    files.pose.write_bytes(bytes(data))


def halved(files: Files) -> None:
    files.pose.write_bytes(files.pose.read_bytes()[:1500])


def moved(files: Files) -> None:
    """Move the recording's folder out of the dataset and put a link to it in its place."""
    folder = files.pose.parent
    other = folder.parents[2] / "elsewhere"
    folder.rename(other)
    folder.symlink_to(other)


def without_quotes(files: Files) -> None:
    text = files.meta.read_text()
    assert "'20200" in text
    files.meta.write_text(text.replace("'", ""))


class Touch:
    """Object that runs a command when it is unpickled; the command creates the file `was_run`."""

    def __reduce__(self) -> tuple[object, ...]:
        return (os.system, ("touch was_run",))


OBJECTS, HAND = npy(object_poses(n_objects=2)), npy(hand_poses()[:, None])
_ALIASES = b"a: &a [x, x]\n" + b"".join(b"%c: &%c [*%c, *%c]\n" % (k + 1, k + 1, k, k) for k in range(97, 121))
_NO_YAML = r"meta\.yml: not as DexYCB writes it \("
_NO_POSES = r"pose\.npz: not as DexYCB writes it \("
_STOPS = "frames, a number for which HandoverSim's conversion fails"

#: Function that damages a recording, and pattern of the reported error, by kind of damage.
DAMAGES: dict[str, tuple[Damage, str]] = {
    "no meta": (instead("meta", nothing), r"lacks meta\.yml; expand"),
    "empty meta": (content("meta", b""), _NO_YAML + "no keys"),
    "meta of another language": (content("meta", "Größe".encode("latin1")), _NO_YAML),
    "meta that asks for Python": (content("meta", b"!!python/object/apply:os.system ['touch was_run']"), _NO_YAML),
    "meta whose aliases multiply": (content("meta", _ALIASES), _NO_YAML + ".*aliases are not allowed"),
    "meta of brackets": (content("meta", b"[" * 60_000), _NO_YAML),
    "meta of a megabyte": (
        content("meta", b"a: b\n" * 200_000),
        _NO_YAML + "it is larger than",
    ),
    "meta of a terabyte": (instead("meta", sparse), _NO_YAML + "it is larger than"),
    "meta that is a pipe": (instead("meta", os.mkfifo), r"lacks meta\.yml"),
    "meta that is a link to itself": (instead("meta", link("meta.yml")), r"lacks meta\.yml"),
    "meta that is a link out of the dataset": (instead("meta", stranger), _NO_YAML + "it has no ycb_ids"),
    "meta of half its lines": (content("meta", b"extrinsics: '20200702_151821'\nycb_ids:\n- 2\n"), "it has no ycb"),
    "a hand's path out of the dataset": (meta(mano_calib=["../../x"]), r"\.\./\.\./x is no id"),
    "a tag's path out of the dataset": (meta(extrinsics="../../x"), r"\.\./\.\./x is no id"),
    "two hands": (meta(mano_sides=["right", "left"]), "mano_sides"),
    "an object that no scene has": (meta(ycb_ids=[2, 19]), "unknown object class 19"),
    "an object that is none": (meta(ycb_ids=[2, 22]), "unknown object class 22"),
    "an object twice": (meta(ycb_ids=[2, 2]), r"ycb_ids \[2, 2\] names an object twice"),
    "an object grasped that is not there": (meta(ycb_grasp_ind=2), "ycb_grasp_ind 2 is not an index"),
    "an object grasped of negative number": (meta(ycb_grasp_ind=-1), "ycb_grasp_ind -1 is not an index"),
    "fewer objects than poses": (meta(ycb_ids=[5], ycb_grasp_ind=0), r"pose_y has shape \(6, 2, 7\)"),
    "no tag file": (instead("extrinsics", nothing), r"extrinsics\.yml is missing; the download is incomplete"),
    "a tag file that is a folder": (instead("extrinsics", Path.mkdir), r"extrinsics\.yml: not as DexYCB"),
    "a tag file that is a pipe": (instead("extrinsics", os.mkfifo), r"extrinsics\.yml: not as DexYCB"),
    "no tag": (content("extrinsics", b"extrinsics: {'840412060917': [1.0]}"), "no extrinsics of the apriltag"),
    "a tag of 11 numbers": (tag([1.0] * 11), "expected 12 numbers"),
    "a tag that is stretched": (
        tag([2.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0]),
        "apriltag is not orthogonal",
    ),
    "a tag that is mirrored": (
        tag([-1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0]),
        "apriltag is not orthogonal",
    ),
    "a tag of NaN": (tag([float("nan")] * 12), "apriltag holds nan, expected finite numbers"),
    "no hand shape": (instead("mano", nothing), r"mano\.yml is missing; the download is incomplete"),
    "a hand shape of 9 numbers": (betas([0.1] * 9), "expected 10 numbers"),
    "a hand shape of 11 numbers": (betas([0.1] * 11), "expected 10 numbers"),
    "a hand shape of NaN": (betas([0.1] * 9 + [float("nan")]), "betas holds nan, expected finite numbers"),
    "a hand shape of no hand": (betas([0.1] * 9 + [1e4]), r"betas holds 10000\.0, .*within \+-100"),
    "a hand shape of text": (betas(["0.1"] * 10), "betas holds the text 0.1"),
    "no poses": (instead("pose", nothing), r"lacks pose\.npz; expand"),
    "empty poses": (content("pose", b""), _NO_POSES),
    "poses that are no archive": (content("pose", b"<html>404 not found</html>"), _NO_POSES),
    "poses cut off": (halved, _NO_POSES),
    "poses that are a pipe": (instead("pose", os.mkfifo), r"lacks pose\.npz"),
    "poses that are a device": (instead("pose", link("/dev/zero")), r"lacks pose\.npz"),
    "poses that are a link to nowhere": (instead("pose", link("nowhere")), r"lacks pose\.npz"),
    "poses that are a folder": (instead("pose", Path.mkdir), r"lacks pose\.npz"),
    "poses of a terabyte": (instead("pose", sparse), _NO_POSES + ".*larger than 3 MB"),
    "a bomb": (archive([("pose_y.npy", bytes(10**8)), ("pose_m.npy", HAND)]), _NO_POSES + ".*more than 2 MB"),
    "a bomb that lies": (lying_bomb, _NO_POSES),
    "a bomb of another method": (
        archive([("pose_y.npy", OBJECTS), ("pose_m.npy", HAND)], zipfile.ZIP_BZIP2),
        _NO_POSES + ".*another method than deflate",
    ),
    "a list of too many files": (archive([(f"{k}", b"") for k in range(40_000)]), _NO_POSES + ".*larger than 3 MB"),
    "an encrypted archive": (locked, _NO_POSES),
    "an array that promises terabytes": (
        archive([("pose_y.npy", npy_of_shape((10**12, 2, 7), b"")), ("pose_m.npy", HAND)]),
        _NO_POSES,
    ),
    "an array that is text": (
        archive([("pose_y.npy", b"x"), ("pose_m.npy", HAND)]),
        _NO_POSES + ".*y is not an array",
    ),
    "an array twice": (
        archive([("pose_y.npy", OBJECTS), ("pose_m.npy", HAND), ("pose_y.npy", OBJECTS)]),
        _NO_POSES + ".*two files of the same name",
    ),
    "an array that is pickled": (poses(pose_y=np.array([Touch()], dtype=object)), _NO_POSES + ".*allow_pickle=False"),
    "one array only": (archive([("pose_y.npy", OBJECTS)]), _NO_POSES + ".*pose_m"),
    "float64": (poses(objects=object_poses(n_objects=2).astype(np.float64)), "pose_y is float64, expected float32"),
    "objects of 6 numbers": (poses(objects=object_poses(n_objects=2)[:, :, :6]), "pose_y has shape"),
    "a hand of 48 numbers": (poses(hand=hand_poses()[:, :48]), "pose_m has shape"),
    "a hand of fewer frames": (poses(hand=hand_poses()[:5]), "pose_y has 6 frames, pose_m 5"),
    "an object at NaN": (objects_with((1, 1, 5), np.nan), "pose_y holds values that are not finite"),
    "an object at infinity": (objects_with((1, 1, 5), np.inf), "pose_y holds values that are not finite"),
    "an object kilometres away": (objects_with((1, 1, 5), 2e3), "pose_y holds values .* beyond 1000 m"),
    "a hand at NaN": (hand_with((1, 5), np.nan), "pose_m holds values that are not finite"),
    "an object that is absent": (objects_with((2, 1), 0.0), "object 1 is absent in frame 2"),
    "quaternions of no unit length": (
        objects_with((3, 0, slice(4)), 0.9),
        "object 0 has no unit quaternion",
    ),
    "a hand that vanishes in between": (hand_with(3, 0.0), "the hand is absent in frame 3, between others"),
    "no hand": (hand_with(slice(None), 0.0), "0 frames with a hand, expected at least 4"),
    "a hand in 3 frames": (hand_with(slice(3), 0.0), "3 frames with a hand, expected at least 4"),
    **{f"{count} frames": (frames(count), f"{count} frames, expected at least 4") for count in range(4)},
    **{f"{count} frames": (frames(count), f"{count} {_STOPS}") for count in (7, 14, 28, 56, 57, 111)},
}

#: Functions that change a recording without an effect on the import, by kind of change.
HARMLESS: dict[str, Damage] = {
    "ids without quotes": without_quotes,
    "further arrays": poses(labels=np.zeros(3)),
    "the other byte order": poses(objects=object_poses(n_objects=2).astype(">f4")),
    "files of others": lambda files: (files.pose.parent / ".DS_Store").write_bytes(b"x"),
    "a link in place of the folder": moved,
    "another number of frames in meta": meta(num_frames=7),
}
