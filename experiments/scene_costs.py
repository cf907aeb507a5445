"""What a scene costs: seconds of one core from reading it to its end, by receiver, and core-hours of whole test splits.

Processor time is told, so that other work on the machine matters little. What a receiver does once for an object
(`Policy.prepare`) is told apart; it is done by every process for every object that it meets.

    python experiments/scene_costs.py --data-dir DIR --out costs.md
"""

import time
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
import tyro
from tabulate import tabulate

from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.playing import Player, Task
from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES
from handover_marl.files import write_atomically
from handover_marl.run import Run, resolve
from handover_marl.training.run_folder import spread_scenes


@dataclass(frozen=True)
class Args:
    """What to measure.

    Attributes:
        receivers: Whose costs.
        scenes: So many scenes of s0 test, evenly chosen.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic or auto.
        physics: exact or fast.
        out: Markdown file to write.
    """

    receivers: tuple[str, ...] = ("yang2021", "omg", "omg_hand_aware", "reactive")
    scenes: int = 6
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "exact"
    out: Path | None = None


def main(args: Args) -> None:
    rows = []
    for receiver in args.receivers:
        seconds, preparing = costs(args, receiver)
        mean = float(np.mean(seconds))
        hours = [f"{mean * SPLIT_SIZES[setup, 'test'] / 3600:.2f}" for setup in SETUPS]
        total = sum(mean * SPLIT_SIZES[setup, "test"] for setup in SETUPS) / 3600
        spread = f"{mean:.1f} ({min(seconds):.1f} to {max(seconds):.1f})"
        rows.append([f"`{receiver}`", spread, f"{preparing:.1f}", *hours, f"{total:.2f}"])
        print(rows[-1], flush=True)
    head = ["receiver", "s a scene", "s an object, once", *(f"{setup} h" for setup in SETUPS), "all h"]
    text = (
        f"{describe_machine()}, {date.today().isoformat()}, {args.scenes} scenes of s0 test, {args.physics} physics, "
        f"giver replay; core-hours of the test splits without what is done once.\n\n"
        + str(tabulate(rows, headers=head, tablefmt="github", disable_numparse=True))
    )
    print(text)
    if args.out is not None:
        write_atomically(args.out, f"# Costs\n\n{text}\n")


def costs(args: Args, receiver: str) -> tuple[list[float], float]:
    """Seconds of every scene, and the mean of those that preparing for an object took."""
    told = Run("s0", "test", dataset=args.dataset, data_dir=args.data_dir, physics=args.physics, receiver=receiver)
    run, data = resolve(told)
    scenes = spread_scenes(data.split("s0", "test"), args.scenes)
    player = Player(replace(run, scenes=scenes), "1 at a time")
    preparing, seconds = [], []
    for scene in scenes:
        started = time.process_time()
        player._receiver.prepare(data.info(scene).object_names)
        prepared = time.process_time()
        player.play(Task(0, scene))
        preparing.append(prepared - started)
        seconds.append(time.process_time() - prepared)
    player.close()
    return seconds, float(np.mean(preparing))


if __name__ == "__main__":
    main(tyro.cli(Args))
