"""What Ray costs beside local workers: the same episodes with the same number of workers, in turns within one run.

Each turn starts its workers anew, on both sides. Ray itself is started once, before, which is told apart. Where other
work shares the machine, ratios of neighbouring turns still hold; how busy it was is told with them.

    python experiments/bench_backends.py --data-dir DIR --out backends.md
"""

import os
import time
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from tabulate import tabulate

from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.playing import Task
from handover_marl.benchmarking.task_pool import play_tasks
from handover_marl.files import write_atomically
from handover_marl.options import check_workers
from handover_marl.pools.pool_config import LOCAL, RAY, PoolConfig
from handover_marl.pools.working import open_pool
from handover_marl.run import Run, resolve
from handover_marl.training.run_folder import spread_scenes


@dataclass(frozen=True)
class Args:
    """What to measure.

    Attributes:
        receiver: Who plays.
        setup: Official setup,
        split: and split that scenes are taken of.
        episodes: How many in a turn.
        turns: Of each backend.
        workers: Processes of each; default: one a core.
        ray_address: Of a cluster; default: where Ray finds one, or one of this machine's own.
        physics: fast, where an episode's own cost hides least, or exact.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic or auto.
        out: Markdown file to write.
    """

    receiver: str = "yang2021"
    setup: str = "s0"
    split: str = "test"
    episodes: int = 100
    turns: int = 3
    workers: int | None = None
    ray_address: str | None = None
    physics: str = "fast"
    data_dir: str | None = None
    dataset: str = "auto"
    out: Path | None = None


def main(args: Args) -> None:
    workers = check_workers(args.workers)
    configs = {LOCAL: PoolConfig(workers), RAY: PoolConfig(workers, RAY, args.ray_address)}
    told = Run(
        *(args.setup, args.split),
        dataset=args.dataset,
        data_dir=args.data_dir,
        physics=args.physics,
        receiver=args.receiver,
    )
    run, data = resolve(told)
    split = data.split(args.setup, args.split)
    scenes = spread_scenes(split, args.episodes)
    tasks = [Task(split.index(scene), scene, data.fingerprint(scene)) for scene in scenes]
    started = time.perf_counter()
    open_pool(configs[RAY])
    connecting = time.perf_counter() - started
    seconds: dict[str, list[float]] = {LOCAL: [], RAY: []}
    for turn in track(range(2 * args.turns), "turns", console=Console(stderr=True)):
        # Local, Ray, Ray, local, ...: so that neither is always the first.
        backend = (LOCAL, RAY, RAY, LOCAL)[turn % 4]
        started = time.perf_counter()
        ends = {
            played.task: played.result for played in play_tasks(replace(run, scenes=scenes), tasks, configs[backend])
        }
        seconds[backend].append(time.perf_counter() - started)
        assert len(ends) == len(tasks)
    ratios = np.array(seconds[RAY]) / np.array(seconds[LOCAL])
    rows = [[backend, *(f"{taken:.1f}" for taken in found)] for backend, found in seconds.items()]
    rows.append(["ratio", *(f"{ratio:.3f}" for ratio in ratios)])
    played = f"{len(tasks)} scenes of {args.setup} {args.split}, {data.name}, {args.receiver}, {args.physics} physics"
    whole = sum(seconds[RAY]) / sum(seconds[LOCAL])
    text = (
        f"{describe_machine()}, {date.today().isoformat()}, load {os.getloadavg()[0]:.1f} at the end. {played}, "
        f"{workers} workers; seconds of every turn, start of workers included. Ray started in {connecting:.1f} s.\n\n"
        + str(tabulate(rows, headers=["", *(f"turn {n + 1}" for n in range(args.turns))], tablefmt="github"))
        + f"\n\nRatio of all turns together {whole:.3f}, median {np.median(ratios):.3f}."
    )
    print(text)
    if args.out is not None:
        write_atomically(args.out, f"# Backends\n\n{text}\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
