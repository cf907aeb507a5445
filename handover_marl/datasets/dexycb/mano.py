"""Hand model of MANO: mesh template, shape space, joints and principal components of finger poses.

Source: Romero, Tzionas and Black, Embodied Hands, SIGGRAPH Asia 2017. Sums are written out in the
order that made HandoverSim's files; matrix products would round differently on some machines.

Official model files are pickles of Python 2 with objects of NumPy, SciPy and chumpy. Files that other tools saved
again, with plain arrays instead of chumpy's objects, are accepted too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from handover_marl.datasets.restricted_pickle import AllowedNames, load_restricted
from handover_marl.execution.reading import read_plain_file, report_damage

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SIDES = ("right", "left")
N_JOINTS, N_BETAS, N_ANGLES = 16, 10, 45

#: Parent of every joint: the wrist (no parent, -1), then three joints each of index, middle,
#: little and ring finger and thumb.
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)

N_VERTICES, N_FACES = 778, 1538
# Shapes of the arrays in a file by their keys, in the order of the attributes of `ManoModel`.
_SHAPES = {
    "v_template": (N_VERTICES, 3),
    "shapedirs": (N_VERTICES, 3, N_BETAS),
    "J_regressor": (N_JOINTS, N_VERTICES),
    "weights": (N_VERTICES, N_JOINTS),
    "f": (N_FACES, 3),
    "hands_components": (N_ANGLES, N_ANGLES),
    "hands_mean": (N_ANGLES,),
}


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
    j_regressor: Array
    weights: Array
    faces: Indices
    hands_components: Array
    hands_mean: Array

    def shape_vertices(self, betas: Sequence[float] | Array) -> Array:
        """Return the vertices (778, 3) in m of a hand at rest with MANO's shape parameters (10,)."""
        displacements = self.shapedirs[:, :, 0] * betas[0]
        for number in range(1, N_BETAS):
            displacements += self.shapedirs[:, :, number] * betas[number]
        return np.asarray(self.v_template + displacements)

    def regress_joints(self, vertices: Array) -> Array:
        """Return the joints (16, 3) in m of a hand at rest with vertices (778, 3) from `shape_vertices`."""
        joints = np.zeros((N_JOINTS, 3))
        for weights, vertex in zip(self.j_regressor.T, vertices, strict=True):
            joints += weights[:, None] * vertex
        return joints

    def locate_wrist(self, betas: Sequence[float] | Array) -> Array:
        """Return the position (3,) of the wrist joint (m) in MANO's rest pose, for shape parameters (10,)."""
        return np.asarray(self.regress_joints(self.shape_vertices(betas))[0])


def read_mano_model(path: Path, side: str) -> ManoModel:
    """Read MANO's model of one hand from its file; raise `DataNotFoundError` or `DataFormatError` if that fails."""
    with report_damage(path, "MANO model", "copy it from mano_v1_2.zip, which MANO's site has for registered users"):
        content = load_restricted(read_plain_file(path), _ALLOWED)
        return ManoModel(side, *(_extract_array(key, content[key]) for key in _SHAPES))


def read_mano_models(folder: Path) -> dict[str, ManoModel]:
    """Read MANO's models from a folder, by side ("right", "left"); errors are as in `read_mano_model`."""
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in SIDES}


class _Record:
    """Placeholder for an object of chumpy or SciPy in a pickle: its `state`, without importing its class."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = state


_ALLOWED: AllowedNames = {
    # Sets hold bookkeeping of chumpy that is not needed.
    **{(module, "set"): lambda *_: [] for module in ("__builtin__", "builtins")},
    ("chumpy.ch", "Ch"): _Record,
    ("chumpy.reordering", "Select"): _Record,
    **{
        (f"scipy.sparse.{module}", f"csc_{kind}"): _Record for module in ("csc", "_csc") for kind in ("matrix", "array")
    },
}


def _extract_array(key: str, value: Any) -> npt.NDArray[Any]:
    """Return the value of `key` in a model file as a read-only NumPy array; raise `ValueError` if it is malformed."""
    array = _evaluate(value)
    if array.shape != _SHAPES[key]:
        raise ValueError(f"{key} must have shape {_SHAPES[key]}, found {array.shape}")
    # Rounded values could not give HandoverSim's files.
    if array.dtype.kind not in "iu" if key == "f" else array.dtype.newbyteorder("=") != np.float64:
        raise ValueError(f"{key} must be {'integers' if key == 'f' else 'float64'}, found {array.dtype}")
    if not np.isfinite(array).all():
        raise ValueError(f"{key} has numbers that are not finite")
    own: npt.NDArray[Any] = np.array(array, dtype=np.int64 if key == "f" else np.float64, order="C")
    own.flags.writeable = False
    return own


def _evaluate(value: Any) -> Any:
    if not isinstance(value, _Record):
        return value
    state = value.state
    if "idxs" in state:  # Elements of an array of chumpy.
        return _evaluate(state["a"]).ravel()[state["idxs"]].reshape(state["preferred_shape"])
    if "indptr" in state:
        matrix = csc_matrix((state["data"], state["indices"], state["indptr"]), shape=state["_shape"])
        matrix.check_format(full_check=True)
        return matrix.toarray()
    return state["x"]
