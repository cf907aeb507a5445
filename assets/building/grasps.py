"""Grasps of the library's objects: human grasps, robot grasps that hold the object in simulation, and validations.

For every object, side and subject, human grasps are drawn all over the object, and a varied set of them is selected
whose wrist distances are distributed as in DexYCB.

Robot grasps are validated with both variants of the robot. An object takes about 20 core minutes. Results in the user's
cache folder are reused.
"""

import functools
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from rich.progress import track
from scipy.spatial.transform import Rotation

from handover_marl.assets.hand_model import (
    ANGLE_STEP,
    GRASPED_OBJECTS,
    GRASPS_FILE,
    LEVELS,
    SIDES,
    SUBJECT_SIZES,
    WRIST_DISTANCE_QUANTILES,
    HandSize,
    HumanGrasps,
    Side,
)
from handover_marl.assets.shipped import (
    CLASSES_WITHOUT_GRASPS,
    GRASPS_PATH,
    VALIDATION_PATH,
    ValidationRecord,
    find_object_urdf,
    load_shipped_arrays,
)
from handover_marl.datasets import open_dataset
from handover_marl.datasets.generated.grasps import draw_human_grasps, draw_robot_grasps
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import Solid, read_solid
from handover_marl.errors import OptionError
from handover_marl.execution.files import write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.geometry.panda import ROBOTS
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.grasps.validation import (
    GraspPreparationConfig,
    get_validation_record,
    get_validation_record_path,
)

Array = npt.NDArray[np.float64]

_SEARCH: Final = {"n_pairs": 6000, "n_closed": 200, "n_grasps": 250, "n_rounds": 20}
_N_HUMAN_GRASPS = 20  # of each object, side and subject
_ANY_AXIS = (1.0,) * 6  # Any of the object's axes (+x, -x, +y, -y, +z, -z) may point up when it is grasped.
_POINTS_PER_GRASP, _CANDIDATES_PER_GRASP = 200, 6
_CHUNK = 10
_N_ROBOT_GRASPS = 100  # of each of the library's objects


def build_human_grasps(out: Path = GRASPS_FILE) -> None:
    """Build the human grasps of all objects; write them to the `.npz` file `out` by object, side, subject and grasp."""
    found = []
    for number, name in enumerate(track(GRASPED_OBJECTS, description="human grasps")):
        solid = read_solid(find_object_urdf(name))
        found.append(
            [
                [
                    make_human_grasps(name, solid, size, side, number, SIDES.index(side), person)
                    for person, size in enumerate(SUBJECT_SIZES)
                ]
                for side in SIDES
            ]
        )
    arrays = {
        key: np.array([[[one[key] for one in side] for side in item] for item in found]) for key in found[0][0][0]
    }
    write_arrays(out, {"object_names": np.array(GRASPED_OBJECTS), **arrays})


def make_human_grasps(
    name: str, solid: Solid, size: HandSize, side: Side, *seed: int
) -> dict[str, npt.NDArray[np.generic]]:
    """Draw 20 human grasps of a YCB object; return arrays (20, ...) by their names in the file of grasps."""
    random = RandomStream(*seed)
    grasps = draw_human_grasps(random, solid, _ANY_AXIS, size, side, **_SEARCH)
    if grasps is None:
        raise ValueError(f"{name}: no grasp found; use another seed")
    rows = select_grasps(random, grasps, name, _N_HUMAN_GRASPS)
    pose = grasps.object_from_base[rows]
    pose[:, 3:] *= np.where(pose[:, 6:] < 0.0, -1.0, 1.0)
    return {
        "object_from_base": pose.astype(np.float32),
        "finger_angles": np.round(grasps.finger_angles[rows] / ANGLE_STEP).astype(np.int16),
        "open_angles": np.round(grasps.open_angles[rows] / ANGLE_STEP).astype(np.int16),
        "wrist_distance": grasps.wrist_distance[rows].astype(np.float32),
        "touching": grasps.touching[rows],
        "overlap": grasps.overlap[rows].astype(np.float32),
    }


