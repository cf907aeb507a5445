"""Measure the speed of environments with each physics engine, or with MuJoCo Warp.

    python experiments/bench_speed.py --data-dir DIR
    python experiments/bench_speed.py --warp --sizes 256 1024 4096
    python experiments/bench_speed.py --cameras --vector-envs 32

The measured environments take turns of a few steps, and speeds are compared within one run, so that changes of the
machine's speed cancel. With `--warp`, the script measures vector environments on a device, for several numbers of
environments; the first step, which compiles kernels, is left out. With `--cameras`, it measures observations of the
wrist camera in MuJoCo's physics.
"""

import time
from dataclasses import dataclass
from datetime import date
from typing import Any

import numpy as np
import tyro
from rich.progress import track

import handover_marl
from handover_marl.config import ARM_DOF, PandaConfig, make_camera
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.spaces import POINTCLOUD, STATE
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.options import describe_machine
from handover_marl.geometry.arrays import make_tensor_factory
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.simulation.engines import CUDA, FAST, MUJOCO, WARP, list_available_physics

SCENE = 105  # scene in s0 train that single environments simulate
MAX_TARGET_OFFSET = 0.05  # largest difference of joint targets from the start pose (rad)
STEPS_PER_TURN = 5  # control steps for which an environment is measured before the next one


@dataclass(frozen=True)
class Args(SetupArgs):
    """Options of the speed measurements.

    Attributes:
        decisions: Number of control steps of one run; episodes must last that long.
        control_period: Time for which an action is applied (s).
        repetitions: Number of runs on the processor; the table gives median ratios and their range.
        vector_envs: Number of environments in a MuJoCo batch on the processor; 0 skips batches.
        cameras: Whether to measure observations of the wrist camera instead.
        warp: Whether to measure MuJoCo Warp instead.
        sizes: Numbers of environments with MuJoCo Warp.
        device: Device of MuJoCo Warp: cuda, or cpu.
    """

    decisions: int = 60
    control_period: float = 0.1
    repetitions: int = 5
    vector_envs: int = 256
    cameras: bool = False
    warp: bool = False
    sizes: tuple[int, ...] = (64, 256, 1024, 4096)
    device: str = CUDA


def measure_processor(args: Args) -> str:
    """Measure environments on the processor during small random motions; return a table of their speeds.

    The table has a row for each engine and each kind of batch, with its physics steps per second of wall-clock time and
    the ratio to the speed of the engine "fast".
    """
    where: dict[str, Any] = {"data_dir": args.data_dir, "dataset": args.dataset, "setup": args.setup}
    where["control_period"] = args.control_period
    envs: dict[str, HandoverEnv | ParallelVectorEnv] = {
        physics: handover_marl.parallel_env(physics=physics, **where) for physics in list_available_physics()
    }
    if args.vector_envs and MUJOCO in envs:
        for name, count in (("threads", 1), ("threads", 2), ("processes", 2)):
            label = f"mujoco, batch of {args.vector_envs}, {name}={count}"
            options: dict[str, Any] = {**where, "physics": MUJOCO, name: count}
            envs[label] = handover_marl.vector_env(args.vector_envs, None, **options)
    seconds = np.zeros((args.repetitions, len(envs)))
    for run in track(range(args.repetitions), "runs"):
        generators = [np.random.default_rng(run) for _ in envs]
        for env in envs.values():
            env.reset(seed=0, options=None if isinstance(env, ParallelVectorEnv) else {"scene_id": SCENE})
        for first in range(0, args.decisions, STEPS_PER_TURN):
            for number, env in enumerate(envs.values()):
                started = time.perf_counter()
                step_randomly(env, min(STEPS_PER_TURN, args.decisions - first), generators[number])
                seconds[run, number] += time.perf_counter() - started
    counts = np.array([getattr(env, "num_envs", 1) for env in envs.values()])
    rates = 1000.0 * args.control_period * args.decisions * counts / seconds
    ratios = rates / rates[:, [list(envs).index(FAST)]]
    for env in envs.values():
        env.close()
    rows = [
        [label, f"{np.median(rate):.0f}", f"{np.median(ratio):.2f}", f"{ratio.min():.2f} to {ratio.max():.2f}"]
        for label, rate, ratio in zip(envs, rates.T, ratios.T, strict=True)
    ]
    return format_table(("", "physics steps/s", "ratio to fast", "range"), rows)


