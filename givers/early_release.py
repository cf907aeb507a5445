"""Giver that releases the object when the gripper is near, whether it holds the object or not."""

import math
from dataclasses import dataclass

import numpy as np

from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory, widen
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import compute_lengths, transform_points
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions


@dataclass(frozen=True)
class EarlyReleaseConfig(CheckedConfig):
    """Configuration of `EarlyReleaseGiver`.

    Attributes:
        distance: Distance from the middle between the robot's fingertips to the object's origin below which the
            gripper is near (m).
        max_delay: Largest time from the arrival of the gripper to the release (s).
    """

    distance: float = bounded(0.1, 0.0, 0.5)
    max_delay: float = bounded(0.5, 0.0, 13.0)


class EarlyReleaseGiver(ArrayGiver):
    """Giver that replays the recording and releases the object soon after the gripper has come near.

    The release does not depend on a grasp, so the robot must close its fingers in time. The rules of the task
    apply too: a grasp that is firm earlier leads to a release.
    """

    name = "early_release"
    control_period = 0.02
    default_config = EarlyReleaseConfig()
    config: EarlyReleaseConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._delay, self._near_since = arrays.zeros(count), arrays.full(count, math.nan)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with a random delay."""
        self._delay[row] = self.config.max_delay * np.random.default_rng(seed).random()
        self._near_since[row] = math.nan

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that follow the recordings and, after the delay, release the objects."""
        xp, now = self._arrays.xp, widen(observation["time"][:, 0])
        fingertips = transform_points(observation["gripper_pose"], np.array(FINGERTIPS))
        distance = compute_lengths(fingertips - observation["object_poses"][:, 0, :3])
        is_near = (distance < self.config.distance) & (observation["holding"][:, 0] != 0.0)
        since = self._near_since[rows]
        since = self._near_since[rows] = xp.where(xp.isnan(since) & is_near, now, since)
        return self.make_actions(rows, release=now - since >= self._delay[rows])
