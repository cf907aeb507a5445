"""Convex hulls of many MuJoCo models, in the arrays of one model."""

import mujoco
import numpy as np
import numpy.typing as npt

# Arrays with an entry for each mesh, vertex and polygon that are copied as they are.
_MESH_ARRAYS = ("mesh_vertnum", "mesh_polynum", "mesh_pos", "mesh_quat")
_VERTEX_ARRAYS = ("mesh_vert", "mesh_polymapnum")
_POLYGON_ARRAYS = ("mesh_polynormal", "mesh_polyvertnum")
# Arrays that others point into, by the array with their addresses.
_TARGETS = {"mesh_polyvertadr": "mesh_polyvert", "mesh_polymapadr": "mesh_polymap"}


class MeshPool:
    """Collection of the distinct meshes of compiled models.

    Attributes:
        arrays: Arrays of all meshes by MuJoCo's names, e.g. "mesh_vert".
        max_polygon_vertices: Largest number of vertices of a polygon.
        max_vertex_polygons: Largest number of polygons around a vertex.
    """

    def __init__(self) -> None:
        self.arrays: dict[str, npt.NDArray[np.generic]] = {}
        self.max_polygon_vertices, self.max_vertex_polygons = 0, 0
        self._numbers: dict[bytes, int] = {}

    def add(self, model: "mujoco.MjModel") -> npt.NDArray[np.int_]:
        """Add the meshes of a model that are not in the pool yet, and return the pool's numbers of all its meshes."""
        numbers, new = [], []
        for mesh in range(model.nmesh):
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            key = model.mesh_vert[start : start + count].tobytes()
            if key not in self._numbers:
                self._numbers[key] = len(self._numbers)
                new.append(_select_mesh(model, mesh))
            numbers.append(self._numbers[key])
        for mesh_arrays in new:
            self._append(mesh_arrays)
        return np.array(numbers, dtype=np.int_)

    def _append(self, mesh: dict[str, npt.NDArray[np.generic]]) -> None:
        if not self.arrays:
            self.arrays = {name: values[:0] for name, values in mesh.items()}
        sizes = {name: len(values) for name, values in self.arrays.items()}
        offsets = {
            "mesh_vertadr": sizes["mesh_vert"],
            "mesh_polyadr": sizes["mesh_polynormal"],
            "mesh_graphadr": sizes["mesh_graph"],
            **{address: sizes[target] for address, target in _TARGETS.items()},
        }
        for name, values in mesh.items():
            shifted = values + offsets[name] if name in offsets else values
            self.arrays[name] = np.concatenate([self.arrays[name], shifted])
        self.max_polygon_vertices = int(self.arrays["mesh_polyvertnum"].max())
        self.max_vertex_polygons = int(self.arrays["mesh_polymapnum"].max())


def _select_mesh(model: "mujoco.MjModel", mesh: int) -> dict[str, npt.NDArray[np.generic]]:
    """Return the arrays of one mesh, with addresses that start at zero."""
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    polygons = slice(model.mesh_polyadr[mesh], model.mesh_polyadr[mesh] + model.mesh_polynum[mesh])
    arrays = {
        "mesh_vertadr": np.zeros(1, dtype=np.int32),
        "mesh_polyadr": np.zeros(1, dtype=np.int32),
        "mesh_graphadr": np.zeros(1, dtype=np.int32),
        **{name: getattr(model, name)[mesh : mesh + 1] for name in _MESH_ARRAYS},
        **{name: getattr(model, name)[vertices] for name in _VERTEX_ARRAYS},
        **{name: getattr(model, name)[polygons] for name in _POLYGON_ARRAYS},
        "mesh_graph": _select_graph(model, mesh),
    }
    for (address, target), rows, counts in zip(
        _TARGETS.items(), (polygons, vertices), ("mesh_polyvertnum", "mesh_polymapnum"), strict=True
    ):
        starts = getattr(model, address)[rows]
        arrays[address] = starts - starts[0]
        arrays[target] = getattr(model, target)[starts[0] : starts[0] + getattr(model, counts)[rows].sum()]
    return arrays


def _select_graph(model: "mujoco.MjModel", mesh: int) -> npt.NDArray[np.int32]:
    """Return the graph of a mesh's convex hull, which ends where that of the next mesh starts."""
    start, later = model.mesh_graphadr[mesh], model.mesh_graphadr[mesh + 1 :]
    graph: npt.NDArray[np.int32] = model.mesh_graph[start : later[0] if len(later) else model.nmeshgraph]
    return graph
