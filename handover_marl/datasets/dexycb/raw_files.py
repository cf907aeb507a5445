"""Recordings in a folder of raw DexYCB, their scene numbers and their content.

<raw>/<subject>/<sequence>/meta.yml, pose.npz   (camera folders are not read)
<raw>/calibration/                              camera extrinsics and hand shapes

A scene number is 100 * subject + the rank of the recording's name among the names of the subject's
recordings. Known DexYCB names have their official rank, even if other recordings are missing. A
subject with other names must have all 100 recordings.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from handover_marl.config import HAND_DOF
from handover_marl.datasets.dexycb.mano import N_BETAS
from handover_marl.datasets.dexycb.mano_rotations import MIN_KEYFRAMES, Float32, Float64
from handover_marl.datasets.official import check_scene_meta, read_motion
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_yaml, report_damage
from handover_marl.geometry.ycb import SUBJECTS

SEQUENCES_PER_SUBJECT = 100
_KIND_AND_ADVICE = "file of DexYCB", "the download may be incomplete, expand DexYCB's archives again"
_MAX_YAML_BYTES = 64_000  # official files have a few thousand


@dataclass(frozen=True)
class SequenceFolder:
    """Folder of one recording.

    Attributes:
        scene_id: Scene number, 0 to 999.
        name: `<subject>/<sequence>`.
        folder: Folder with `meta.yml` and `pose.npz`.
    """

    scene_id: int
    name: str
    folder: Path

    @property
    def subject(self) -> str:
        """Name of the subject, e.g. `20200709-subject-01`."""
        return self.name.partition("/")[0]

    @property
    def calibration(self) -> Path:
        """Folder of the camera extrinsics and hand shapes."""
        return self.folder.parents[1] / "calibration"


@cache
def read_sequence_names() -> MappingProxyType[str, tuple[str, ...]]:
    """Return the names of DexYCB's 100 recordings of each subject, in the order of their scene numbers, by subject."""
    lines = (files(__package__) / "sequence_names.txt").read_text().splitlines()
    pairs = [line.split("/") for line in lines if not line.startswith("#")]
    return MappingProxyType({subject: tuple(name for owner, name in pairs if owner == subject) for subject in SUBJECTS})


def find_sequences(raw: Path) -> tuple[list[SequenceFolder], list[str]]:
    """Find all recordings in a folder of raw DexYCB.

    Returns:
        Recordings in the order of their scene numbers, and messages on what is missing, with path, reason and advice.

    Raises:
        DataNotFoundError: The folder is missing, or holds no calibration.
    """
    if not (raw / "calibration").is_dir():
        raise DataNotFoundError(
            f"{raw} is no raw DexYCB folder: it holds no calibration/. Give the folder that DexYCB's archives, also "
            "calibration.tar.gz, were expanded into."
        )
    sequences, missing = list[SequenceFolder](), list[str]()
    for number, subject in enumerate(SUBJECTS):
        folder, known = raw / subject, read_sequence_names()[subject]
        found = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
        names = found if len(found) == SEQUENCES_PER_SUBJECT and not {*found} & {*known} else known
        sequences += [
            SequenceFolder(SEQUENCES_PER_SUBJECT * number + rank, f"{subject}/{name}", folder / name)
            for rank, name in enumerate(names)
            if name in found
        ]
        absent = [name for name in names if name not in found]
        if absent:
            missing.append(
                f"{folder} lacks {len(absent)} of {SEQUENCES_PER_SUBJECT} recordings, such as {absent[0]}; expand "
                f"DexYCB's {subject}.tar.gz there"
            )
    return sequences, missing


def read_sequence(sequence: SequenceFolder) -> tuple[dict[str, Any], Float64, tuple[float, ...], Float32, Float32]:
    """Read a recording and its calibration.

    Returns:
        Content of meta.yml (`read_meta`); pose (3, 4) [R | t] of the AprilTag in the world frame (m); MANO's ten shape
        parameters of the person's hand; float32 quaternions xyzw and positions (F, n, 7) in m of the objects, in the
        order of `ycb_ids`; and (F, 51) float32 of the hand: rotation vector (rad), 45 coefficients of the finger pose,
        translation (m), zero in frames without a hand.

    Raises:
        DataNotFoundError: A file is missing.
        DataFormatError: A file is damaged, or has hardly any frames with a hand.
    """
    meta = read_meta(sequence)
    objects, hand = _read_poses(sequence.folder / "pose.npz", len(meta["ycb_ids"]))
    extrinsics = sequence.calibration / f"extrinsics_{meta['extrinsics']}" / "extrinsics.yml"
    world_from_tag = _read_numbers(extrinsics, 12, "extrinsics", "apriltag").reshape(3, 4)
    return meta, world_from_tag, read_betas(sequence, meta), objects, hand


def read_betas(sequence: SequenceFolder, meta: dict[str, Any]) -> tuple[float, ...]:
    """Read MANO's ten shape parameters of the person's hand in a recording; `meta` is from `read_meta`.

    Raises:
        DataNotFoundError, DataFormatError: The calibration file is missing, or has no ten numbers.
    """
    path = sequence.calibration / f"mano_{meta['mano_calib'][0]}" / "mano.yml"
    return tuple(_read_numbers(path, N_BETAS, "betas").tolist())


def read_meta(sequence: SequenceFolder) -> dict[str, Any]:
    """Read a recording's meta.yml: `ycb_ids`, `ycb_grasp_ind`, `mano_sides`, `mano_calib` and `extrinsics`.

    Raises:
        DataNotFoundError: The file is missing.
        DataFormatError: The file lacks a key, or has an invalid object or hand.
    """
    path = sequence.folder / "meta.yml"
    with report_damage(path, *_KIND_AND_ADVICE):
        content: Any = read_yaml(path, _MAX_YAML_BYTES)
        meta = {key: content[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides", "mano_calib", "extrinsics")}
        check_scene_meta(path, meta["ycb_ids"], meta["ycb_grasp_ind"], meta["mano_sides"])
        (_,) = meta["mano_calib"]
    return meta


def _read_numbers(path: Path, count: int, *keys: str) -> Float64:
    """Read a list of `count` numbers from a YAML file of nested mappings, in which `keys` lead to the list."""
    with report_damage(path, *_KIND_AND_ADVICE):
        values: Any = read_yaml(path, _MAX_YAML_BYTES)
        for key in keys:
            values = values[key]
        numbers = np.array(values, dtype=np.float64)
        if numbers.shape != (count,) or not np.isfinite(numbers).all():
            raise ValueError(f"{shorten_text(values)} where {count} numbers belong")
    return numbers


def _read_poses(path: Path, n_objects: int) -> tuple[Float32, Float32]:
    objects, hand = read_motion(path, {"pose_y": (n_objects, 7), "pose_m": (1, HAND_DOF)}, _KIND_AND_ADVICE[1])
    if np.count_nonzero(hand.any(axis=(1, 2))) < MIN_KEYFRAMES:
        raise DataFormatError(f"{path}: {len(hand)} frames, of which few have a hand; {_KIND_AND_ADVICE[1]}")
    return objects, hand[:, 0]
