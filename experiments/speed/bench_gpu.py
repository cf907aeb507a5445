"""Measure the speed of vector environments with MuJoCo Warp against the number of environments.

    python experiments/speed/bench_gpu.py --sizes 256 1024 4096
    python experiments/speed/bench_gpu.py --obs-mode pointcloud

Random outputs of the receiver are repeated until every environment has made some decisions. With a camera, they are
changes of the joint positions, and the observations are not replaced by features. The first step of each number of
environments, which compiles kernels, is not measured.
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions, describe_device

import handover_marl
from handover_marl.episode.spaces import STATE
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.geometry.arrays import AnyArray, make_tensor_factory
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.simulation.engines import CUDA, WARP

# Largest change of a joint position in a control period without action scheme (rad, m).
_LARGEST_CHANGE = 0.1


@dataclass(frozen=True)
class Args(SetupArgs, OutputArgs):
    """Options of the measurement.

    Attributes:
        sizes: Numbers of environments.
        decisions: Number of measured steps of each vector environment.
        device: Device of MuJoCo Warp: cuda, or cpu.
        control_period: Time for which an action holds (s).
        obs_mode: Observation mode of the receiver, "state" or one with point clouds or images.
    """

    sizes: tuple[int, ...] = (64, 256, 1024, 4096)
    decisions: int = 20
    device: str = CUDA
    control_period: float = 0.2
    obs_mode: str = STATE


def measure(args: Args, count: int) -> tuple[float, float]:
    """Return the physics steps and the decisions per second of a number of environments."""
    # Images are rendered only for observations that are returned.
    is_encoded = args.obs_mode == STATE
    envs = handover_marl.vector_env(
        count,
        "receiver",
        "cooperative",
        features="close" if is_encoded else None,
        schemes="grasp_servo" if is_encoded else None,
        obs_mode=args.obs_mode,
        autoreset="same_step",
        backend=WARP,
        device=args.device,
        setup=args.setup,
        dataset=args.dataset,
        data_dir=args.data_dir,
        control_period=args.control_period,
    )
    observations, _ = envs.reset(seed=0)
    rng = np.random.default_rng(0)
    # On the device from the start, as those of a network.
    outputs = make_tensor_factory(args.device).asarray(
        rng.uniform(-1.0, 1.0, (1 + args.decisions, count, *envs.single_action_space.shape)), "float32"
    )

    def step(output: AnyArray) -> AnyArray:
        """Step all environments, and return their numbers of simulated steps."""
        nonlocal observations
        actions = output if is_encoded else observations["robot_joint_position"] + _LARGEST_CHANGE * output
        observations, _, _, _, infos = envs.step(actions)
        return infos["steps"]

    now = step(outputs[0])
    simulated, started = now * 0, time.perf_counter()
    for output in outputs[1:]:
        before, now = now, step(output)
        # Steps of an episode that starts again are not counted.
        simulated += (now - before).clip(0)
    total = int(simulated.sum())
    seconds = time.perf_counter() - started
    envs.close()
    return total / seconds, args.decisions * count / seconds


def main(args: Args) -> None:
    """Measure all numbers of environments, and print a table."""
    rows = []
    for count in args.sizes:
        steps, decisions = measure(args, count)
        rows.append((count, f"{steps:,.0f}", f"{decisions:,.1f}"))
    device = f"Device: {describe_device(args.device)}. {describe_conditions()}."
    table = format_table(("environments", "physics steps/s", "decisions/s"), rows)
    args.publish("Speed of MuJoCo Warp", f"Observation mode: {args.obs_mode}. {device}", table)


if __name__ == "__main__":
    main(tyro.cli(Args))
