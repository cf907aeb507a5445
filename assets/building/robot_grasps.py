"""Robot grasps: antipodal candidates that hold their object in simulation."""

import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS, GRASPS_PATH, find_object_urdf
from handover_marl.datasets.generated.robot_grasps import RobotGraspConfig, draw_robot_grasps
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.datasets.synthetic.random_stream import RandomStream
from handover_marl.errors import OptionError
from handover_marl.execution.files import write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.engines import make_grasp_validator

Array = npt.NDArray[np.float64]

_POINTS_PER_GRASP, _CANDIDATES_PER_GRASP = 200, 6
_CHUNK = 10
_N_GRASPS = 100  # of each of the library's objects


def build_robot_grasps(out: Path = GRASPS_PATH) -> None:
    """Build the grasps of all objects and write them to one file.

    Args:
        out: Output file (`.npz`).
    """
    names = sorted(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
    grasps = {name: make_robot_grasps(find_object_urdf(name), _N_GRASPS, seed=0).grasps for name in names}
    write_arrays(out, {name: found.astype(np.float32) for name, found in grasps.items()})


@dataclass(frozen=True, eq=False)
class GraspReport:
    """Robot grasps of an object and the result of their validation.

    Attributes:
        grasps: (n, 4, 4) gripper poses in the object's frame (m) that held the object.
        n_candidates: Number of antipodal candidates that were simulated.
    """

    grasps: Array
    n_candidates: int


def make_robot_grasps(
    urdf: Path, count: int, seed: int, workers: int | None = None, progress: bool = True
) -> GraspReport:
    """Sample grasps of an object and keep up to `count` that hold it while it is shaken in simulation.

    The most different ones are simulated first. The result does not depend on the number of workers.

    Raises:
        OptionError: `count` is out of range.
        SimulationError: The model cannot be simulated.
    """
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= 1000:
        raise OptionError(f"grasps must be an integer from 0 to 1000, got {count!r}")
    if not count:
        return GraspReport(np.zeros((0, 4, 4)), 0)
    random = RandomStream(zlib.crc32(f"{urdf.parent.name} {seed}".encode()))
    config = RobotGraspConfig(n_points=_POINTS_PER_GRASP * count, n_grasps=_CANDIDATES_PER_GRASP * count)
    candidates = draw_robot_grasps(random, read_solid(urdf), config)
    make, held, n_simulated = functools.partial(_make_validation, urdf), list[Array](), 0
    while n_simulated < len(candidates) and len(held) < count:
        batch = candidates[n_simulated : n_simulated + max(_CHUNK, count - len(held))]
        tasks = [range(start, min(start + _CHUNK, len(batch))) for start in range(0, len(batch), _CHUNK)]
        chunks = [(number, batch[task]) for number, task in enumerate(tasks)]
        results = dict[int, list[bool]]()
        for (number, _), outcome in map_with_progress(make, chunks, "robot grasps", PoolConfig(workers), progress):
            results[number] = outcome
        good = np.concatenate([results[number] for number in range(len(chunks))])
        held += list(batch[good])
        n_simulated += len(batch)
    return GraspReport(np.array(held[:count]).reshape(-1, 4, 4), n_simulated)


def _make_validation(urdf: Path) -> Callable[[tuple[int, Array]], list[bool]]:
    validator = make_grasp_validator(urdf)

    def validate(task: tuple[int, Array]) -> list[bool]:
        return [bool(validator.is_collision_free(grasp) and validator.is_stable(grasp)) for grasp in task[1]]

    return validate
