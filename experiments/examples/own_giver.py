"""Write a giver, check it and compare it with the recorded person.

    python experiments/examples/own_giver.py --dataset synthetic

The giver holds the object nearer to the robot than the person in the recording, keeps still, and
releases the object as soon as the gripper has closed on it. The script prints the success of one
receiver with the recording and with this giver, on the same scenes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

import handover_marl
from handover_marl.cli.options import SceneNumbers
from handover_marl.givers import Giver, PolicyContext, make_giver_action
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.testing import check_giver


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Arguments of the comparison of a giver with the recorded person.

    Attributes:
        receiver: Name of the receiver, with options if there are any.
        split: Split of the setup: train, val or test.
        scenes: Scene numbers; default: all of the split.
    """

    receiver: str = "yang2021"
    split: str = "val"
    scenes: SceneNumbers = None


class MeetingGiver(Giver):
    """Giver that meets the robot part of the way and releases the object to a closed gripper.

    Args:
        context: Robot, task and known grasps of the objects.
        share: Fraction of the distance from object to gripper by which the object is moved.
        max_shift: Largest displacement of the object (m).
        near: Distance from gripper to object (m) above which the gripper cannot hold the object.
        release_after: Time (s) for which the robot's fingers must be still before the release.
    """

    name = "meeting"

    def __init__(
        self,
        context: PolicyContext,
        share: float = 0.3,
        max_shift: float = 0.15,
        near: float = 0.25,
        release_after: float = 0.2,
    ) -> None:
        super().__init__(context)
        self._share, self._max_shift, self._near, self._release_after = share, max_shift, near, release_after

    def reset(self, seed: int | None = None) -> None:
        """Clear the state of the previous episode, so that the hand starts as recorded."""
        self._displacement, self._closed_since = np.zeros(3), np.inf

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        """Return the deviation from the recording: displacement of the wrist (m), and release."""
        gripper, now = observation["gripper_pose"][:3], float(observation["time"][0])
        # The recorded wrist poses of the next 0.5 s show when the person is about to hold still.
        wrist = observation["replay_wrist_poses"][:, :3]
        if not self._displacement.any() and observation["holding"][0] and np.ptp(wrist, axis=0).max() < 0.01:
            # Decide once: objects that keep still are the easiest to grasp.
            to_gripper = gripper - observation["replay_object_poses"][-1, :3]
            distance = float(np.linalg.norm(to_gripper))
            self._displacement = to_gripper / distance * min(self._share * distance, self._max_shift)
        fingers, speeds = observation["robot_joint_position"][7:], observation["robot_joint_velocity"][7:]
        is_near = np.linalg.norm(gripper - observation["object_poses"][0, :3]) < self._near
        is_closed = is_near and (np.abs(speeds) < 2e-3).all() and (fingers < 0.0385).all()
        self._closed_since = min(self._closed_since, now) if is_closed else np.inf
        release = now - self._closed_since >= self._release_after
        return make_giver_action(displacement=self._displacement, release=release)


def main(args: Args) -> dict[str, handover_marl.Report]:
    # The conformance test that all givers of the library pass, on a few decisions.
    check_giver(MeetingGiver)
    reports = {}
    for name, giver in (("replay", "replay"), ("meeting", MeetingGiver)):
        reports[name] = handover_marl.evaluate_pair(giver, **vars(args))
    for name, report in reports.items():
        print(f"{name:8} success {report.success_rate:.1%}, contact {report.contact_rate:.1%}")
    return reports


if __name__ == "__main__":
    main(tyro.cli(Args))
