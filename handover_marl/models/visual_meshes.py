"""What models look like: the triangles that their links show."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.models.kinematic_tree import KinematicTree
from handover_marl.models.meshes import shape_triangles
from handover_marl.models.urdf_shapes import read_urdf_shapes


@dataclass(frozen=True, eq=False)
class VisualMesh:
    """What one link shows.

    Attributes:
        link: Number of the link, -1 for the base.
        vertices: (v, 3) float32 in the link's frame (m).
        faces: (f, 3) int32 corners of triangles, counterclockwise seen from outside.
        colors: (f, 3) float32 red, green and blue of each triangle, 0 to 1.
    """

    link: int
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    colors: npt.NDArray[np.float32]


def read_visual_meshes(urdf: Path, tree: KinematicTree, without: Collection[str] = ()) -> list[VisualMesh]:
    """One mesh for every link that shows something.

    Args:
        urdf: Model file.
        tree: Its links.
        without: Names of links to leave out.

    Raises:
        SimulationError: A shape cannot be read from the model.
        DataFormatError: A mesh is missing or cannot be read.
    """
    skipped = {number for number, joint in enumerate(tree.joints) if joint.link in without}
    shapes: dict[int, list[tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], tuple[float, ...]]]] = {}
    for shape in read_urdf_shapes(urdf, tree, "visual"):
        if shape.link not in skipped:
            shapes.setdefault(shape.link, []).append((*shape_triangles(shape, urdf), shape.color[:3]))
    return [_merged(link, parts) for link, parts in shapes.items()]


def _merged(
    link: int, parts: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], tuple[float, ...]]]
) -> VisualMesh:
    firsts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    return VisualMesh(
        link,
        np.concatenate([vertices for vertices, _, _ in parts]).astype(np.float32),
        np.concatenate([faces + first for (_, faces, _), first in zip(parts, firsts, strict=False)]).astype(np.int32),
        np.concatenate([np.tile(np.array(color, dtype=np.float32), (len(faces), 1)) for _, faces, color in parts]),
    )
