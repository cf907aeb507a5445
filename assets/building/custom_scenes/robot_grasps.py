"""Robot grasps of a custom object: antipodal candidates that hold it in simulation."""

import functools
import itertools
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.building.build_grasps import ConvexSolid, sample_candidates
from handover_marl.assets.building.object_files import read_parts
from handover_marl.assets.grasp_order import compute_farthest_point_order
from handover_marl.assets.object_models import COLLISION_NAME
from handover_marl.errors import OptionError
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import map_with_progress
from handover_marl.simulation.engines import make_grasp_validator

Array = npt.NDArray[np.float64]

_N_SAMPLED = 6000  # surface points in a draw
_MAX_DRAWS = 4
_FREE_PER_GRASP = 4
_CHUNK = 10


@dataclass(frozen=True, eq=False)
class GraspReport:
    """Robot grasps of an object and the result of their validation.

    Attributes:
        grasps: (n, 4, 4) gripper poses in the object's frame (m) that held the object.
        n_candidates: Number of antipodal candidates whose approach is free of collisions and that were simulated.
    """

    grasps: Array
    n_candidates: int


@dataclass(frozen=True, eq=False)
class _Task:
    number: int
    grasps: Array
    only_collisions: bool


def make_robot_grasps(
    urdf: Path, count: int, seed: int, workers: int | None = None, progress: bool = True
) -> GraspReport:
    """Sample grasps of an object and keep those that hold it while it is shaken in simulation.

    The result does not depend on the number of workers.

    Args:
        urdf: Model of the object.
        count: Number of grasps to find; the most different ones are simulated first.
        seed: Random seed.
        workers: Number of worker processes; default: one per core.
        progress: Whether to show progress bars on stderr.

    Raises:
        OptionError: `count` is out of range.
        SimulationError: The model cannot be simulated.
    """
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= 1000:
        raise OptionError(f"grasps must be an integer from 0 to 1000, got {count!r}")
    if not count:
        return GraspReport(np.zeros((0, 4, 4)), 0)
    solid = ConvexSolid(read_parts(urdf.with_name(COLLISION_NAME)))
    run = functools.partial(_run, urdf, workers, progress)
    free: list[Array] = []
    for draw in range(_MAX_DRAWS):
        key = zlib.crc32(f"{urdf.parent.name} {seed} {draw}".encode())
        candidates = sample_candidates(solid, _N_SAMPLED, key).astype(np.float32).astype(np.float64)
        # A share of them is enough, and they are in random order.
        checked = candidates[: 4 * _FREE_PER_GRASP * count]
        free += [
            grasp for grasp, good in zip(checked, run(checked, "grasps free of collisions", True), strict=True) if good
        ]
        if len(free) >= _FREE_PER_GRASP * count:
            break
    ordered = np.array(free[: _FREE_PER_GRASP * count]).reshape(-1, 4, 4)
    ordered = ordered[compute_farthest_point_order(ordered)]
    held: list[Array] = []
    n_simulated = 0
    while n_simulated < len(ordered) and len(held) < count:
        batch = ordered[n_simulated : n_simulated + max(_CHUNK, count - len(held))]
        results = run(batch, "grasps that hold", False)
        held += [grasp for grasp, good in zip(batch, results, strict=True) if good]
        n_simulated += len(batch)
    return GraspReport(np.array(held[:count]).reshape(-1, 4, 4), n_simulated)


def _run(
    urdf: Path, workers: int | None, progress: bool, grasps: Array, what: str, only_collisions: bool
) -> list[bool]:
    starts = range(0, len(grasps), _CHUNK)
    tasks = [_Task(number, grasps[start : start + _CHUNK], only_collisions) for number, start in enumerate(starts)]
    results: dict[int, list[bool]] = {}
    make = functools.partial(_make_validation, urdf)
    for task, outcome in map_with_progress(make, tasks, what, PoolConfig(workers), progress):
        results[task.number] = outcome
    return list(itertools.chain.from_iterable(results[number] for number in range(len(tasks))))


def _make_validation(urdf: Path) -> Callable[[_Task], list[bool]]:
    validator = make_grasp_validator(urdf)

    def validate(task: _Task) -> list[bool]:
        check = validator.is_collision_free if task.only_collisions else validator.is_stable
        return [bool(check(grasp)) for grasp in task.grasps]

    return validate
