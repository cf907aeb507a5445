"""Objects from triangle meshes: checks, repairs, convex parts and mass."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import QhullError

from handover_marl.assets.shipped import FRICTION, PALETTE, format_object_files
from handover_marl.errors import DataFormatError, OptionError, check_name
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import require_modules
from handover_marl.execution.reading import check_plain_file, report_damage
from handover_marl.geometry.model_files.meshes import compute_convex_hull, decompose_convex
from handover_marl.geometry.model_files.obj_files import read_obj

# Smallest and largest mass (kg), largest extent of an object, and distance of its center from its frame's origin (m).
_MASS, _EXTENT, _MAX_OFFSET = (1e-3, 20.0), (0.005, 0.7), 0.7
#: Meters in each unit of length.
UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
_LIMITS: Final = {
    **{"scale": (1e-6, 1e6), "mass": _MASS, "density": (1.0, 30_000.0), "friction": (0.0, 10.0)},
    "concavity": (0.01, 1.0),
}
_MAX_BYTES, _MAX_FACES = 1_000_000_000, 20_000
_MIN_THICKNESS = 5e-4  # m


@dataclass(frozen=True)
class MeshConfig:
    """Configuration of an object that is made from a mesh.

    Attributes:
        unit: Unit of length in the mesh file: m, cm, mm or inch.
        scale: Factor on the size, after the unit.
        mass: Mass (kg); default: from the density.
        density: Density (kg/m^3) if no mass is given; default: 300, a half-filled plastic bottle.
        friction: Lateral friction coefficient; HandoverSim's objects have 0.9.
        color: Color in images, a name of the library's palette.
        concavity: Threshold of the convex decomposition with CoACD, 0.01 (many convex parts) to 1 (one).

    Raises:
        OptionError: A number is out of range, or both mass and density are given.
        UnknownNameError: The unit or the color does not exist.
    """

    unit: str = "m"
    scale: float = 1.0
    mass: float | None = None
    density: float | None = None
    friction: float = FRICTION
    color: str = "blue"
    concavity: float = 0.05

    def __post_init__(self) -> None:
        check_name("unit", self.unit, UNITS)
        check_name("color", self.color, PALETTE)
        if self.mass is not None and self.density is not None:
            raise OptionError("mass and density must not both be given; leave one of them out")
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None and not (isinstance(value, (int, float)) and low <= value <= high):
                raise OptionError(f"{name} must be a number from {low:g} to {high:g}, got {value!r}")


@dataclass(frozen=True, eq=False)
class ObjectMesh:
    """Checked mesh of an object.

    Attributes:
        mesh: Surface in the object's frame (m).
        parts: Convex parts that together approximate the mesh, in the object's frame (m).
        mass: Mass of the object (kg).
        repairs: Changes that were made to the mesh.
    """

    mesh: trimesh.Trimesh
    parts: tuple[trimesh.Trimesh, ...]
    mass: float
    repairs: tuple[str, ...]


def make_object_mesh(source: Path | trimesh.Trimesh, config: MeshConfig) -> ObjectMesh:
    """Read a mesh, repair it and divide it into convex parts; raise `DataFormatError` if it is no solid body."""
    require_modules("an own object", "assets,import", "coacd", "trimesh")
    name = str(source) if isinstance(source, Path) else "the mesh"
    mesh, repairs = _repair_mesh(_read_mesh(source), config, name)
    corners = decompose_convex(np.asarray(mesh.vertices), np.asarray(mesh.faces), config.concavity)
    if not corners:
        raise DataFormatError(f"{name}: CoACD finds no body in it; export a closed surface")
    parts = tuple(trimesh.Trimesh(*compute_convex_hull(part), process=False) for part in corners)
    volume = sum(float(part.volume) for part in parts)
    mass = config.mass if config.mass is not None else (config.density or 300.0) * volume
    if not _MASS[0] <= mass <= _MASS[1]:
        raise DataFormatError(
            f"{name}: mass must be {_MASS[0]:g} to {_MASS[1]:g} kg, got {mass:.3g} kg from the volume {volume:.3g} "
            "m^3; give mass or density"
        )
    return ObjectMesh(mesh, parts, mass, tuple(repairs))


def write_object(folder: Path, item: ObjectMesh, config: MeshConfig) -> None:
    """Write the URDF and the meshes of an object into an existing folder."""
    colored, parts = [(config.color, *_canonicalize(item.mesh))], map(_canonicalize, item.parts)
    center = np.average([part.center_mass for part in item.parts], axis=0, weights=[part.volume for part in item.parts])
    for name, content in format_object_files(colored, parts, item.mass, config.friction, center.tolist()).items():
        write_atomically(folder / name, content)


def _read_mesh(path: Path | trimesh.Trimesh) -> trimesh.Trimesh:
    if isinstance(path, trimesh.Trimesh):
        return path.copy()
    with report_damage(path, "mesh", "give a mesh file that trimesh reads, such as STL, OBJ or PLY"):
        check_plain_file(path, _MAX_BYTES)
        if path.suffix.lower() == ".obj":
            # trimesh misreads vertex numbers that count back, tabs, comments and byte order marks.
            obj = read_obj(path)
            return trimesh.Trimesh(obj.vertices, obj.faces, process=False)
        loaded: Any = trimesh.load(path, force="mesh", process=False)
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise DataFormatError(f"{path}: has no triangles; export a triangle mesh as STL, OBJ or PLY")
    return loaded


def _repair_mesh(mesh: trimesh.Trimesh, config: MeshConfig, name: str) -> tuple[trimesh.Trimesh, list[str]]:
    """Return a mesh in meters with a repaired surface, and descriptions of the repairs; `name` is for errors."""
    repairs: list[str] = []
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    if not len(faces) or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise DataFormatError(f"{name}: must have triangles of finite vertices; export the mesh again")
    mesh = trimesh.Trimesh(vertices * UNITS[config.unit] * config.scale, faces, process=False)
    _check_size(mesh, config, name)
    if len(mesh.faces) > _MAX_FACES:
        # First of all, since hulls and edges of a million triangles take minutes.
        require_modules("meshes of many triangles", "replay", "fast_simplification")
        mesh = mesh.simplify_quadric_decimation(face_count=_MAX_FACES)
        repairs.append(f"simplified from {len(faces)} to {len(mesh.faces)} triangles")
    mesh.merge_vertices()
    n_faces = len(mesh.faces)
    with np.errstate(invalid="ignore"):  # flat bodies have no center
        is_outward = mesh.is_winding_consistent and mesh.volume >= 0.0
        mesh.process(validate=True)
        _check_solid(mesh, name)
    if len(mesh.faces) < n_faces:
        repairs.append(f"{n_faces - len(mesh.faces)} empty or repeated triangles removed")
    if not is_outward:
        repairs.append("triangles turned so that all face outwards")
    if not mesh.is_watertight:
        trimesh.repair.fill_holes(mesh)
        repairs.append("holes filled" if mesh.is_watertight else "open surface kept; its convex parts are closed")
    return mesh, repairs


def _check_size(mesh: trimesh.Trimesh, config: MeshConfig, name: str) -> None:
    extents, (low, high) = np.asarray(mesh.extents), _EXTENT
    largest, distance = float(extents.max()), float(np.linalg.norm(mesh.bounds.mean(axis=0)))
    if not low <= largest <= high:
        meters = largest / UNITS[config.unit]
        fitting = [unit for unit, size in UNITS.items() if 0.03 <= meters * size <= 0.5 and unit != config.unit]
        advice = f"if it is in {' or '.join(fitting)}, pass unit={fitting[0]!r}" if fitting else "pass unit or scale"
        raise DataFormatError(
            f"{name}: the largest extent must be {low} to {high} m, got {' x '.join(f'{size:.3g}' for size in extents)}"
            f" m in unit {config.unit!r}; {advice}"
        )
    if distance > _MAX_OFFSET:
        raise DataFormatError(
            f"{name}: the body must be near the origin of its frame, got a distance of {distance:.3g} m; move it"
        )


def _check_solid(mesh: trimesh.Trimesh, name: str) -> None:
    extents = np.ptp(np.asarray(mesh.triangles).reshape(-1, 3), axis=0) if len(mesh.faces) else np.zeros(3)
    try:
        hull = float(mesh.convex_hull.volume)
    except (QhullError, ValueError):
        hull = 0.0
    if hull <= 1e-5 * float(extents.max()) ** 3 or extents.min() < _MIN_THICKNESS:
        raise DataFormatError(
            f"{name}: must be a solid body, got a flat or empty one of {extents.min():.2g} m thickness; export a "
            "closed surface"
        )


def _canonicalize(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return vertices (v, 3), rounded to 1e-6 m, and faces (f, 3) in an order that depends only on the mesh's shape."""
    # Adding zero turns -0.0 into 0.0.
    rounded = np.round(np.asarray(mesh.vertices, dtype=np.float64), 6) + 0.0
    vertices, renumbered = np.unique(rounded, axis=0, return_inverse=True)
    faces = renumbered.reshape(-1)[np.asarray(mesh.faces)]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[whole]
    turned = np.stack([np.roll(face, -int(np.argmin(face))) for face in faces])
    return vertices, turned[np.lexsort(turned.T[::-1])]
