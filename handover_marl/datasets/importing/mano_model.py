"""MANO's model of a hand: a mesh that ten numbers shape, its joints and the principal components of its poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from handover_marl.datasets.importing.mano_pickle import read_mano_pickle
from handover_marl.errors import DataFormatError, OptionError, UnknownNameError

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SIDES = ("right", "left")
N_VERTICES, N_FACES, N_JOINTS, N_BETAS, N_ANGLES = 778, 1538, 16, 10, 45

#: The joint that each joint hangs on: the wrist, then index, middle, little, ring finger and thumb, three joints each.
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)

# Key in the file -> shape, and a bound that no hand comes near (m, rad, or 1), which tells other units and damage.
_NUMBERS = {
    "v_template": ((N_VERTICES, 3), 1.0),
    "shapedirs": ((N_VERTICES, 3, N_BETAS), 1.0),
    "J_regressor": ((N_JOINTS, N_VERTICES), 10.0),
    "weights": ((N_VERTICES, N_JOINTS), 2.0),
    "hands_components": ((N_ANGLES, N_ANGLES), 100.0),
    "hands_mean": ((N_ANGLES,), 100.0),
}
_INDICES = {"f": (N_FACES, 3), "kintree_table": (2, N_JOINTS)}
_LARGEST_BETA = 100.0


@dataclass(frozen=True, eq=False)
class ManoModel:
    """One hand of MANO. Lengths in m, angles in rad; all arrays are read-only.

    Attributes:
        side: "right" or "left".
        v_template: (778, 3) vertices of the mean hand at rest.
        shapedirs: (778, 3, 10) how the vertices move with each beta.
        j_regressor: (16, 778) joints as weighted sums of vertices.
        weights: (778, 16) how far each vertex goes with each joint.
        faces: (1538, 3) vertices of each triangle.
        parents: (16,) the joint that each joint hangs on, -1 for the wrist.
        hands_components: (45, 45) principal components of the fingers' rotation vectors, one a row.
        hands_mean: (45,) their mean.
    """

    side: str
    v_template: Array
    shapedirs: Array
    j_regressor: csc_matrix
    weights: Array
    faces: Indices
    parents: Indices
    hands_components: Array
    hands_mean: Array

    def shaped_vertices(self, betas: Sequence[float] | Array) -> Array:
        """Vertices (778, 3) of a person's hand at rest, m.

        Args:
            betas: (10,) numbers that describe the person's hand.

        Raises:
            OptionError: They are not ten finite numbers of a plausible size.
        """
        shape = _checked_betas(betas)
        # One beta after the other, because a product of matrices may fuse or reorder the sums, and bits would differ.
        moved = self.shapedirs[:, :, 0] * shape[0]
        for number in range(1, N_BETAS):
            moved += self.shapedirs[:, :, number] * shape[number]
        vertices: Array = self.v_template + moved
        return vertices

    def joints(self, vertices: Array) -> Array:
        """Joints (16, 3) of a shaped hand at rest, m.

        Args:
            vertices: (778, 3) as from `shaped_vertices`.

        Raises:
            OptionError: There are more or fewer vertices.
        """
        if np.shape(vertices) != (N_VERTICES, 3):
            raise OptionError(f"vertices must have shape ({N_VERTICES}, 3), found {np.shape(vertices)}")
        found = np.zeros((N_JOINTS, 3))
        matrix = self.j_regressor
        # In the order of the vertices and without fusing, as scipy did when the official models were made.
        for vertex, (start, end) in enumerate(zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True)):
            for element in range(start, end):
                found[matrix.indices[element]] += matrix.data[element] * vertices[vertex]
        return found

    def wrist(self, betas: Sequence[float] | Array) -> Array:
        """The root joint (3,) of a person's hand at rest (m), about which the whole hand turns.

        Args:
            betas: As for `shaped_vertices`.

        Raises:
            OptionError: As `shaped_vertices`.
        """
        root: Array = self.joints(self.shaped_vertices(betas))[0]
        return root


def read_mano_model(path: Path, side: str) -> ManoModel:
    """Read one of MANO's model files.

    Args:
        path: `MANO_RIGHT.pkl` or `MANO_LEFT.pkl` of mano_v1_2.zip.
        side: "right" or "left"; the file does not tell.

    Raises:
        UnknownNameError: There is no such side.
        DataNotFoundError: There is no such file.
        UnsafeFileError: The pickle asks for something other than a model consists of.
        DataFormatError: It is no model, or something in it has the wrong shape, type or range.
    """
    if side not in SIDES:
        raise UnknownNameError("side", side, SIDES)
    content = read_mano_pickle(path, (*_NUMBERS, *_INDICES))
    matrix = _checked_matrix(path, "J_regressor", content["J_regressor"])
    numbers = {key: _checked_numbers(path, key, content[key]) for key in _NUMBERS if key != "J_regressor"}
    indices = {key: _checked_indices(path, key, content[key]) for key in _INDICES}
    return ManoModel(
        side=side,
        v_template=numbers["v_template"],
        shapedirs=numbers["shapedirs"],
        j_regressor=matrix,
        weights=numbers["weights"],
        faces=_faces(path, indices["f"]),
        parents=_parents(path, indices["kintree_table"]),
        hands_components=numbers["hands_components"],
        hands_mean=numbers["hands_mean"],
    )


def _bad(path: Path, reason: str) -> DataFormatError:
    return DataFormatError(f"{path}: {reason}; take the file from the original mano_v1_2.zip")


def _checked_numbers(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> Array:
    """An array of float64 in the machine's byte order."""
    _check_type(path, key, value)
    if isinstance(value, csc_matrix):
        raise _bad(path, f"{key} must be an array, found a sparse matrix")
    array = np.ascontiguousarray(value, dtype=np.float64)
    _check_range(path, key, array)
    array.flags.writeable = False
    return array


