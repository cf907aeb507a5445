"""Giver that releases the object when the gripper is near, whether it holds the object or not."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from handover_marl.config import CheckedConfig, Limits
from handover_marl.episode.observations import Observation
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import transform_points
from handover_marl.policies.policy import Action, Giver, PolicyContext, make_giver_action


@dataclass(frozen=True)
class EarlyReleaseConfig(CheckedConfig):
    """Configuration of `EarlyReleaseGiver`.

    Attributes:
        distance: Distance from the middle between the robot's fingertips to the object's origin below which the
            gripper is near (m).
        max_delay: Largest time from the arrival of the gripper to the release (s).
    """

    limits: ClassVar[Limits] = {"distance": (0.0, 0.5), "max_delay": (0.0, 13.0)}

    distance: float = 0.1
    max_delay: float = 0.5


class EarlyReleaseGiver(Giver):
    """Giver that replays the recording and releases the object soon after the gripper has come near.

    The release does not depend on a grasp, so the robot must close its fingers in time. The rules of the task
    apply too: a grasp that is firm earlier leads to a release.

    Args:
        context: Robot and task, which this giver does not use.
        distance: Distance from the middle between the robot's fingertips to the object's origin below which the
            gripper is near, up to 0.5 m.
        max_delay: Largest time from the arrival of the gripper to the release, up to 13 s; the delay is
            uniformly distributed.
    """

    name = "early_release"
    control_period = 0.02

    def __init__(
        self,
        context: PolicyContext | None = None,
        distance: float = EarlyReleaseConfig.distance,
        max_delay: float = EarlyReleaseConfig.max_delay,
    ) -> None:
        super().__init__(context)
        self.config = EarlyReleaseConfig(distance, max_delay)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode with a random delay."""
        self._delay = self.config.max_delay * np.random.default_rng(seed).random()
        self._near_since: float | None = None

    def act(self, observation: Observation) -> Action:
        """Return the action (8,) that follows the recording and, after the delay, releases the object."""
        now = float(observation["time"][0])
        fingertips = transform_points(observation["gripper_pose"], FINGERTIPS)
        distance = float(np.linalg.norm(fingertips - observation["object_poses"][0, :3]))
        if self._near_since is None and distance < self.config.distance and observation["holding"][0]:
            self._near_since = now
        return make_giver_action(release=self._near_since is not None and now - self._near_since >= self._delay)
