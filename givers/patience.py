"""Noticing that nobody comes, and offering in another way then."""

import numpy as np

from handover_marl.episode.observations import Observation


class Patience:
    """Offers differently each time that for a while the gripper has not come nearer.

    People who hold something out in vain do not wait for ever: they hold it as they first had it, or otherwise.

    Attributes:
        share: How much of one's own deviation from the recording is to be kept now.
    """

    wait = 2.0  # s without the gripper coming nearer
    progress = 0.02  # m that count as coming nearer
    shares = (1.0, 0.0, 0.5, -0.5)  # one after the other, and again

    def __init__(self) -> None:
        self.share = self.shares[0]
        self._tries = 0
        self._nearest = np.inf
        self._since: float | None = None

    def watch(self, observation: Observation) -> None:
        """Take note of where the gripper is; call it from when the offer stands, at every decision."""
        now = float(observation["time"][0])
        gap = float(np.linalg.norm(observation["gripper_pose"][:3] - observation["object_poses"][0, :3]))
        if self._since is None or gap < self._nearest - self.progress:
            self._nearest, self._since = gap, now
        elif now - self._since >= self.wait:
            self._tries += 1
            self.share = self.shares[self._tries % len(self.shares)]
            self._nearest, self._since = np.inf, now
