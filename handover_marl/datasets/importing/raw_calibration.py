"""DexYCB's calibration files: where the tag on the table is, and the shape of a person's hand."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.files import brief, read_yaml

Float64 = npt.NDArray[np.float64]

#: Shape parameters of a hand.
N_BETAS = 10
_LARGEST = 64_000  # bytes of a YAML file; real ones have a few thousand
_FARTHEST = 1e6  # no number of a pose is near it
_LARGEST_BETA = 100.0
_SQUARENESS = 1e-2  # how far a rotation matrix may be from orthogonal


def read_world_from_tag(calibration: Path, extrinsics: str) -> Float64:
    """The tag's pose (3, 4) [R | t] in the frame of the recordings (m).

    Args:
        calibration: The dataset's folder of that name.
        extrinsics: Which calibration, e.g. "20200702_151821".

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: It holds no pose of the tag.
    """
    path = calibration / f"extrinsics_{extrinsics}" / "extrinsics.yml"
    poses = read_mapping(path).get("extrinsics")
    if not isinstance(poses, dict) or "apriltag" not in poses:
        raise damaged(path, "it has no extrinsics of the apriltag")
    pose = np.array(_numbers(path, poses["apriltag"], 12, "apriltag", _FARTHEST), dtype=np.float64).reshape(3, 4)
    rotation = pose[:, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _SQUARENESS or np.linalg.det(rotation) < 0.0:
        raise damaged(path, "the rotation of apriltag is none")
    return pose


def read_betas(calibration: Path, mano: str) -> tuple[float, ...]:
    """Ten shape parameters of a hand, as the file writes them.

    Args:
        calibration: The dataset's folder of that name.
        mano: Which hand, e.g. "20200709_140042_subject-01_right".

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: It holds no ten numbers.
    """
    path = calibration / f"mano_{mano}" / "mano.yml"
    return tuple(_numbers(path, read_mapping(path).get("betas"), N_BETAS, "betas", _LARGEST_BETA))


def read_mapping(path: Path) -> dict[object, object]:
    """A YAML file of DexYCB.

    Raises:
        DataNotFoundError: It is not there or cannot be opened.
        DataFormatError: It is no plain YAML with keys.
    """
    try:
        content = read_yaml(path, _LARGEST)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataNotFoundError(
            f"{path} is missing; the download is incomplete, expand DexYCB's archives again"
        ) from error
    except OSError as error:
        raise DataNotFoundError(f"{path} cannot be read ({error.strerror or error}); check its rights") from error
    except ValueError as error:
        raise damaged(path, str(error)) from error
    if not isinstance(content, dict):
        raise damaged(path, "no keys")
    return content


def damaged(path: Path, fault: str) -> DataFormatError:
    """An error that names a file of DexYCB, what is wrong with it, and what to do."""
    return DataFormatError(f"{path}: not as DexYCB writes it ({fault}); expand DexYCB's archives again")


def _numbers(path: Path, values: object, count: int, name: str, bound: float) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise damaged(path, f"{name} is {brief(values)}, expected {count} numbers")
    for value in values:
        # True is an int too.
        if type(value) not in (int, float) or not abs(value) <= bound:
            kind = "the text " if isinstance(value, str) else ""  # which YAML 1.1 takes 1e-5 for, without a point
            raise damaged(path, f"{name} holds {kind}{brief(value)}, expected finite numbers within +-{bound:g}")
    return list(values)
