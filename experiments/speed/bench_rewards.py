"""Measure how much user-defined rewards slow down the environments of a training, as ratios within one run.

    python experiments/speed/bench_rewards.py --dataset synthetic

The variants step equal batches of environments in turns, with equal actions, so that they simulate the
same episodes. CPU time is measured, so that other processes on the machine have little influence. The
time of the networks is left out: in a training the share of the rewards is smaller.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from measuring import OutputArgs, describe_conditions
from rich.progress import track

import handover_marl
from handover_marl import TermWeights, Transition, combine_rewards
from handover_marl.envs.reward_terms import TERMS
from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.learning.training.scene_arguments import DatasetArgs
from handover_marl.simulation.engines import MUJOCO


@dataclass(frozen=True)
class Args(DatasetArgs, OutputArgs):
    """Options of the measurement of user-defined rewards.

    Attributes:
        physics: Simulation: mujoco, fast or exact.
        num_envs: Number of environments in each batch.
        control_period: Time between two decisions (s).
        decisions: Number of decisions of each environment in a run.
        steps_per_turn: Number of decisions for which one batch is measured before the next one.
        repetitions: Number of runs; the table gives medians and ranges.
        features: Name of the receiver's features.
        actions: Name of the receiver's action scheme.
        giver: Name of the frozen giver.
    """

    physics: str = MUJOCO
    num_envs: int = 32
    control_period: float = 0.2
    decisions: int = 60
    steps_per_turn: int = 2
    repetitions: int = 5
    features: str = "close"
    actions: str = "grasp_servo"
    giver: str = "cooperative"


def reward_approach(transition: Transition) -> dict[str, dict[str, float]]:
    """Return a reward that is fast to compute: the approach to the object (m), force (N s) and success."""
    before, after = (
        np.linalg.norm(state["object_poses"][0, :3] - state["gripper_pose"][:3])
        for state in (transition.state, transition.next_state)
    )
    force = transition.contacts.robot_object_force * transition.duration
    success = 5.0 * transition.is_success
    return {"receiver": {"approach": float(before - after), "force": -0.01 * force, "handover": success}}


ALL_TERMS = TermWeights(receiver=dict.fromkeys(TERMS, 0.1), giver=dict.fromkeys(TERMS, 0.1))
#: Rewards by name; ratios refer to the first.
VARIANTS: dict[str, Any] = {
    "sparse": "sparse",
    "shaped": "shaped",
    "cheap function": reward_approach,
    "all reward terms": ALL_TERMS,
    "shaped, function and all terms": combine_rewards("shaped", reward_approach, ALL_TERMS),
}


def main(args: Args) -> None:
    seconds = np.array([measure_run(args, run) for run in track(range(args.repetitions), description="runs")])
    rows = []
    for number, name in enumerate(VARIANTS):
        extra = 100.0 * (seconds[:, number] / seconds[:, 0] - 1.0)
        rate = args.num_envs * args.decisions / np.median(seconds[:, number])
        rows.append([name, f"{rate:.0f}", f"{np.median(extra):+.1f}", f"{extra.min():+.1f} to {extra.max():+.1f}"])
    head = ["rewards", "decisions/s of one core", "additional time %", "range %"]
    args.publish(
        "Speed of rewards",
        f"{describe_conditions()}, {args.num_envs} environments, {args.physics} physics, s0 train of "
        f"{args.open_dataset().name}, giver `{args.giver}`, features `{args.features}`, actions `{args.actions}`, "
        f"{args.control_period:g} s control period, {args.decisions} decisions in turns of {args.steps_per_turn}, "
        f"{args.repetitions} runs.",
        format_table(head, rows),
    )


def measure_run(args: Args, run: int) -> list[float]:
    """Return the CPU time (s) of the decisions of one run, by variant."""
    # The first batch is not measured: it fills the caches of scenes and grasps, which all batches use.
    batches = [make_batch(args, rewards) for rewards in ("sparse", *VARIANTS.values())]
    generators = [np.random.default_rng(run) for _ in batches]
    for envs in batches:
        envs.reset(seed=1000 * run)
    seconds = np.zeros(len(batches))
    for turn in range(args.decisions // args.steps_per_turn):
        # The order changes, so that no variant always follows the same one.
        for number in (0, *(1 + np.roll(np.arange(len(VARIANTS)), turn)).tolist()):
            envs, rng = batches[number], generators[number]
            started = time.process_time()
            for _ in range(args.steps_per_turn):
                envs.step(rng.uniform(-0.3, 0.3, envs.action_space.shape).astype(np.float32))
            seconds[number] += time.process_time() - started
    for envs in batches:
        envs.close()
    measured: list[float] = seconds[1:].tolist()
    return measured


def make_batch(args: Args, rewards: Any) -> HandoverVectorEnv:
    """Make the environments of one variant, as the training scripts do."""
    return handover_marl.vector_env(
        args.num_envs,
        "receiver",
        args.giver,
        features=args.features,
        schemes=args.actions,
        autoreset="same_step",
        threads=1,
        data_dir=args.data_dir,
        dataset=args.dataset,
        physics=args.physics,
        control_period=args.control_period,
        max_cycles=40,
        rewards=rewards,
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
