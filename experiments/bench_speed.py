"""What stepping the environment costs over the physics engine alone, in one process.

Two environments play the same scene with the same constant action, in turns of a few hundred steps so that the
machine's drift cancels. The first is timed from outside; in the second only the calls of Bullet's
`stepSimulation` are. Their ratio is the price of motors, rules and observations.

    python experiments/bench_speed.py --data-dir DIR
"""

import multiprocessing
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tabulate import tabulate

from handover_marl.benchmarking.machine import describe_machine
from handover_marl.config import PandaConfig
from handover_marl.handover_env import HandoverEnv
from handover_marl.spaces import GIVER_ACTION_SIZE


@dataclass(frozen=True)
class Args:
    """What to measure.

    Attributes:
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        scene: The scene to play, in s0 train.
        steps: Physics steps of one run; the episode must last that long.
        control_period: Time an action holds (s).
        turn: Control steps before the other environment has its turn.
        repeats: Runs; the table gives the median ratio and its range.
    """

    data_dir: str | None = None
    scene: int = 105
    steps: int = 6000
    control_period: float = 0.1
    turn: int = 5
    repeats: int = 5


@dataclass
class EngineClock:
    """Adds up the time spent in `stepSimulation`."""

    seconds: float = 0.0

    def watch(self, env: HandoverEnv) -> None:
        """Time the engine of an environment that has been reset."""
        client: Any = env._episode.world._client
        step = client.stepSimulation

        def timed_step() -> None:
            started = time.perf_counter()
            step()
            self.seconds += time.perf_counter() - started

        client.stepSimulation = timed_step


def main(args: Args) -> None:
    runs = [measure(args) for _ in range(args.repeats)]
    env_rates = [args.steps / env_seconds for env_seconds, _ in runs]
    engine_rates = [args.steps / engine_seconds for _, engine_seconds in runs]
    ratios = [env_seconds / engine_seconds for env_seconds, engine_seconds in runs]
    rows = [
        ["stepSimulation alone", f"{np.median(engine_rates):.0f}", "1.000", "-"],
        [
            f"env.step, {args.control_period:g} s control period",
            f"{np.median(env_rates):.0f}",
            f"{np.median(ratios):.3f}",
            f"{min(ratios):.3f} to {max(ratios):.3f}",
        ],
    ]
    print(f"Scene {args.scene}, {args.steps} steps, exact physics, {args.repeats} runs, {describe_machine()}.\n")
    print(tabulate(rows, headers=["", "steps/s", "cost", "range"], tablefmt="github", disable_numparse=True))
    print(f"\nPeak memory of a process with one environment: {single_memory_mb(args)} MB.")


def measure(args: Args) -> tuple[float, float]:
    """Seconds in `env.step`, and seconds in `stepSimulation` of the same steps."""
    timed, watched = make_env(args), make_env(args)
    clock = EngineClock()
    clock.watch(watched)
    control_steps = args.steps // timed.control_steps
    env_seconds = 0.0
    for first in range(0, control_steps, args.turn):
        turn = min(args.turn, control_steps - first)
        started = time.perf_counter()
        act(timed, turn)
        env_seconds += time.perf_counter() - started
        act(watched, turn)
    timed.close()
    watched.close()
    return env_seconds, clock.seconds


def make_env(args: Args) -> HandoverEnv:
    env = HandoverEnv(data_dir=args.data_dir, control_period=args.control_period)
    env.reset(seed=0, options={"scene_id": args.scene})
    return env


def act(env: HandoverEnv, control_steps: int) -> None:
    actions = {
        "giver": np.zeros(GIVER_ACTION_SIZE, dtype=np.float32),
        "receiver": np.array(PandaConfig().start_joints, dtype=np.float32),
    }
    for _ in range(control_steps):
        env.step(actions)


def peak_memory_mb() -> int:
    """Peak resident memory of this process (MB), from Linux's own account."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) // 1024


def memory_of_one(args: Args, results: Any) -> None:
    act(make_env(args), 20)
    results.put(peak_memory_mb())


def single_memory_mb(args: Args) -> int:
    """Peak resident memory (MB) of a fresh process with one environment."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    process = context.Process(target=memory_of_one, args=(args, results))
    process.start()
    memory: int = results.get()
    process.join()
    return memory


if __name__ == "__main__":
    main(tyro.cli(Args))
