"""One recording of raw DexYCB: what its meta.yml, its pose.npz and the calibration that it names say."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF
from handover_marl.datasets.importing.raw_calibration import damaged, read_betas, read_mapping, read_world_from_tag
from handover_marl.datasets.importing.raw_layout import META_FILE, POSE_FILE, SequenceFolder
from handover_marl.datasets.importing.upsampling import FEWEST_KEYS, original_can
from handover_marl.datasets.official import check_meta, whole
from handover_marl.errors import DataFormatError
from handover_marl.files import brief, read_arrays

Float32 = npt.NDArray[np.float32]

_LARGEST = 2_000_000  # bytes of a recording's arrays, unpacked; real ones have some ten thousand
_NORM_TOLERANCE = 0.1
_FARTHEST = 1000.0  # m or rad; no recorded value is near it
_ID = re.compile(r"[\w-]+", re.ASCII)


@dataclass(frozen=True)
class SequenceMeta:
    """A recording's meta.yml.

    Attributes:
        extrinsics: Which calibration of the cameras and the tag.
        ycb_ids: Class numbers of the objects present.
        ycb_grasp_ind: Which of these is handed over.
        side: "right" or "left".
        mano_calib: Which calibration of the hand's shape.
    """

    extrinsics: str
    ycb_ids: tuple[int, ...]
    ycb_grasp_ind: int
    side: str
    mano_calib: str


@dataclass(frozen=True, eq=False)
class RawSequence:
    """A recording.

    Attributes:
        meta: Its meta.yml.
        world_from_tag: (3, 4) [R | t], the tag's pose in the frame of the recording (m).
        betas: Ten shape parameters of the hand, as written in the file.
        objects: (F, n, 7) float32 quaternion xyzw and position (m) of the objects, in the order of `meta.ycb_ids`.
        hand: (F, 51) float32 rotation vector (rad), 45 pose coefficients, translation (m); zero without a hand.
    """

    meta: SequenceMeta
    world_from_tag: npt.NDArray[np.float64]
    betas: tuple[float, ...]
    objects: Float32
    hand: Float32


def read_sequence(sequence: SequenceFolder) -> RawSequence:
    """Read a recording and the calibration that it names.

    Raises:
        DataNotFoundError: A file is missing.
        DataFormatError: One is damaged, or holds a motion that cannot be resampled.
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


def read_meta(sequence: SequenceFolder) -> SequenceMeta:
    """A recording's meta.yml.

    Raises:
        DataNotFoundError: It is missing.
        DataFormatError: It lacks something, or names an object, a hand or a calibration that cannot be.
    """
    path = sequence.folder / META_FILE
    content = read_mapping(path)
    try:
        ids = [whole(number) for number in _list(content["ycb_ids"])]
        grasped, sides = whole(content["ycb_grasp_ind"]), _list(content["mano_sides"])
        calibrations, extrinsics = _list(content["mano_calib"]), _identifier(content["extrinsics"])
        if len(calibrations) != 1:
            raise ValueError(f"mano_calib is {calibrations}, expected one hand")
        mano_calib = _identifier(calibrations[0])
        check_meta(path, ids, grasped, sides)
        if len(set(ids)) < len(ids):
            raise ValueError(f"ycb_ids {ids} names an object twice")
    except DataFormatError:
        raise
    except KeyError as error:
        raise damaged(path, f"it has no {error.args[0]}") from error
    except (ValueError, TypeError) as error:
        raise damaged(path, brief(str(error))) from error
    return SequenceMeta(extrinsics, tuple(ids), grasped, str(sides[0]), mano_calib)


def _list(value: object) -> list[object]:
    if not isinstance(value, list):
        raise TypeError(f"{brief(value)} where a list belongs")
    return value


def _identifier(value: object) -> str:
    """An id as text; YAML 1.1 takes one without quotes, such as 20200702_151821, for a number."""
    text = value
    if type(value) is int and 10**13 <= value < 10**14:
        digits = str(value)
        text = f"{digits[:8]}_{digits[8:]}"
    if not isinstance(text, str) or not _ID.fullmatch(text):
        raise TypeError(f"{brief(value)} is no id; write ids in quotes, such as '20200702_151821'")
    return text


def _read_poses(path: Path, n_objects: int) -> tuple[Float32, Float32]:
    try:
        arrays = read_arrays(path, ("pose_y", "pose_m"), _LARGEST)
    except Exception as error:  # what damaged bytes raise has no end
        raise damaged(path, brief(error)) from error
    objects, hand = arrays["pose_y"], arrays["pose_m"]
    _check_array(path, "pose_y", objects, (n_objects, 7))
    _check_array(path, "pose_m", hand, (1, HAND_DOF))
    if len(hand) != len(objects):
        raise damaged(path, f"pose_y has {len(objects)} frames, pose_m {len(hand)}")
    # Not in the machine's byte order, in which arithmetic would leave them.
    objects, hand = objects.astype(np.float32), hand[:, 0].astype(np.float32)
    _check_length(path, len(objects))
    _check_objects(path, objects)
    _check_hand(path, hand)
    return objects, hand


def _check_array(path: Path, name: str, array: npt.NDArray[np.generic], shape: tuple[int, ...]) -> None:
    if array.dtype.newbyteorder("=") != np.float32:
        raise damaged(path, f"{name} is {array.dtype}, expected float32")
    if array.ndim != 3 or array.shape[1:] != shape:
        raise damaged(path, f"{name} has shape {array.shape}, expected (F, {shape[0]}, {shape[1]})")
    if not (np.abs(array) < _FARTHEST).all():
        raise damaged(path, f"{name} holds values that are not finite, or beyond {_FARTHEST:g} m or rad")


def _check_length(path: Path, n_keys: int) -> None:
    if n_keys < FEWEST_KEYS:
        raise damaged(path, f"{n_keys} frames, expected at least {FEWEST_KEYS}")
    if not original_can(n_keys):
        raise DataFormatError(
            f"{path}: {n_keys} frames, a number at which HandoverSim's own conversion stops, so that there is nothing "
            "to be equal to; DexYCB's recordings have 66 to 76"
        )


def _check_objects(path: Path, objects: Float32) -> None:
    norms = np.linalg.norm(objects[:, :, :4].astype(np.float64), axis=2)
    wrong = np.argwhere(np.abs(norms - 1.0) > _NORM_TOLERANCE)
    if len(wrong):
        frame, number = wrong[0]
        what = "is absent" if norms[frame, number] == 0.0 else "has no unit quaternion"
        raise damaged(path, f"object {number} {what} in frame {frame}; objects must be there in every frame")


def _check_hand(path: Path, hand: Float32) -> None:
    present = np.flatnonzero(hand.any(axis=1))
    if len(present) < FEWEST_KEYS:
        raise damaged(path, f"{len(present)} frames with a hand, expected at least {FEWEST_KEYS}")
    gaps = np.flatnonzero(np.diff(present) > 1)
    if len(gaps):
        raise damaged(path, f"the hand is absent in frame {present[gaps[0]] + 1}, between others that have it")
