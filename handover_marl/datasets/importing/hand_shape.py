"""A person's hand from MANO's mean hand and ten shape parameters.

All in float64 with sums from left to right, written out, because matrix products fuse or reorder them on some machines.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.importing.mano_model import ManoModel

Float64 = npt.NDArray[np.float64]


def shaped_vertices(model: ManoModel, betas: Sequence[float]) -> Float64:
    """Vertices (778, 3) of the hand at rest (m).

    Args:
        model: The mean hand and how it changes.
        betas: Ten shape parameters.
    """
    offsets = np.zeros_like(model.v_template)
    for k, beta in enumerate(betas):
        offsets += model.shapedirs[:, :, k] * float(beta)
    return model.v_template + offsets


def joint_origins(model: ManoModel, vertices: Float64) -> Float64:
    """Joints (16, 3) of a hand at rest (m), each summed over its vertices in ascending order."""
    weights = model.j_regressor
    origins = np.zeros((weights.shape[0], 3))
    for vertex in range(weights.shape[1]):
        for entry in range(weights.indptr[vertex], weights.indptr[vertex + 1]):
            origins[weights.indices[entry]] += weights.data[entry] * vertices[vertex]
    return origins


def wrist(model: ManoModel, betas: Sequence[float]) -> Float64:
    """The root joint (3,) of the hand at rest (m), about which the whole hand turns."""
    return np.asarray(joint_origins(model, shaped_vertices(model, betas))[0])