def select_grasps(random: RandomStream, grasps: HumanGrasps, name: str, count: int) -> npt.NDArray[np.intp]:
    """Return the indices (count,) of varied and firm grasps of a YCB class, sorted by wrist distance.

    For each k < count, a wrist distance is drawn between the quantiles k/count and (k+1)/count of DexYCB, and the best
    remaining grasp for this distance is selected.
    """
    shares = (np.arange(count) + random.uniforms(count)) / count
    goals = np.interp(shares, LEVELS, WRIST_DISTANCE_QUANTILES[name])
    costs = 100.0 * grasps.overlap - 0.35 * grasps.touching.sum(axis=1)
    positions, rotations = grasps.object_from_base[:, :3], Rotation.from_quat(grasps.object_from_base[:, 3:])
    chosen: list[int] = []
    for goal in goals[np.argsort(random.uniforms(count))]:
        best = int(np.argmin(costs + ((grasps.wrist_distance - goal) / 0.004) ** 2))
        chosen.append(best)
        # Grasps within 4 cm and 40 degrees are similar.
        apart = np.linalg.norm(positions - positions[best], axis=1) / 0.04
        turned = (rotations[best].inv() * rotations).magnitude() / 0.7
        costs += 3.0 * np.exp(-(apart**2) - turned**2)
        costs[best] += 1e6
    return np.array(chosen)[np.argsort(grasps.wrist_distance[chosen])]


def build_robot_grasps(out: Path = GRASPS_PATH) -> None:
    """Build the robot grasps of all objects and write them to the file `out` (`.npz`)."""
    names = sorted(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
    grasps = {name: make_robot_grasps(find_object_urdf(name), _N_ROBOT_GRASPS, seed=0)[0] for name in names}
    write_arrays(out, {name: found.astype(np.float32) for name, found in grasps.items()})


def make_robot_grasps(
    urdf: Path, count: int, seed: int, workers: int | None = None, progress: bool = True
) -> tuple[Array, int]:
    """Sample grasps of an object and keep up to `count` that hold it while it is shaken in simulation.

    The most different grasps are simulated first. The result depends on `seed` but not on the number of workers.

    Returns:
        Gripper poses (n, 4, 4) in the object's frame (m), and the number of candidates that were simulated.
    """
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= 1000:
        raise OptionError(f"grasps must be an integer from 0 to 1000, got {count!r}")
    if not count:
        return np.zeros((0, 4, 4)), 0
    random = RandomStream(zlib.crc32(f"{urdf.parent.name} {seed}".encode()))
    candidates = draw_robot_grasps(
        random, read_solid(urdf), n_points=_POINTS_PER_GRASP * count, n_grasps=_CANDIDATES_PER_GRASP * count
    )
    make, held, n_simulated = functools.partial(_make_validation, urdf), list[Array](), 0
    while n_simulated < len(candidates) and len(held) < count:
        batch = candidates[n_simulated : n_simulated + max(_CHUNK, count - len(held))]
        chunks = [(start, batch[start : start + _CHUNK]) for start in range(0, len(batch), _CHUNK)]
        results = {
            start: outcome
            for (start, _), outcome in map_with_progress(make, chunks, "robot grasps", PoolConfig(workers), progress)
        }
        held += list(batch[np.concatenate([results[start] for start, _ in chunks])])
        n_simulated += len(batch)
    return np.array(held[:count]).reshape(-1, 4, 4), n_simulated


def _make_validation(urdf: Path) -> Callable[[tuple[int, Array]], list[bool]]:
    from handover_marl.simulation.mujoco.grasp_validation import GraspValidator

    validator = GraspValidator(urdf)

    def validate(task: tuple[int, Array]) -> list[bool]:
        return [bool(validator.is_collision_free(grasp) and validator.is_stable(grasp)) for grasp in task[1]]

    return validate


def build_grasp_validations(
    out: Path = VALIDATION_PATH, data_dir: Path | None = None, workers: int | None = None
) -> None:
    """Validate the robot grasps of all objects in simulation and write the results to one file.

    Args:
        out: Output file (`.npz`).
        data_dir: Data folder in HandoverSim's layout, whose objects are validated too; without it, the file's other
            records are kept.
        workers: Number of worker processes; default: one per core.
    """
    records = {} if data_dir or not out.exists() else dict(load_shipped_arrays(out))
    folders = (None, data_dir) if data_dir else (None,)
    # The second robot comes last and reuses results of the first.
    tasks = [(folder, robot, name) for folder in folders for robot in ROBOTS for name in CLASS_NAMES.values()]
    for _, found in map_with_progress(lambda: _validate_object, tasks, "objects", PoolConfig(workers), progress=True):
        if found is not None:
            records[found[0]] = found[1]
    write_arrays(out, dict(sorted(records.items())))


def _validate_object(task: tuple[Path | None, str, str]) -> tuple[str, ValidationRecord] | None:
    """Validate the robot grasps of an object: return name and record of the result, or None if it has no grasps."""
    data_dir, robot, name = task
    data = open_dataset("dexycb" if data_dir else "synthetic", data_dir, robot)
    known = load_hand_poses(data.load_grasps, name)
    if known is None:
        return None
    given = (data.find_object_urdf(name), data.panda_urdf, known, GraspPreparationConfig())
    return get_validation_record_path(*given).stem, get_validation_record(*given)
