"""From the frame that DexYCB's poses are written in to that of the tag on the table, in which scenes are kept."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.datasets.importing.float32_sums import rotate_fused, rotate_plain
from handover_marl.models.poses import shepperd_row

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TagFrame:
    """The transform `tag_from_world`, float32.

    Attributes:
        rotation: (3, 3).
        translation: (3,) in m.
    """

    rotation: Float32
    translation: Float32

    @classmethod
    def from_extrinsics(cls, world_from_tag: npt.ArrayLike) -> "TagFrame":
        """Of the tag's pose in the world, (3, 4) [R | t] in m."""
        pose = np.asarray(world_from_tag, dtype=np.float32)
        rotation = np.ascontiguousarray(pose[:, :3].T)
        # This one sum was not fused, unlike all others: the original's vector had no room for fused kernels.
        return cls(rotation, rotate_plain(rotation, -pose[:, 3]))

    def points(self, world: Float32) -> Float32:
        """Points (n, 3) in m, float32, in the tag's frame."""
        turned: Float32 = rotate_fused(self.rotation, world[:, :, None])[:, :, 0] + self.translation
        return turned

    def quaternions(self, world: Rotation) -> Float32:
        """Rotations of bodies in the world as float32 quaternions (n, 4) xyzw in the tag's frame.

        The matrices are rounded to float32 on either side of the product, as in the original; they must not be
        orthogonalised after that.
        """
        matrices = rotate_fused(self.rotation, world.as_matrix().astype(np.float32))
        return quaternions_from_matrices(matrices).astype(np.float32)


def quaternions_from_matrices(matrices: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Unit quaternions (n, 4) xyzw of nearly orthogonal matrices (n, 3, 3), as SciPy gave them up to 1.11.

    Only the norm differs from `handover_marl.models.poses.quaternion_from_matrix`: it is summed from left to right,
    while a matrix product's order depends on the machine.
    """
    q = shepperd_row(matrices)
    x, y, z, w = (q[..., i] for i in range(4))
    norm = np.sqrt(((x * x + y * y) + z * z) + w * w)
    return np.asarray(q / norm[..., None])
