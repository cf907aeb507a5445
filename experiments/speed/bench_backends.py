"""Compare the wall-clock time of the same episodes on Ray workers and on local worker processes.

The backends alternate within one run, and each measurement starts new workers. Ray itself is
started once, which is measured separately. The load of the machine is printed with the ratios.

    python experiments/speed/bench_backends.py --data-dir DIR --out backends.md
"""

import os
import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions
from rich.console import Console
from rich.progress import track

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.config import EvaluationConfig, resolve_config
from handover_marl.evaluation.episode_runner import SceneTask, run_episodes
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.options import LOCAL, RAY, PoolConfig, resolve_worker_count
from handover_marl.execution.tasks import open_pool
from handover_marl.learning.training.scene_arguments import EvaluationArgs


@dataclass(frozen=True)
class Args(EvaluationArgs, OutputArgs):
    """Options of the comparison of Ray with local worker processes.

    Attributes:
        receiver: Name of the receiver, with options if there are any.
        split: Split of the setup: train, val or test.
        episodes: Number of episodes per measurement.
        repetitions: Number of measurements of each backend.
        workers: Number of workers of each backend; default: one per core.
        ray_address: Address of a Ray cluster; default: a running cluster, or a new local one.
    """

    receiver: str = "yang2021"
    split: str = "test"
    episodes: int = 100
    repetitions: int = 3
    ray_address: str | None = None


def main(args: Args) -> None:
    args = args.resolve_setup()
    workers = resolve_worker_count(args.workers)
    configs = {LOCAL: PoolConfig(workers), RAY: PoolConfig(workers, RAY, args.ray_address)}
    config = EvaluationConfig(
        args.setup, args.split, None, args.dataset, args.data_dir, args.physics, receiver=args.receiver
    )
    run, data = resolve_config(config)
    split = data.list_scenes(args.setup, args.split)
    scenes = select_scenes_evenly(split, args.episodes)
    tasks = [SceneTask(split.index(scene), scene, data.compute_fingerprint(scene)) for scene in scenes]
    started = time.perf_counter()
    open_pool(configs[RAY])
    connecting = time.perf_counter() - started
    seconds: dict[str, list[float]] = {LOCAL: [], RAY: []}
    for number in track(range(2 * args.repetitions), "measurements", console=Console(stderr=True)):
        # Local, Ray, Ray, local, ...: so that neither is always the first.
        backend = (LOCAL, RAY, RAY, LOCAL)[number % 4]
        started = time.perf_counter()
        finished = list(run_episodes(replace(run, scenes=scenes), tasks, open_pool(configs[backend])))
        seconds[backend].append(time.perf_counter() - started)
        assert len(finished) == len(tasks)
    ratios = np.array(seconds[RAY]) / np.array(seconds[LOCAL])
    rows = [[backend, *(f"{taken:.1f}" for taken in found)] for backend, found in seconds.items()]
    rows.append(["ratio", *(f"{ratio:.3f}" for ratio in ratios)])
    played = f"{len(tasks)} scenes of {args.setup} {args.split}, {data.name}, {args.receiver}, {args.physics} physics"
    whole = sum(seconds[RAY]) / sum(seconds[LOCAL])
    args.publish(
        "Backends",
        f"{describe_conditions()}, load {os.getloadavg()[0]:.1f} at the end. {played}, "
        f"{workers} workers; seconds of every repetition, start of workers included. "
        f"Ray started in {connecting:.1f} s.",
        format_table(["", *(f"repetition {n + 1}" for n in range(args.repetitions))], rows),
        f"Ratio of all repetitions together {whole:.3f}, median {np.median(ratios):.3f}.",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
