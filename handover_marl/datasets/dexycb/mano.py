"""Hand model of MANO: mesh template, shape space, joints and principal components of finger poses.

Source: Romero, Tzionas and Black, Embodied Hands, SIGGRAPH Asia 2017. Sums are written out in the
order that made HandoverSim's files; matrix products would round differently on some machines.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from handover_marl.datasets.dexycb.mano_pickle import read_mano_pickle
from handover_marl.errors import DataFormatError, OptionError, check_name

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SIDES = ("right", "left")
N_VERTICES, N_FACES, N_JOINTS, N_BETAS, N_ANGLES = 778, 1538, 16, 10, 45

#: Parent of every joint: the wrist (no parent, -1), then three joints each of index, middle,
#: little and ring finger and thumb.
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
#: Bound on the absolute value of shape parameters.
MAX_ABS_BETA = 100.0

# Shape of every array by key, and a bound (m, rad or 1) that only damaged files and other units exceed.
_NUMBERS = {
    "v_template": ((N_VERTICES, 3), 1.0),
    "shapedirs": ((N_VERTICES, 3, N_BETAS), 1.0),
    "J_regressor": ((N_JOINTS, N_VERTICES), 10.0),
    "weights": ((N_VERTICES, N_JOINTS), 2.0),
    "hands_components": ((N_ANGLES, N_ANGLES), 100.0),
    "hands_mean": ((N_ANGLES,), 100.0),
}
_INDICES = {"f": (N_FACES, 3), "kintree_table": (2, N_JOINTS)}
_MIRROR_TOLERANCE = 1e-3  # m between the vertices of a hand and of the mirrored other hand
_MIN_INDEX_DISTANCE = 0.03  # m along x from the wrist to the root of an adult's index finger
_INDEX_ROOT_JOINT = 1


@dataclass(frozen=True, eq=False)
class ManoModel:
    """MANO's model of one hand (m, rad); all arrays are read-only.

    Attributes:
        side: "right" or "left".
        v_template: (778, 3) vertices of the mean hand at rest.
        shapedirs: (778, 3, 10) displacement of the vertices per unit of each shape parameter.
        j_regressor: (16, 778) weights of the vertices in the joint positions.
        weights: (778, 16) skinning weights.
        faces: (1538, 3) vertex indices of the triangles.
        hands_components: (45, 45) principal components of the finger rotation vectors, as rows.
        hands_mean: (45,) mean of the finger rotation vectors.
    """

    side: str
    v_template: Array
    shapedirs: Array
    j_regressor: csc_matrix
    weights: Array
    faces: Indices
    hands_components: Array
    hands_mean: Array

    def shape_vertices(self, betas: Sequence[float] | Array) -> Array:
        """Return the vertices (778, 3) (m) of a subject's hand at rest.

        Args:
            betas: (10,) shape parameters of the subject.

        Raises:
            OptionError: `betas` are not ten finite numbers within +-`MAX_ABS_BETA`.
        """
        shape = _check_betas(betas)
        displacements = self.shapedirs[:, :, 0] * shape[0]
        for number in range(1, N_BETAS):
            displacements += self.shapedirs[:, :, number] * shape[number]
        vertices: Array = self.v_template + displacements
        return vertices

    def regress_joints(self, vertices: Array) -> Array:
        """Return the joints (16, 3) (m) of a hand at rest.

        Args:
            vertices: (778, 3) vertices (m) as returned by `shape_vertices`.

        Raises:
            OptionError: `vertices` have another shape.
        """
        if np.shape(vertices) != (N_VERTICES, 3):
            raise OptionError(f"vertices must have shape ({N_VERTICES}, 3), got {np.shape(vertices)}")
        joints = np.zeros((N_JOINTS, 3))
        matrix = self.j_regressor
        for vertex, (start, end) in enumerate(zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True)):
            for element in range(start, end):
                joints[matrix.indices[element]] += matrix.data[element] * vertices[vertex]
        return joints

    def locate_wrist(self, betas: Sequence[float] | Array) -> Array:
        """Return the root joint (3,) (m) of a subject's hand at rest, its center of rotation.

        Args:
            betas: (10,) shape parameters of the subject.

        Raises:
            OptionError: `betas` are not ten finite numbers within +-`MAX_ABS_BETA`.
        """
        root: Array = self.regress_joints(self.shape_vertices(betas))[0]
        return root


def read_mano_model(path: Path, side: str) -> ManoModel:
    """Read a model file of MANO.

    Args:
        path: `MANO_RIGHT.pkl` or `MANO_LEFT.pkl` of mano_v1_2.zip.
        side: "right" or "left"; the file does not hold its side.

    Raises:
        UnknownNameError: `side` is neither "right" nor "left".
        DataNotFoundError: The file is missing.
        UnsafeFileError: The file may run code.
        DataFormatError: The file is not a model, or an array has an invalid shape, type or range.
    """
    check_name("side", side, SIDES)
    content = read_mano_pickle(path, (*_NUMBERS, *_INDICES))
    matrix = _check_matrix(path, "J_regressor", content["J_regressor"])
    _check_parents(path, _check_indices(path, "kintree_table", content["kintree_table"]))
    numbers = {key: _check_numbers(path, key, content[key]) for key in _NUMBERS if key != "J_regressor"}
    return ManoModel(
        side=side,
        v_template=numbers["v_template"],
        shapedirs=numbers["shapedirs"],
        j_regressor=matrix,
        weights=numbers["weights"],
        faces=_check_faces(path, _check_indices(path, "f", content["f"])),
        hands_components=numbers["hands_components"],
        hands_mean=numbers["hands_mean"],
    )


def check_hand_sides(right: ManoModel, left: ManoModel) -> list[str]:
    """Return warnings if two model files are the same hand or have exchanged names.

    MANO's left hand is its right hand with x negated. At rest the fingers of the right hand point
    to -x. Hands that are not mirrored cannot be checked.

    Args:
        right: Content of `MANO_RIGHT.pkl`.
        left: Content of `MANO_LEFT.pkl`.
    """
    if np.array_equal(right.v_template, left.v_template):
        return ["MANO_RIGHT.pkl and MANO_LEFT.pkl hold the same hand; take both from the original mano_v1_2.zip"]
    mirrored = right.v_template * [-1.0, 1.0, 1.0]
    if (
        np.abs(mirrored - left.v_template).max() <= _MIRROR_TOLERANCE
        and _measure_index_distance(right) > _MIN_INDEX_DISTANCE
        and _measure_index_distance(left) < -_MIN_INDEX_DISTANCE
    ):
        return [
            "MANO_RIGHT.pkl seems to hold the left hand and MANO_LEFT.pkl the right one; if so, exchange their names "
            "and import into an empty folder"
        ]
    return []


def _measure_index_distance(model: ManoModel) -> float:
    """Return the distance (m) along x from the wrist to the root of the mean hand's index finger."""
    joints = model.regress_joints(model.v_template)
    return float(joints[_INDEX_ROOT_JOINT, 0] - joints[0, 0])


