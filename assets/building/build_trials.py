"""Makes the shipped trials of grasps: `python -m handover_marl.assets.building.build_trials --data-dir DIR`.

For the library's own objects and those of a data folder, with both robots; some 20 core minutes for each. What the
user's cache folder has is taken from there. Needs the extra `planning`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl.assets.shipped_trials import TRIALS_PATH, Record, all_trials
from handover_marl.datasets import open_dataset
from handover_marl.files import write_arrays
from handover_marl.models.panda import PANDA, PANDA_CAMERA
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive.grasps import GraspTrials
from handover_marl.receivers.reactive.trials import record_file, trial_record


@dataclass(frozen=True)
class Args:
    """What to build.

    Attributes:
        out: The `.npz` file to write.
        data_dir: A folder in HandoverSim's layout, whose objects are tried out besides the library's own; without it
            the file's other records stay.
        workers: Processes.
    """

    out: Path = TRIALS_PATH
    data_dir: Path | None = None
    workers: int | None = None


@dataclass(frozen=True)
class Trial:
    """An object of a data set (a folder, or None for the library's own) and a robot."""

    data_dir: Path | None
    robot: str
    object_name: str

    def __str__(self) -> str:
        return f"{self.object_name} {self.robot}"


def name_and_record(trial: Trial) -> tuple[str, Record] | None:
    """How the record ships, or None for an object that nobody knows a grasp of."""
    data = open_dataset("dexycb" if trial.data_dir else "synthetic", trial.data_dir, trial.robot)
    known = ObjectGrasps(data.grasps).in_object(trial.object_name)
    if known is None:
        return None
    given = (data.object_urdf(trial.object_name), data.panda_urdf, known, GraspTrials())
    return record_file(*given).stem, trial_record(*given)


def trials(data_dir: Path | None) -> Iterator[Trial]:
    """All that there are: robots last, since they share half of the work."""
    for folder in (None, data_dir) if data_dir else (None,):
        for robot in (PANDA, PANDA_CAMERA):
            yield from (Trial(folder, robot, name) for name in CLASS_NAMES.values())


def main(args: Args) -> None:
    """Try all objects out and write one file."""
    records = {} if args.data_dir else dict(all_trials(args.out))
    everything = list(trials(args.data_dir))
    for _, found in worked_on(lambda: name_and_record, everything, "objects", PoolConfig(args.workers), progress=True):
        if found is not None:
            records[found[0]] = found[1]
    write_arrays(args.out, dict(sorted(records.items())))


if __name__ == "__main__":
    main(tyro.cli(Args))
