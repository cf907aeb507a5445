"""Measure the speed of steps, episodes and resets with each physics engine.

The measured environments alternate every few hundred steps in one process, so that drift of the
machine's speed cancels; ratios are computed within one run. PyBullet's `stepSimulation` is also
timed alone, inside an exact environment (with the simulated hand) and a fast one (without). MuJoCo
is measured where it is installed, with a batch of environments too. Step times are CPU times; the
batch uses one thread, so all speeds are per core.

    python experiments/speed/bench_speed.py --data-dir DIR --out speed.md
"""

import contextlib
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions, measure_peak_memory
from rich.console import Console
from rich.progress import Progress

import handover_marl
from handover_marl import receivers
from handover_marl.config import ARM_DOF, PandaConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.loop import run_episode
from handover_marl.episode.metrics.motion_trace import TraceRecorder
from handover_marl.evaluation.config import EvaluationConfig, resolve_config
from handover_marl.evaluation.episode_runner import SceneTask, run_episodes
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import open_pool
from handover_marl.learning.training.scene_arguments import DatasetArgs
from handover_marl.simulation.bullet.client import BulletClient
from handover_marl.simulation.engines import MUJOCO, list_available_physics

REAL_TIME = 1000  # physics steps in a second
MAX_TARGET_OFFSET = 0.05  # of joint targets from the start pose (rad)
PHYSICS = list_available_physics()


@dataclass(frozen=True)
class Args(DatasetArgs, OutputArgs):
    """Options of the speed measurements.

    Attributes:
        scene: Scene number in s0 train that is simulated.
        steps: Number of physics steps of one run; the episode must last that long.
        control_period: Time (s) for which an action is applied.
        steps_per_turn: Number of control steps for which one environment is measured before the next one.
        repetitions: Number of runs; the table gives median ratios and their range.
        episodes: Number of scenes of s0 val for whole episodes of `yang2021`; 0 skips them.
        workers: Numbers of worker processes to compare; empty skips this comparison.
        vector_envs: Number of environments in a MuJoCo batch; 0 skips this measurement.
    """

    scene: int = 105
    steps: int = 6000
    control_period: float = 0.1
    steps_per_turn: int = 5
    repetitions: int = 5
    episodes: int = 36
    workers: tuple[int, ...] = (1, 2)
    vector_envs: int = 256


@dataclass
class MeasuredEnv:
    """Environment, batch of environments, or engine whose steps are timed.

    Attributes:
        label: Name in the table.
        physics: Physics engine.
        engine_only: Whether only PyBullet's `stepSimulation` is timed.
        num_envs: Number of environments in the batch.
        mixed: Whether the environments of a batch simulate different scenes.
        seconds: CPU time of each run, per environment (s).
    """

    label: str
    physics: str
    engine_only: bool = False
    num_envs: int = 1
    mixed: bool = False
    seconds: list[float] = field(default_factory=list)


def main(args: Args) -> None:
    sections = [f"{describe_conditions()}.", make_step_table(args), make_reset_table(args)]
    if args.vector_envs and MUJOCO in PHYSICS:
        sections.append(make_batch_table(args))
    if args.episodes:
        sections.append(make_episode_table(args))
    if args.workers:
        sections.append(make_worker_table(args))
    args.publish("Speed", *sections)


def make_step_table(args: Args) -> str:
    """Return a table of the physics steps per second of all variants in small random motions."""
    variants = [
        MeasuredEnv("exact, env.step", "exact"),
        MeasuredEnv("fast, env.step", "fast"),
        MeasuredEnv("stepSimulation alone, with hand", "exact", engine_only=True),
        MeasuredEnv("stepSimulation alone, without hand", "fast", engine_only=True),
    ]
    if MUJOCO in PHYSICS:
        many = [
            MeasuredEnv(f"mujoco, batch of {args.vector_envs}", MUJOCO, num_envs=args.vector_envs),
            MeasuredEnv(
                f"mujoco, batch of {args.vector_envs}, mixed scenes", MUJOCO, num_envs=args.vector_envs, mixed=True
            ),
        ]
        variants[2:2] = [MeasuredEnv("mujoco, env.step", MUJOCO), *(many if args.vector_envs else [])]
    for _ in progress(range(args.repetitions), "steps"):
        measure_run(args, variants)
    exact, fast = (np.array(variant.seconds) for variant in variants[:2])
    rows = []
    for variant in variants:
        seconds = np.array(variant.seconds)
        rate, ratios = args.steps / np.median(seconds), exact / seconds
        memory = "-"
        if not variant.engine_only and variant.num_envs == 1:
            memory = f"{measure_peak_memory(step_single_env, args, variant.physics):.0f} MB"
        rows.append(
            [
                variant.label,
                f"{rate:.0f}",
                f"{np.median(ratios):.2f}",
                f"{ratios.min():.2f} to {ratios.max():.2f}",
                f"{np.median(fast / seconds):.2f}",
                f"{rate / REAL_TIME:.1f}",
                memory,
            ]
        )
    head = ["", "steps/s", "ratio to exact", "range", "ratio to fast", "real-time factor", "peak memory"]
    return (
        f"Scene {args.scene}, {args.steps} steps, {args.control_period:g} s control period, each with another target "
        f"within {MAX_TARGET_OFFSET:g} rad of the start, {args.repetitions} runs in turns, time of one core:\n\n"
        + format_table(head, rows)
    )


