"""Test the analytic robot grasps of procedural objects in simulation.

    python experiments/validate_generated_grasps.py --objects 10
    python experiments/validate_generated_grasps.py --objects 8 --thorough

For each object the script prints the number of grasps that the open gripper reaches without contact,
the number of grasps that hold the object while it is shaken, and the time of the quick validation by
which the receiver `reactive` selects grasps of procedural objects. With `--thorough` the table also
has the validation for objects of other data sets, which takes longer.
"""

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl.datasets.generated.dataset import GeneratedDataset
from handover_marl.datasets.generated.scenes import draw_procedural_object
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.receivers.grasp_library import GraspLibrary
from handover_marl.receivers.reactive.grasp_validation import validate_grasps
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig, make_quick_preparation_config
from handover_marl.simulation.engines import make_grasp_validator

HEADER = ("object", "kind", "grasps", "clear", "stable", "quick s", "quick held", "thorough s", "held", "both held")


@dataclass(frozen=True)
class Args:
    """Options of the comparison of analytic grasps with simulations.

    Attributes:
        config: Parameters of the generated scenes.
        objects: Number of objects, from the first one.
        thorough: Whether to make the thorough validation, too, which takes up to minutes for each object.
    """

    config: str = "n=1000,seed=7"
    objects: int = 10
    thorough: bool = False


def simulate_grasps(dataset: GeneratedDataset, name: str) -> tuple[int, int, int]:
    """Return how many grasps an object has, how many are free of collisions, and how many hold it when shaken."""
    grasps = dataset.load_grasps(name)
    if grasps is None:
        return 0, 0, 0
    validator = make_grasp_validator(dataset.find_object_urdf(name), GraspPreparationConfig().validation)
    try:
        clear = sum(validator.is_collision_free(grasp) for grasp in grasps)
        stable = sum(validator.is_stable(grasp) for grasp in grasps)
    finally:
        validator.close()
    return len(grasps), clear, stable


def measure_validation(
    dataset: GeneratedDataset, name: str, config: GraspPreparationConfig
) -> tuple[float, npt.NDArray[np.bool_]]:
    """Validate an object's grasps; return the time (s), less if cached, and a mask of the grasps that held."""
    known = GraspLibrary(dataset.load_grasps).get_hand_poses_in_object(name)
    if known is None:
        return 0.0, np.zeros(0, dtype=bool)
    start = time.process_time()
    grasps = validate_grasps(dataset.find_object_urdf(name), dataset.panda_urdf, known, config)
    return time.process_time() - start, grasps.success_rates[: len(known)] > 0.0


def main(args: Args) -> None:
    """Validate the grasps of all objects and print the table."""
    dataset, rows = GeneratedDataset(args.config), []
    names = list(dataset.object_names.items())[-dataset.config.objects :][: args.objects]
    for number, (_, name) in enumerate(names):
        kind = draw_procedural_object(dataset.config, number).kind
        counts = simulate_grasps(dataset, name)
        seconds, held = measure_validation(dataset, name, make_quick_preparation_config())
        row = [name, kind, *counts, f"{seconds:.1f}", int(held.sum())]
        if args.thorough:
            seconds, thorough = measure_validation(dataset, name, GraspPreparationConfig())
            row += [f"{seconds:.1f}", int(thorough.sum()), int((held & thorough).sum())]
        rows.append(row)
        print(row, flush=True)
    print(format_table(HEADER[: len(rows[0])], rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
