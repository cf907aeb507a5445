"""Write a receiver, check it and evaluate it with the official rules.

    python experiments/examples/own_receiver.py --dataset synthetic

The receiver approaches a known grasp and closes the gripper when the distance to the object stops
decreasing. The script prints the official table of results.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

import handover_marl
from handover_marl import make_action_scheme
from handover_marl.cli.options import SceneNumbers
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.receivers import PolicyContext, Receiver
from handover_marl.testing import check_receiver


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the evaluation of a new receiver.

    Attributes:
        split: Split of the setup: train, val or test.
        scenes: Scene numbers; default: all scenes of the split.
        physics: Physics engine: fast, exact or mujoco.
        workers: Number of worker processes; default: one per core.
    """

    split: str = "val"
    scenes: SceneNumbers = None
    physics: str = "fast"
    workers: int | None = None


class ServoReceiver(Receiver):
    """Receiver that servos to a known grasp and closes the gripper there.

    Args:
        context: Robot, task and known grasps of the objects.
        tolerance: The gripper has arrived if its distance to the object changes by less than this (m) in a decision.
        max_distance: Largest distance (m) from gripper to object at which the gripper closes.
    """

    name, control_period = "servo", 0.1

    def __init__(self, context: PolicyContext, tolerance: float = 0.002, max_distance: float = 0.2) -> None:
        super().__init__(context)
        self._tolerance, self._max_distance = tolerance, max_distance
        # The action scheme solves the inverse kinematics and waits 2 s at the start of an episode.
        self._scheme = make_action_scheme("receiver", "grasp_servo", context)

    @property
    def wait(self) -> float:
        """Time for which the robot waits at the start of an episode (s); results state it."""
        return self._scheme.wait

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; the receiver draws no random numbers."""
        self._scheme.reset()
        self._last_distance, self._is_closed = np.inf, False

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        """Return the target positions (9,) of the seven arm joints (rad) and the two fingers (m)."""
        # Positions are in the world frame; the first object is the one to be handed over.
        distance = float(np.linalg.norm(observation["gripper_pose"][:3] - observation["object_poses"][0, :3]))
        has_arrived = abs(distance - self._last_distance) < self._tolerance and distance < self._max_distance
        self._last_distance, self._is_closed = distance, self._is_closed or has_arrived
        # Outputs 0 to 5 would correct the approach; the last one closes the gripper.
        self._scheme.set_outputs(np.array([0.0] * 6 + [float(self._is_closed)]))
        return self._scheme.compute_action(observation)


def main(args: Args) -> handover_marl.Report:
    # The conformance test that all receivers of the library pass, on a few decisions.
    check_receiver(ServoReceiver)
    report = handover_marl.benchmark(receiver=ServoReceiver, **vars(args))
    print(report)
    return report


if __name__ == "__main__":
    main(tyro.cli(Args))
