"""Measure the processor time of a scene by receiver, and estimate core-hours of test splits.

CPU time is measured, so that other processes on the machine have little influence. The preparation
for an object (`Policy.prepare`), which every process does once, is measured separately.

    python experiments/speed/scene_costs.py --data-dir DIR --out costs.md
"""

import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions

from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES, select_scenes_evenly
from handover_marl.evaluation.config import EvaluationConfig, resolve_config
from handover_marl.evaluation.episode_runner import EpisodeRunner, SceneTask
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.learning.training.scene_arguments import DatasetArgs


@dataclass(frozen=True)
class Args(DatasetArgs, OutputArgs):
    """Options of the measurement of CPU times per scene.

    Attributes:
        receivers: Names of the measured receivers, with options if there are any.
        scenes: Number of scenes of s0 test, evenly chosen.
        physics: Physics engine: exact or fast.
    """

    receivers: tuple[str, ...] = ("yang2021", "omg", "omg_hand_aware", "reactive")
    scenes: int = 6
    physics: str = "exact"


def main(args: Args) -> None:
    rows = []
    for receiver in args.receivers:
        seconds, preparing = measure_scene_times(args, receiver)
        mean = float(np.mean(seconds))
        hours = [f"{mean * SPLIT_SIZES[setup, 'test'] / 3600:.2f}" for setup in SETUPS]
        total = sum(mean * SPLIT_SIZES[setup, "test"] for setup in SETUPS) / 3600
        spread = f"{mean:.1f} ({min(seconds):.1f} to {max(seconds):.1f})"
        rows.append([f"`{receiver}`", spread, f"{preparing:.1f}", *hours, f"{total:.2f}"])
        print(rows[-1], flush=True)
    head = ["receiver", "s per scene", "s per object, once", *(f"{setup} h" for setup in SETUPS), "all h"]
    args.publish(
        "Costs",
        f"{describe_conditions()}, {args.scenes} scenes of s0 test, {args.physics} physics, "
        f"giver replay; core-hours of the test splits without what is done once.",
        format_table(head, rows),
    )


def measure_scene_times(args: Args, receiver: str) -> tuple[list[float], float]:
    """Return the CPU time of every scene, and the mean CPU time of the preparation for a scene (s).

    Args:
        args: Options of the script.
        receiver: Name of the receiver.
    """
    config = EvaluationConfig(
        "s0", "test", dataset=args.dataset, data_dir=args.data_dir, physics=args.physics, receiver=receiver
    )
    run, data = resolve_config(config)
    scenes = select_scenes_evenly(data.list_scenes("s0", "test"), args.scenes)
    runner = EpisodeRunner(replace(run, scenes=scenes), "1 at a time")
    preparing, seconds = [], []
    for scene in scenes:
        started = time.process_time()
        runner.receiver.prepare(data.load_info(scene).object_names)
        prepared = time.process_time()
        runner.run(SceneTask(0, scene))
        preparing.append(prepared - started)
        seconds.append(time.process_time() - prepared)
    runner.close()
    return seconds, float(np.mean(preparing))


if __name__ == "__main__":
    main(tyro.cli(Args))