def _checked_matrix(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> csc_matrix:
    """A sparse matrix of float64, which may have been written as an array."""
    _check_type(path, key, value)
    matrix = value if isinstance(value, csc_matrix) else csc_matrix(np.asarray(value, dtype=np.float64))
    _check_range(path, key, matrix.data)
    for part in (matrix.data, matrix.indices, matrix.indptr):
        part.flags.writeable = False
    return matrix


def _check_type(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> None:
    shape, _ = _NUMBERS[key]
    if value.shape != shape:
        raise _bad(path, f"{key} must have shape {shape}, found {value.shape}")
    # Other floats have been rounded on the way, and nothing that is made of them would equal the official files.
    if value.dtype.kind != "f" or value.dtype.itemsize != 8:
        raise _bad(path, f"{key} must be float64, found {value.dtype}")


def _check_range(path: Path, key: str, numbers: Array) -> None:
    _, bound = _NUMBERS[key]
    if not np.isfinite(numbers).all():
        raise _bad(path, f"{key} has numbers that are not finite")
    if np.abs(numbers).max(initial=0.0) > bound:
        raise _bad(path, f"{key} has numbers beyond {bound:g}, which no hand in metres and radians has")


def _checked_indices(path: Path, key: str, value: npt.NDArray[Any] | csc_matrix) -> npt.NDArray[Any]:
    shape = _INDICES[key]
    if isinstance(value, csc_matrix) or value.shape != shape or value.dtype.kind not in "iu":
        raise _bad(path, f"{key} must be whole numbers of shape {shape}, found {value.dtype} of shape {value.shape}")
    return value


def _faces(path: Path, found: npt.NDArray[Any]) -> Indices:
    if found.min() < 0 or found.max() >= N_VERTICES:
        raise _bad(path, "f names a vertex that is not there")
    faces = np.ascontiguousarray(found, dtype=np.int64)
    faces.flags.writeable = False
    return faces


def _parents(path: Path, table: npt.NDArray[Any]) -> Indices:
    # Official files have -1 as an unsigned number of 32 bits.
    parents = [-1 if int(number) in (2**32 - 1, 2**64 - 1) else int(number) for number in table[0]]
    if tuple(parents) != PARENTS or table[1].tolist() != list(range(N_JOINTS)):
        raise _bad(path, "kintree_table is not the tree of MANO's joints")
    found = np.array(parents, dtype=np.int64)
    found.flags.writeable = False
    return found


def _checked_betas(betas: Sequence[float] | Array) -> Array:
    try:
        shape = np.asarray(betas, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        shape = np.empty(0)
    if shape.shape != (N_BETAS,) or not np.isfinite(shape).all() or np.abs(shape).max() > _LARGEST_BETA:
        raise OptionError(f"betas must be {N_BETAS} finite numbers within +-{_LARGEST_BETA:g}, found {betas!r:.200}")
    return shape
