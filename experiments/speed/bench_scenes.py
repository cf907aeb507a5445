"""Measure how fast scenes are listed and generated, and the memory of the process.

    python experiments/speed/bench_scenes.py --scenes 500 --out scenes.md

One process generates consecutive training scenes of each data set. Times are processor time. The
first scenes are left out of the times: they load the shipped models and fill the caches.
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions, read_memory

from handover_marl.datasets import open_dataset
from handover_marl.evaluation.reports.tables import format_table

HEADER = ("data set", "list s", "median ms", "95 % ms", "scenes/s", "memory before MiB", "memory after MiB")


@dataclass(frozen=True, kw_only=True)
class Args(OutputArgs):
    """Options of the measurement of scene generation.

    Attributes:
        datasets: Names of the data sets.
        scenes: Number of scenes that are measured.
        first: Number of scenes that are generated before the measurement.
    """

    datasets: tuple[str, ...] = (
        "synthetic",
        "generated:n=100000,seed=7",
        "generated:n=100000,seed=7,family=hard",
    )
    scenes: int = 500
    first: int = 100


def measure(name: str, args: Args) -> list[str]:
    """Return the cells of the table row of a data set."""
    start = time.perf_counter()
    dataset = open_dataset(name)
    splits = {split: dataset.list_scenes(None, split) for split in ("train", "val", "test")}
    listed = time.perf_counter() - start
    scenes = splits["train"]
    for scene in scenes[: args.first]:
        dataset.load_info(scene)
    before, times = read_memory("VmRSS:"), []
    for scene in scenes[args.first : args.first + args.scenes]:
        start = time.process_time()
        dataset.load_info(scene)
        times.append(time.process_time() - start)
    median, tail = 1000.0 * np.quantile(times, [0.5, 0.95])
    rates = [f"{median:.1f}", f"{tail:.1f}", f"{1.0 / np.mean(times):.0f}"]
    return [name, f"{listed:.2f}", *rates, f"{before:.0f}", f"{read_memory('VmRSS:'):.0f}"]


def main(args: Args) -> None:
    """Measure all data sets and print a table."""
    rows = [measure(name, args) for name in args.datasets]
    args.publish("Speed of scene generation", describe_conditions(), format_table(HEADER, rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
