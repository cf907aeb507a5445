"""Build the grasp validations: `python -m handover_marl.assets.building.build_grasp_validations --data-dir DIR`.

The program validates the grasps of the library's objects, and of the objects in a data folder, with
both variants of the robot. An object takes about 20 core minutes. Results in the user's cache
folder are reused. The program needs the extra `planning`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl.assets.shipped import VALIDATION_PATH, ValidationRecord, load_validation_records
from handover_marl.datasets import open_dataset
from handover_marl.execution.files import write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.receivers.grasp_library import GraspLibrary
from handover_marl.receivers.reactive.grasp_validation import get_validation_record, get_validation_record_path
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig


@dataclass(frozen=True)
class Args:
    """Options of the builder of grasp validations.

    Attributes:
        out: Output file (`.npz`).
        data_dir: Data folder in HandoverSim's layout with further objects; without it, the file's
            other records are kept.
        workers: Number of worker processes.
    """

    out: Path = VALIDATION_PATH
    data_dir: Path | None = None
    workers: int | None = None


@dataclass(frozen=True)
class ValidationTask:
    """Object whose grasps are validated with one variant of the robot.

    Attributes:
        data_dir: Data folder of the object, or None for the library's own objects.
        robot: Variant of the Panda.
        object_name: YCB class name.
    """

    data_dir: Path | None
    robot: str
    object_name: str

    def __str__(self) -> str:
        return f"{self.object_name} {self.robot}"


def validate_object(task: ValidationTask) -> tuple[str, ValidationRecord] | None:
    """Return the name and the record of an object's validation, or None if it has no grasps."""
    data = open_dataset("dexycb" if task.data_dir else "synthetic", task.data_dir, task.robot)
    known = GraspLibrary(data.load_grasps).get_hand_poses_in_object(task.object_name)
    if known is None:
        return None
    given = (data.find_object_urdf(task.object_name), data.panda_urdf, known, GraspPreparationConfig())
    return get_validation_record_path(*given).stem, get_validation_record(*given)


def list_tasks(data_dir: Path | None) -> Iterator[ValidationTask]:
    """Yield all validation tasks; tasks with the second robot come last and reuse results of the first."""
    for folder in (None, data_dir) if data_dir else (None,):
        for robot in (PANDA, PANDA_CAMERA):
            yield from (ValidationTask(folder, robot, name) for name in CLASS_NAMES.values())


def main(args: Args) -> None:
    """Validate the grasps of all objects and write one file."""
    records = {} if args.data_dir else dict(load_validation_records(args.out))
    tasks = list(list_tasks(args.data_dir))
    for _, found in map_with_progress(
        lambda: validate_object, tasks, "objects", PoolConfig(args.workers), progress=True
    ):
        if found is not None:
            records[found[0]] = found[1]
    write_arrays(args.out, dict(sorted(records.items())))


if __name__ == "__main__":
    main(tyro.cli(Args))
