"""The hand model that DexYCB's hands are poses of."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse


@dataclass(frozen=True, eq=False)
class ManoModel:
    """A MANO hand.

    Attributes:
        side: "right" or "left".
        v_template: (778, 3) vertices of the mean hand (m).
        shapedirs: (778, 3, 10) how they move with the shape parameters (m).
        j_regressor: (16, 778) weights that give joints from vertices.
        weights: (778, 16) how far each vertex follows each joint.
        faces: (1538, 3) vertex numbers, from 0.
        parents: (16,) number of each joint's parent, -1 for the root.
        hands_components: (45, 45) principal components of the finger poses, one a row (rad).
        hands_mean: (45,) mean finger pose (rad).
    """

    side: str
    v_template: npt.NDArray[np.float64]
    shapedirs: npt.NDArray[np.float64]
    j_regressor: scipy.sparse.csc_matrix
    weights: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int64]
    parents: npt.NDArray[np.int64]
    hands_components: npt.NDArray[np.float64]
    hands_mean: npt.NDArray[np.float64]