def step_randomly(env: HandoverEnv | ParallelVectorEnv, decisions: int, rng: np.random.Generator) -> None:
    """Step an environment `decisions` times with random joint targets near the start pose, so that no cache helps."""
    shape = (env.num_envs,) if isinstance(env, ParallelVectorEnv) else ()
    start = np.array(PandaConfig().start_joints, dtype=np.float32)
    for _ in range(decisions):
        targets = np.tile(start, (*shape, 1))
        targets[..., :ARM_DOF] += rng.uniform(-MAX_TARGET_OFFSET, MAX_TARGET_OFFSET, (*shape, ARM_DOF))
        env.step({"giver": np.tile(NO_DEVIATION, (*shape, 1)), "receiver": targets})


def measure_cameras(args: Args) -> str:
    """Measure observations of the wrist camera, and return a table: a row for each mode and image size.

    The columns are the observations per second of wall-clock time in two processes, and the processor time of one
    observation and its control step in one process. The first row is without camera.
    """
    sizes: dict[tuple[str, int], str] = {(STATE, 224): "state, no camera", (POINTCLOUD, 224): "points"}
    sizes |= {("rgb+depth", side): f"RGB-D, {side} x {side}" for side in (224, 128)}
    envs, frames = list[ParallelVectorEnv](), np.zeros((args.repetitions, 2, len(sizes)))
    where: dict[str, Any] = {"data_dir": args.data_dir, "dataset": args.dataset, "setup": args.setup}
    where["autoreset"] = "same_step"
    for mode, side in sizes:
        options = {**where, "obs_mode": mode, "cameras": (make_camera("wrist", width=side, height=side),)}
        envs.append(handover_marl.vector_env(args.vector_envs, None, processes=2, **options))
        envs.append(handover_marl.vector_env(8, None, threads=1, **options))
    for number, env in enumerate(envs):
        env.reset(seed=number)
    for run in track(range(args.repetitions), "runs"):
        for number, env in enumerate(envs):
            clock = (time.perf_counter, time.process_time)[number % 2]
            started = clock()
            step_randomly(env, STEPS_PER_TURN, np.random.default_rng(run))
            frames[run, number % 2, number // 2] = (clock() - started) / STEPS_PER_TURN / env.num_envs
    for env in envs:
        env.close()
    wall, processor = np.median(frames, axis=0)
    rows = [
        (name, f"{1.0 / one:.0f}", f"{1e3 * other:.2f}")
        for name, one, other in zip(sizes.values(), wall, processor, strict=True)
    ]
    return format_table(("observation", "observations/s", "processor ms"), rows)


def measure_warp(args: Args, count: int) -> tuple[float, float]:
    """Return the physics steps and the decisions per second of `count` environments with MuJoCo Warp."""
    envs = handover_marl.vector_env(
        count,
        "receiver",
        "cooperative",
        features="close",
        action_scheme="grasp_servo",
        autoreset="same_step",
        backend=WARP,
        device=args.device,
        setup=args.setup,
        dataset=args.dataset,
        data_dir=args.data_dir,
        control_period=args.control_period,
    )
    envs.reset(seed=0)
    # The outputs are on the device from the start, like those of a network.
    outputs = make_tensor_factory(args.device).asarray(
        np.random.default_rng(0).uniform(-1.0, 1.0, (1 + args.decisions, count, *envs.single_action_space.shape)),
        "float32",
    )

    now = envs.step(outputs[0])[-1]["steps"]
    simulated, started = now * 0, time.perf_counter()
    for output in outputs[1:]:
        before, now = now, envs.step(output)[-1]["steps"]
        # The difference is negative where an episode has started again; these steps are not counted.
        simulated += (now - before).clip(0)
    total = int(simulated.sum())
    seconds = time.perf_counter() - started
    envs.close()
    return total / seconds, args.decisions * count / seconds


def main(args: Args) -> None:
    """Measure the speed that the arguments select, and print it as a table with machine and date."""
    if args.cameras:
        print(measure_cameras(args))
    elif args.warp:
        found = [(count, *measure_warp(args, count)) for count in args.sizes]
        rows = [(count, f"{steps:,.0f}", f"{decisions:,.1f}") for count, steps, decisions in found]
        print(format_table(("environments", "physics steps/s", "decisions/s"), rows))
        print(f"\nDevice: {args.device} (Warp's cpu is for tests).")
    else:
        print(measure_processor(args))
    print(f"\n{describe_machine()}, {date.today().isoformat()}.")


if __name__ == "__main__":
    main(tyro.cli(Args))
