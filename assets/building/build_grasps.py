"""Build the robot grasps: `python -m handover_marl.assets.building.build_grasps [--out FILE]`.

Candidates pinch pairs of opposite surface points. Candidates whose approach is free of collisions
are simulated, the most different ones first, until enough of them have held the object while it
was shaken. The program needs the extra `assets`.
"""

import itertools
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from handover_marl.assets.building.object_files import load_collision_parts, merge_meshes
from handover_marl.assets.grasp_order import compute_farthest_point_order
from handover_marl.assets.object_models import find_object_urdf
from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS, GRASPS_PATH
from handover_marl.errors import HandoverError
from handover_marl.execution.files import write_arrays
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.bullet.grasp_validation import BulletGraspValidator

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SamplingConfig:
    """Parameters of the grasp candidates.

    Attributes:
        max_width: Largest distance between the two finger contacts (m); the Panda opens to 0.08.
        max_cone_angle: Largest angle between the closing direction and the surface normals (rad).
        depth_range: Smallest and largest distance from the gripper frame's origin to the contacts along
            the approach direction (m). The finger pads end at 0.112, the palm at 0.066.
        max_bridged_gap: Largest gap between convex parts that counts as solid (m).
    """

    max_width: float = 0.076
    max_cone_angle: float = 0.26
    depth_range: tuple[float, float] = (0.084, 0.106)
    max_bridged_gap: float = 0.0005