def make_batch_table(args: Args) -> str:
    """Return a table of the wall-clock speed of a batch of mixed scenes by its threads or processes."""
    fast = make_env(args, "fast")
    batches = {
        "mujoco, 1 thread": make_batch(args, args.vector_envs, threads=1),
        "mujoco, 2 threads": make_batch(args, args.vector_envs, threads=2),
        "mujoco, 2 processes": make_batch(args, args.vector_envs, processes=2),
    }
    envs: list[HandoverEnv | ParallelVectorEnv] = [fast, *batches.values()]
    counts = np.array([1, *(batch.num_envs for batch in batches.values())])
    control_steps = args.steps // round(args.control_period * REAL_TIME)
    rates = []
    for run in progress(range(args.repetitions), "batches"):
        seconds, generators = np.zeros(len(envs)), [np.random.default_rng(run) for _ in envs]
        for first in range(0, control_steps, args.steps_per_turn):
            for number, env in enumerate(envs):
                started = time.perf_counter()
                step_randomly(env, min(args.steps_per_turn, control_steps - first), generators[number])
                seconds[number] += time.perf_counter() - started
            fast.reset(options={"scene_id": args.scene})
            for batch in batches.values():
                batch.reset()
        rates.append(args.steps * counts / seconds)
    for env in envs:
        env.close()
    medians, ratios = np.median(rates, axis=0), np.median(np.array(rates) / np.array(rates)[:, :1], axis=0)
    labels = ["fast, one environment", *batches]
    rows = [[label, f"{rate:.0f}", f"{ratio:.2f}"] for label, rate, ratio in zip(labels, medians, ratios, strict=True)]
    return (
        f"Batches of {args.vector_envs} environments with scenes of s0 train, in wall-clock time, {args.repetitions} "
        "runs in turns:\n\n" + format_table(["", "steps/s", "ratio to fast"], rows)
    )


def measure_run(args: Args, variants: list[MeasuredEnv]) -> None:
    """Measure one run of every variant and append the CPU times; variants alternate every few steps."""
    envs, clocks = [], []
    for variant in variants:
        with time_engine() if variant.engine_only else contextlib.nullcontext() as clock:
            envs.append(make_measured_env(args, variant))
        if clock is not None:
            clock[0] = 0.0  # without the reset
        clocks.append(clock)
    seconds = np.zeros(len(variants))
    generators = [np.random.default_rng(0) for _ in envs]
    control_steps = args.steps // round(args.control_period * REAL_TIME)
    for first in range(0, control_steps, args.steps_per_turn):
        for number, env in enumerate(envs):
            started = time.process_time()
            step_randomly(env, min(args.steps_per_turn, control_steps - first), generators[number])
            seconds[number] += (time.process_time() - started) / variants[number].num_envs
    for variant, env, clock, taken in zip(variants, envs, clocks, seconds, strict=True):
        variant.seconds.append(float(taken) if clock is None else clock[0])
        env.close()


def make_measured_env(args: Args, variant: MeasuredEnv) -> HandoverEnv | ParallelVectorEnv:
    """Create and reset the environment, or batch of environments, of a variant."""
    if variant.num_envs == 1:
        return make_env(args, variant.physics)
    envs = make_batch(args, variant.num_envs, threads=1)
    envs.reset(seed=0, options=None if variant.mixed else {"scene_id": args.scene})
    return envs


def make_batch(args: Args, count: int, threads: int | None = None, processes: int | None = None) -> ParallelVectorEnv:
    """Create and reset a batch of environments in MuJoCo's physics, on threads or processes."""
    envs = handover_marl.vector_env(
        count,
        None,
        threads=threads,
        processes=processes,
        data_dir=args.data_dir,
        dataset=args.dataset,
        control_period=args.control_period,
        physics=MUJOCO,
    )
    envs.reset(seed=0)
    return envs


@contextlib.contextmanager
def time_engine() -> Iterator[list[float]]:
    """Measure the time of the physics steps of the PyBullet clients that are created in the block.

    Yields:
        A list whose only element accumulates the CPU time (s) in `stepSimulation`.
    """
    initialize, seconds = BulletClient.__init__, [0.0]

    def initialize_timed(client: Any, mode: int) -> None:
        initialize(client, mode)
        step = client.stepSimulation

        def timed_step() -> None:
            started = time.process_time()
            step()
            seconds[0] += time.process_time() - started

        client.stepSimulation = timed_step

    with mock.patch.object(BulletClient, "__init__", initialize_timed):
        yield seconds


