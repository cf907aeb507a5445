"""Validations of the grasps of the library's objects, and of the objects in a data folder.

Grasps are validated with both variants of the robot. An object takes about 20 core minutes for each robot. Results in
the user's cache folder are reused.
"""

from pathlib import Path

from handover_marl.assets.shipped import VALIDATION_PATH, ValidationRecord, load_validation_records
from handover_marl.datasets import open_dataset
from handover_marl.execution.files import write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.geometry.panda import ROBOTS
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.receivers.grasp_library import load_hand_poses
from handover_marl.receivers.reactive.grasp_validation import get_validation_record, get_validation_record_path
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig

#: Data folder or None for the library's own objects, variant of the Panda, YCB class name.
ValidationTask = tuple[Path | None, str, str]


def build_grasp_validations(
    out: Path = VALIDATION_PATH, data_dir: Path | None = None, workers: int | None = None
) -> None:
    """Validate the grasps of all objects and write one file.

    Args:
        out: Output file (`.npz`).
        data_dir: Data folder in HandoverSim's layout with further objects; without it, the file's other records are
            kept.
        workers: Number of worker processes.
    """
    records = {} if data_dir else dict(load_validation_records(out))
    folders = (None, data_dir) if data_dir else (None,)
    tasks = [(folder, robot, name) for folder in folders for robot in ROBOTS for name in CLASS_NAMES.values()]
    for _, found in map_with_progress(lambda: _validate_object, tasks, "objects", PoolConfig(workers), progress=True):
        if found is not None:
            records[found[0]] = found[1]
    write_arrays(out, dict(sorted(records.items())))


def _validate_object(task: ValidationTask) -> tuple[str, ValidationRecord] | None:
    """Return the name and the record of an object's validation, or None if it has no grasps."""
    data_dir, robot, name = task
    data = open_dataset("dexycb" if data_dir else "synthetic", data_dir, robot)
    known = load_hand_poses(data.load_grasps, name)
    if known is None:
        return None
    given = (data.find_object_urdf(name), data.panda_urdf, known, GraspPreparationConfig())
    return get_validation_record_path(*given).stem, get_validation_record(*given)