class ConvexSolid:
    """Solid made of convex parts that may overlap.

    Args:
        parts: Convex meshes (m).
    """

    def __init__(self, parts: Sequence[trimesh.Trimesh]) -> None:
        self._surface = merge_meshes(parts)
        self._planes = [(part.face_normals.copy(), part.triangles[:, 0].copy()) for part in parts]

    def sample_surface(self, n: int, seed: int) -> tuple[Array, Array]:
        """Sample up to `n` points (k, 3) on the outer surface, and their normals (k, 3)."""
        points, faces = trimesh.sample.sample_surface(self._surface, n, seed=seed)
        normals = self._surface.face_normals[faces]
        outside = self.is_outside(points + 2e-4 * normals)
        return np.asarray(points)[outside], np.asarray(normals)[outside]

    def is_outside(self, points: Array) -> npt.NDArray[np.bool_]:
        """Return a mask (k,) of the points (k, 3) that are outside of all convex parts."""
        outside = np.ones(len(points), dtype=bool)
        for normals, corners in self._planes:
            heights = points @ normals.T - np.einsum("fi,fi->f", normals, corners)
            outside &= (heights > 0).any(axis=1)
        return outside

    def find_exits(self, points: Array, directions: Array, max_bridged_gap: float) -> tuple[Array, Array]:
        """Find where rays that start on the surface leave the solid.

        Args:
            points: (k, 3) starts of the rays.
            directions: (k, 3) unit vectors.
            max_bridged_gap: Largest gap (m) between parts that counts as solid.

        Returns:
            Lengths (k,) of the rays inside the solid, 0 if they do not enter it, and surface normals
            (k, 3) at the exits.
        """
        entry, leave, leave_normal = self._find_crossings(points, directions)
        length = np.zeros(len(points))
        normals = np.zeros((len(points), 3))
        rays = np.arange(len(points))
        for _ in range(len(self._planes)):
            reached = np.where(entry <= length + max_bridged_gap, leave, -np.inf)
            best = reached.argmax(axis=0)
            further = reached[best, rays] > length + 1e-9
            if not further.any():
                break
            length = np.where(further, reached[best, rays], length)
            normals[further] = leave_normal[best, rays][further]
        return length, normals

    def _find_crossings(self, points: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Return rays' entry and exit distances (parts, k), (inf, -inf) for misses, and normals."""
        entries, leaves, normals = [], [], []
        for plane_normals, plane_points in self._planes:
            slope = directions @ plane_normals.T
            gap = np.einsum("fi,fi->f", plane_normals, plane_points) - points @ plane_normals.T
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = gap / slope
            level = np.abs(slope) < 1e-9
            entry = np.where(~level & (slope < 0), crossing, -np.inf).max(axis=1)
            leave = np.where(~level & (slope > 0), crossing, np.inf)
            face = leave.argmin(axis=1)
            leave = leave.min(axis=1)
            misses = (entry > leave) | (level & (gap < -1e-9)).any(axis=1)
            entries.append(np.where(misses, np.inf, entry))
            leaves.append(np.where(misses, -np.inf, leave))
            normals.append(plane_normals[face])
        return np.stack(entries), np.stack(leaves), np.stack(normals)


def sample_candidates(solid: ConvexSolid, n: int, seed: int, config: SamplingConfig | None = None) -> Array:
    """Sample grasps that pinch opposite points of an object's surface; collisions are not checked.

    Args:
        solid: Object.
        n: Number of surface points from which grasps are tried.
        seed: Random seed.
        config: Parameters of the candidates; None for the defaults.

    Returns:
        (k, 4, 4) transforms `object_from_gripper`, at most n.
    """
    config = config or SamplingConfig()
    rng = np.random.default_rng(seed)
    points, normals = solid.sample_surface(n, seed)
    closing = _tilt(-normals, config.max_cone_angle * np.sqrt(rng.uniform(size=len(points))), rng)
    width, exit_normals = solid.find_exits(points, closing, config.max_bridged_gap)
    opposite = np.einsum("ki,ki->k", closing, exit_normals) > np.cos(config.max_cone_angle)
    good = opposite & (width > 1e-3) & (width < config.max_width)
    points, closing, width = points[good], closing[good], width[good]
    middle = points + 0.5 * width[:, None] * closing
    # The gripper is symmetric: swap the fingers at random.
    closing *= rng.choice([-1.0, 1.0], size=len(points))[:, None]
    approach = _tilt(closing, np.full(len(points), np.pi / 2), rng)
    depth = rng.uniform(*config.depth_range, size=len(points))
    grasps = np.tile(np.eye(4), (len(points), 1, 1))
    grasps[:, :3, 0] = closing
    grasps[:, :3, 1] = np.cross(approach, closing)
    grasps[:, :3, 2] = approach
    grasps[:, :3, 3] = middle - depth[:, None] * approach
    return grasps


def _tilt(directions: Array, angles: Array, rng: np.random.Generator) -> Array:
    """Return unit vectors (k, 3) at given angles to `directions` (k, 3), in random planes."""
    sideways = np.cross(directions, rng.normal(size=directions.shape))
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    return np.cos(angles)[:, None] * directions + np.sin(angles)[:, None] * sideways


@dataclass(frozen=True)
class Args:
    """Options of the builder of robot grasps.

    Attributes:
        out: Output file (`.npz`).
        only: YCB class names of the objects to build; other objects in the file are kept; if empty,
            all objects are built.
        n_grasps: Number of validated grasps per object.
        n_free: Number of collision-free candidates per object.
        n_drawn: Number of candidates per draw, before the collision check.
        n_draws: Largest number of draws; objects with few places to grasp get fewer than `n_free`
            candidates.
        seed: Random seed; an object's grasps do not depend on other objects.
    """

    out: Path = GRASPS_PATH
    only: tuple[str, ...] = ()
    n_grasps: int = 100
    n_free: int = 600
    n_drawn: int = 8_000
    n_draws: int = 20
    seed: int = 0


def validate_object_grasps(name: str, args: Args, on_validated: Callable[[], None] = lambda: None) -> tuple[Array, int]:
    """Return grasps of one object that held it in simulation, and the number of simulated candidates.

    The grasps are (n, 4, 4) transforms `object_from_gripper`.

    Args:
        name: YCB class name.
        args: Options of the command.
        on_validated: Function called after every validated grasp.

    Raises:
        HandoverError: Too few grasps held the object.
    """
    trial = BulletGraspValidator(find_object_urdf(name))
    try:
        free = _sample_collision_free(name, trial, args)
        validated: list[Array] = []
        for n_simulated, index in enumerate(compute_farthest_point_order(free), start=1):
            if trial.is_stable(free[index]):
                validated.append(free[index])
                on_validated()
            if len(validated) == args.n_grasps:
                return np.stack(validated), n_simulated
    finally:
        trial.close()
    raise HandoverError(f"{name}: {len(free)} places to grasp, and only {len(validated)} of {args.n_grasps} held")


def _sample_collision_free(name: str, trial: BulletGraspValidator, args: Args) -> Array:
    """Sample up to `args.n_free` reachable grasps (k, 4, 4), rounded to float32 as in the file."""
    solid = ConvexSolid(load_collision_parts(name))
    free: list[Array] = []
    for draw in range(args.n_draws):
        candidates = sample_candidates(solid, args.n_drawn, zlib.crc32(f"{name} {args.seed} {draw}".encode()))
        stored = candidates.astype(np.float32).astype(np.float64)
        free += itertools.islice(filter(trial.is_collision_free, stored), args.n_free - len(free))
        if len(free) == args.n_free:
            break
    return np.array(free).reshape(-1, 4, 4)


def _read_grasps(path: Path) -> dict[str, Array]:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)


def main(args: Args) -> None:
    """Build the grasps of the chosen objects and write them to one file."""
    names = args.only or tuple(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    grasps = _read_grasps(args.out) if args.only else {}
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("grasps", total=len(names) * args.n_grasps)
        for name in names:
            progress.update(task, description=f"{name:22}")
            grasps[name], n_simulated = validate_object_grasps(name, args, lambda: progress.advance(task))
            progress.console.print(f"{name:22} {args.n_grasps} of {n_simulated} simulated grasps held")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(args.out, {name: grasps[name].astype(np.float32) for name in sorted(grasps)})


if __name__ == "__main__":
    main(tyro.cli(Args))