def make_reset_table(args: Args) -> str:
    """Return a table of the wall-clock time of `env.reset`, with another scene in every call."""
    envs = {physics: make_env(args, physics) for physics in PHYSICS}
    scenes = envs["exact"].scene_ids[: 100 * 7 : 7]
    times: dict[str, list[float]] = {physics: [] for physics in PHYSICS}
    for scene in progress(scenes, "resets"):
        for physics, env in envs.items():
            started = time.perf_counter()
            env.reset(options={"scene_id": scene})
            times[physics].append(1000 * (time.perf_counter() - started))
    rows = []
    for physics, taken in times.items():
        rows.append([physics, *(f"{value:.1f}" for value in np.percentile(taken, [50, 95]))])
        envs[physics].close()
    return (
        f"`env.reset`, {len(scenes)} scenes of s0 train, each read anew from {envs['exact'].dataset.name}:\n\n"
        + format_table(["", "median ms", "95 % below ms"], rows)
    )


def make_episode_table(args: Args) -> str:
    """Return a table of the wall-clock time of whole episodes, with and without trace recorder."""
    data = args.open_dataset()
    policy = receivers.make("yang2021", data)
    scenes = data.list_scenes("s0", "val")[: args.episodes]
    kinds = [(physics, recorded) for physics in PHYSICS for recorded in (False, True)]
    seconds, steps = dict.fromkeys(kinds, 0.0), dict.fromkeys(kinds, 0)
    episodes, recorders = {kind: Episode(kind[0]) for kind in kinds}, {kind: TraceRecorder() for kind in kinds}
    # The first round loads models, which whole splits do once.
    for counts in (False, True):
        for scene_id in progress(scenes, "episodes"):
            for kind, episode in episodes.items():
                started = time.perf_counter()
                episode.reset(data.load_scene(scene_id))
                run_episode(episode, policy, callbacks=[recorders[kind]] if kind[1] else [])
                seconds[kind] += counts * (time.perf_counter() - started)
                steps[kind] += counts * episode.steps
    rows = [
        [
            f"{physics}{', recorded' if recorded else ''}",
            f"{seconds[physics, recorded]:.1f}",
            f"{steps[physics, recorded] / seconds[physics, recorded]:.0f}",
            f"{seconds['exact', False] / seconds[physics, recorded]:.2f}",
            f"{seconds[physics, recorded] / seconds[physics, False]:.3f}",
        ]
        for physics, recorded in kinds
    ]
    head = ["", "seconds", "steps/s", "ratio to exact", "time over that without recording"]
    return (
        f"Whole episodes of yang2021, {len(scenes)} scenes of s0 val, reading, reset and policy included:\n\n"
        + format_table(head, rows)
    )


def make_worker_table(args: Args) -> str:
    """Return a table of the wall-clock time of the same episodes by number of worker processes."""
    rows = []
    for physics in PHYSICS:
        config = EvaluationConfig("s0", "val", dataset=args.dataset, data_dir=args.data_dir, physics=physics)
        run, data = resolve_config(config)
        tasks = [SceneTask(index, scene) for index, scene in enumerate(data.list_scenes("s0", "val"))]
        taken = []
        for workers in args.workers:
            started = time.perf_counter()
            for _ in progress(
                run_episodes(run, tasks, open_pool(PoolConfig(workers))), f"{physics}, {workers} workers", len(tasks)
            ):
                pass
            taken.append(time.perf_counter() - started)
        rows += [
            [physics, workers, f"{seconds:.1f}", f"{taken[0] / seconds:.2f}"]
            for workers, seconds in zip(args.workers, taken, strict=True)
        ]
    head = ["", "workers", "seconds", f"ratio to {args.workers[0]} worker(s)"]
    return f"The benchmark of yang2021 on s0 val, {len(tasks)} scenes, start-up included:\n\n{format_table(head, rows)}"


def make_env(args: Args, physics: str) -> HandoverEnv:
    env = HandoverEnv(data_dir=args.data_dir, dataset=args.dataset, control_period=args.control_period, physics=physics)
    env.reset(seed=0, options={"scene_id": args.scene})
    return env


def step_randomly(env: HandoverEnv | ParallelVectorEnv, control_steps: int, rng: np.random.Generator) -> None:
    """Step environments with random joint targets near the start pose.

    The targets change in every control step, so that no cached rollout is reused.

    Args:
        env: Environment or batch of environments.
        control_steps: Number of control steps.
        rng: Random generator of the targets.
    """
    shape = (env.num_envs,) if isinstance(env, ParallelVectorEnv) else ()
    start = np.array(PandaConfig().start_joints, dtype=np.float32)
    for _ in range(control_steps):
        targets = np.tile(start, (*shape, 1))
        targets[..., :ARM_DOF] += rng.uniform(-MAX_TARGET_OFFSET, MAX_TARGET_OFFSET, (*shape, ARM_DOF))
        env.step({"giver": np.tile(NO_DEVIATION, (*shape, 1)), "receiver": targets})


def step_single_env(args: Args, physics: str) -> None:
    """Step one environment; called in a separate process, whose memory is measured."""
    step_randomly(make_env(args, physics), 20, np.random.default_rng(0))


def progress(items: Iterable[Any], label: str, total: int | None = None) -> Iterable[Any]:
    with Progress(console=Console(stderr=True), transient=True) as bar:
        yield from bar.track(items, total=total, description=label)


if __name__ == "__main__":
    main(tyro.cli(Args))
