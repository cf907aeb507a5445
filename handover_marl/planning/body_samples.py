"""Points on the robot's body that must keep clear of things."""

import functools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.models.meshes import link_vertices

Array = npt.NDArray[np.float64]


def body_samples(urdf: Path, link_names: tuple[str, ...], count: int) -> tuple[Array, ...]:
    """(count, 3) vertices (m) of each link's visual mesh, in its frame, spread over it.

    Each is the vertex farthest from those before it, so that fine details do not draw points as they do when
    vertices are drawn by chance.

    Raises:
        DataFormatError: A link has no mesh, or a file cannot be read.
    """
    return _samples(urdf, urdf.stat().st_mtime_ns, link_names, count)


@functools.cache
def _samples(urdf: Path, changed: int, link_names: tuple[str, ...], count: int) -> tuple[Array, ...]:
    return tuple(_spread(vertices, count) for vertices in link_vertices(urdf, "visual", list(link_names)))


def _spread(vertices: Array, count: int) -> Array:
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    chosen = [int(np.argmax(np.linalg.norm(vertices - middle, axis=1)))]
    nearest = np.full(len(vertices), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(nearest)))
    return vertices[chosen]