def _model_error(path: Path, reason: str) -> DataFormatError:
    return DataFormatError(f"{path}: {reason}; take the file from the original mano_v1_2.zip")


def _check_numbers(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> Array:
    _check_type(path, key, value)
    if isinstance(value, csc_matrix):
        raise _model_error(path, f"{key} must be an array, found a sparse matrix")
    array = np.ascontiguousarray(value, dtype=np.float64)
    _check_range(path, key, array)
    array.flags.writeable = False
    return array


def _check_matrix(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> csc_matrix:
    """Return a sparse matrix, from a sparse or dense one."""
    _check_type(path, key, value)
    matrix = value if isinstance(value, csc_matrix) else csc_matrix(np.asarray(value, dtype=np.float64))
    _check_range(path, key, matrix.data)
    for part in (matrix.data, matrix.indices, matrix.indptr):
        part.flags.writeable = False
    return matrix


def _check_type(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> None:
    shape, _ = _NUMBERS[key]
    if value.shape != shape:
        raise _model_error(path, f"{key} must have shape {shape}, found {value.shape}")
    # Rounded values could not give HandoverSim's files.
    if value.dtype.kind != "f" or value.dtype.itemsize != 8:
        raise _model_error(path, f"{key} must be float64, found {value.dtype}")


def _check_range(path: Path, key: str, numbers: Array) -> None:
    _, bound = _NUMBERS[key]
    if not np.isfinite(numbers).all():
        raise _model_error(path, f"{key} has numbers that are not finite")
    if np.abs(numbers).max(initial=0.0) > bound:
        raise _model_error(path, f"{key} has numbers beyond {bound:g}, which no hand in metres and radians has")


def _check_indices(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> npt.NDArray[Any]:
    shape = _INDICES[key]
    if isinstance(value, csc_matrix) or value.shape != shape or value.dtype.kind not in "iu":
        raise _model_error(path, f"{key} must be integers of shape {shape}, found {value.dtype} of shape {value.shape}")
    return value


def _check_faces(path: Path, values: npt.NDArray[Any]) -> Indices:
    if values.min() < 0 or values.max() >= N_VERTICES:
        raise _model_error(path, "f has the index of a vertex that does not exist")
    faces = np.ascontiguousarray(values, dtype=np.int64)
    faces.flags.writeable = False
    return faces


def _check_parents(path: Path, table: npt.NDArray[Any]) -> None:
    # Official files have -1 as an unsigned number of 32 bits.
    parents = [-1 if int(number) in (2**32 - 1, 2**64 - 1) else int(number) for number in table[0]]
    if tuple(parents) != PARENTS or table[1].tolist() != list(range(N_JOINTS)):
        raise _model_error(path, "kintree_table is not the tree of MANO's joints")


def _check_betas(betas: Sequence[float] | Array) -> Array:
    try:
        shape = np.asarray(betas, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        shape = np.empty(0)
    if shape.shape != (N_BETAS,) or not np.isfinite(shape).all() or np.abs(shape).max() > MAX_ABS_BETA:
        raise OptionError(f"betas must be {N_BETAS} finite numbers within +-{MAX_ABS_BETA:g}, got {betas!r:.200}")
    return shape
