"""Reader of one raw DexYCB recording: its meta.yml, its pose.npz and its calibration files."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF
from handover_marl.datasets.dexycb.mano import MAX_ABS_BETA, N_BETAS
from handover_marl.datasets.dexycb.raw_files import META_FILE, POSE_FILE, SequenceFolder
from handover_marl.datasets.dexycb.rotations import MIN_KEYFRAMES, Float32, Float64, can_original_resample
from handover_marl.datasets.scene_files import check_scene_meta, require_integer
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_arrays, read_yaml

_MAX_YAML_BYTES = 64_000  # official files have a few thousand
_MAX_POSE_BYTES = 2_000_000  # unpacked; official files have some ten thousand
# Bounds far from all recorded values (m or rad).
_MAX_ABS_EXTRINSIC = 1e6
_MAX_ABS_POSE = 1000.0
_ORTHOGONALITY_TOLERANCE = 1e-2  # of the entries of R R^T
_NORM_TOLERANCE = 0.1  # of quaternions
_IDENTIFIER = re.compile(r"[\w-]+", re.ASCII)


@dataclass(frozen=True)
class SequenceMeta:
    """Content of a recording's meta.yml.

    Attributes:
        extrinsics: Name of the extrinsic calibration.
        ycb_ids: YCB class numbers of the objects.
        ycb_grasp_ind: Index of the handed-over object in `ycb_ids`.
        side: Hand, "right" or "left".
        mano_calib: Name of the calibration of the hand's shape.
    """

    extrinsics: str
    ycb_ids: tuple[int, ...]
    ycb_grasp_ind: int
    side: str
    mano_calib: str


@dataclass(frozen=True, eq=False)
class RawSequence:
    """Recording with its calibration.

    Attributes:
        meta: Content of meta.yml.
        world_from_tag: (3, 4) [R | t] pose of the AprilTag in the world frame (m).
        betas: MANO's ten shape parameters of the hand.
        objects: (F, n, 7) float32 quaternion xyzw and position (m) of the objects, in the order of
            `meta.ycb_ids`.
        hand: (F, 51) float32 rotation vector (rad), 45 coefficients of the finger pose, translation
            (m); zero in frames without a hand.
    """

    meta: SequenceMeta
    world_from_tag: Float64
    betas: tuple[float, ...]
    objects: Float32
    hand: Float32


def read_sequence(sequence: SequenceFolder) -> RawSequence:
    """Read a recording and its calibration.

    Raises:
        DataNotFoundError: A file is missing.
        DataFormatError: A file is damaged, or has a motion that HandoverSim cannot resample.
    """
    meta = read_meta(sequence)
    objects, hand = _read_poses(sequence.folder / POSE_FILE, len(meta.ycb_ids))
    return RawSequence(
        meta=meta,
        world_from_tag=read_world_from_tag(sequence.calibration, meta.extrinsics),
        betas=read_betas(sequence.calibration, meta.mano_calib),
        objects=objects,
        hand=hand,
    )


def read_world_from_tag(calibration: Path, extrinsics: str) -> Float64:
    """Read the pose (3, 4) [R | t] of the AprilTag in the world frame (m).

    Args:
        calibration: DexYCB's folder `calibration/`.
        extrinsics: Name of the extrinsic calibration, e.g. "20200702_151821".

    Raises:
        DataNotFoundError: The calibration file is missing.
        DataFormatError: The calibration file has no valid pose of the tag.
    """
    path = calibration / f"extrinsics_{extrinsics}" / "extrinsics.yml"
    poses = read_yaml_mapping(path).get("extrinsics")
    if not isinstance(poses, dict) or "apriltag" not in poses:
        raise damaged_file_error(path, "it has no extrinsics of the apriltag")
    pose = np.array(
        _check_numbers(path, poses["apriltag"], 12, "apriltag", _MAX_ABS_EXTRINSIC), dtype=np.float64
    ).reshape(3, 4)
    rotation = pose[:, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHOGONALITY_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise damaged_file_error(path, "the rotation of apriltag is not orthogonal")
    return pose


def read_betas(calibration: Path, mano: str) -> tuple[float, ...]:
    """Read MANO's ten shape parameters of a hand.

    Args:
        calibration: DexYCB's folder `calibration/`.
        mano: Name of the shape calibration, e.g. "20200709_140042_subject-01_right".

    Raises:
        DataNotFoundError: The calibration file is missing.
        DataFormatError: The calibration file has no ten numbers in the valid range.
    """
    path = calibration / f"mano_{mano}" / "mano.yml"
    return tuple(_check_numbers(path, read_yaml_mapping(path).get("betas"), N_BETAS, "betas", MAX_ABS_BETA))


def read_yaml_mapping(path: Path) -> dict[object, object]:
    """Read a YAML file of DexYCB that holds a mapping.

    Raises:
        DataNotFoundError: The file is missing or cannot be opened.
        DataFormatError: The file is not a plain YAML mapping.
    """
    try:
        content = read_yaml(path, _MAX_YAML_BYTES)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataNotFoundError(
            f"{path} is missing; the download is incomplete, expand DexYCB's archives again"
        ) from error
    except OSError as error:
        raise DataNotFoundError(f"{path} cannot be read ({error.strerror or error}); check its rights") from error
    except ValueError as error:
        raise damaged_file_error(path, str(error)) from error
    if not isinstance(content, dict):
        raise damaged_file_error(path, "no keys")
    return content


def damaged_file_error(path: Path, fault: str) -> DataFormatError:
    """Return an error for a damaged file of DexYCB."""
    return DataFormatError(f"{path}: not as DexYCB writes it ({fault}); expand DexYCB's archives again")


def _check_numbers(path: Path, values: object, count: int, name: str, bound: float) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise damaged_file_error(path, f"{name} is {shorten_text(values)}, expected {count} numbers")
    for value in values:
        if type(value) not in (int, float) or not abs(value) <= bound:
            # YAML 1.1 reads a number without a decimal point, such as 1e-5, as text.
            kind = "the text " if isinstance(value, str) else ""
            raise damaged_file_error(
                path, f"{name} holds {kind}{shorten_text(value)}, expected finite numbers within +-{bound:g}"
            )
    return list(values)


def read_meta(sequence: SequenceFolder) -> SequenceMeta:
    """Read a recording's meta.yml.

    Raises:
        DataNotFoundError: The file is missing.
        DataFormatError: The file lacks a key, or has an invalid object, hand or calibration name.
    """
    path = sequence.folder / META_FILE
    content = read_yaml_mapping(path)
    try:
        ids = [require_integer(number) for number in _require_list(content["ycb_ids"])]
        grasped, sides = require_integer(content["ycb_grasp_ind"]), _require_list(content["mano_sides"])
        calibrations, extrinsics = _require_list(content["mano_calib"]), _parse_identifier(content["extrinsics"])
        if len(calibrations) != 1:
            raise ValueError(f"mano_calib is {calibrations}, expected one hand")
        mano_calib = _parse_identifier(calibrations[0])
        check_scene_meta(path, ids, grasped, sides)
        if len(set(ids)) < len(ids):
            raise ValueError(f"ycb_ids {ids} names an object twice")
    except DataFormatError:
        raise
    except KeyError as error:
        raise damaged_file_error(path, f"it has no {error.args[0]}") from error
    except (ValueError, TypeError) as error:
        raise damaged_file_error(path, shorten_text(str(error))) from error
    return SequenceMeta(extrinsics, tuple(ids), grasped, str(sides[0]), mano_calib)


def _require_list(value: object) -> list[object]:
    if not isinstance(value, list):
        raise TypeError(f"{shorten_text(value)} where a list belongs")
    return value


def _parse_identifier(value: object) -> str:
    """Return an identifier as text; YAML 1.1 reads 20200702_151821 without quotes as a number."""
    text = value
    if type(value) is int and 10**13 <= value < 10**14:
        digits = str(value)
        text = f"{digits[:8]}_{digits[8:]}"
    if not isinstance(text, str) or not _IDENTIFIER.fullmatch(text):
        raise TypeError(f"{shorten_text(value)} is no id; write ids in quotes, such as '20200702_151821'")
    return text


def _read_poses(path: Path, n_objects: int) -> tuple[Float32, Float32]:
    try:
        arrays = read_arrays(path, ("pose_y", "pose_m"), _MAX_POSE_BYTES)
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise damaged_file_error(path, shorten_text(error)) from error
    objects, hand = arrays["pose_y"], arrays["pose_m"]
    _check_array(path, "pose_y", objects, (n_objects, 7))
    _check_array(path, "pose_m", hand, (1, HAND_DOF))
    if len(hand) != len(objects):
        raise damaged_file_error(path, f"pose_y has {len(objects)} frames, pose_m {len(hand)}")
    # Also converts to the machine's byte order.
    objects, hand = objects.astype(np.float32), hand[:, 0].astype(np.float32)
    _check_length(path, len(objects))
    _check_objects(path, objects)
    _check_hand(path, hand)
    return objects, hand


def _check_array(path: Path, name: str, array: npt.NDArray[np.generic], shape: tuple[int, ...]) -> None:
    if array.dtype.newbyteorder("=") != np.float32:
        raise damaged_file_error(path, f"{name} is {array.dtype}, expected float32")
    if array.ndim != 3 or array.shape[1:] != shape:
        raise damaged_file_error(path, f"{name} has shape {array.shape}, expected (F, {shape[0]}, {shape[1]})")
    if not (np.abs(array) < _MAX_ABS_POSE).all():
        raise damaged_file_error(path, f"{name} holds values that are not finite, or beyond {_MAX_ABS_POSE:g} m or rad")


def _check_length(path: Path, n_keyframes: int) -> None:
    if n_keyframes < MIN_KEYFRAMES:
        raise damaged_file_error(path, f"{n_keyframes} frames, expected at least {MIN_KEYFRAMES}")
    if not can_original_resample(n_keyframes):
        raise DataFormatError(
            f"{path}: {n_keyframes} frames, a number for which HandoverSim's conversion fails; "
            "DexYCB's recordings have 66 to 76"
        )


def _check_objects(path: Path, objects: Float32) -> None:
    norms = np.linalg.norm(objects[:, :, :4].astype(np.float64), axis=2)
    wrong = np.argwhere(np.abs(norms - 1.0) > _NORM_TOLERANCE)
    if len(wrong):
        frame, number = wrong[0]
        fault = "is absent" if norms[frame, number] == 0.0 else "has no unit quaternion"
        raise damaged_file_error(path, f"object {number} {fault} in frame {frame}; every frame needs all objects")


def _check_hand(path: Path, hand: Float32) -> None:
    present = np.flatnonzero(hand.any(axis=1))
    if len(present) < MIN_KEYFRAMES:
        raise damaged_file_error(path, f"{len(present)} frames with a hand, expected at least {MIN_KEYFRAMES}")
    gaps = np.flatnonzero(np.diff(present) > 1)
    if len(gaps):
        raise damaged_file_error(
            path, f"the hand is absent in frame {present[gaps[0]] + 1}, between others that have it"
        )
