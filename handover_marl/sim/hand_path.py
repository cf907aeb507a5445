"""Where the hand goes by kinematics alone, whatever simulates the rest of the world."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, HandConfig, MotorConfig
from handover_marl.models.kinematic_tree import KinematicTree
from handover_marl.sim.follower import Follower, follow_together
from handover_marl.sim.motion import Motion

#: Joints that carry the whole hand: three that slide, three that turn.
BASE_JOINTS = 6
_WRIST_LINK = 6


def hand_motors(config: HandConfig) -> list[MotorConfig]:
    """The motors of the 51 joints."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3 + [config.finger_motor] * 45


def keypoint_links(joints: Sequence[int]) -> list[int]:
    """Numbers of the wrist's link and of the 15 finger joints' first links, given those of the moving joints.

    Every third finger joint is the first of its three axes; its link frame is the joint's origin.
    """
    return [_WRIST_LINK, *joints[BASE_JOINTS::3]]


class HandPath:
    """The joints of a hand that follows its targets as its motors do while nothing pushes back.

    Rows are those of the motion it is led by; -1 is before its first.

    Args:
        tree: Its links.
        config: How its joints are driven.
        start: Where it is at first, a motion of one row.

    Attributes:
        tree: Its links.
    """

    def __init__(self, tree: KinematicTree, config: HandConfig, start: Motion) -> None:
        self.tree = tree
        self._motors = hand_motors(config)
        self._follower: Follower | None = None
        # A hand at rest is looked at often: its joints and keypoints when last seen.
        self._seen: tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]] | None = None
        # One row more than the motion has: the first is where it was before.
        self._path, self._present = np.zeros((1, HAND_DOF)), np.zeros(1, dtype=bool)
        self.lead(start)
        self._path, self._present = self._path[-1:], self._present[-1:]

    def lead(self, motion: Motion) -> None:
        """Work out where it will be in the coming steps."""
        lead_together([self], [motion])

    def begin(self, motion: Motion) -> list[tuple[Follower, slice]]:
        """What is to be followed of a motion: by whom, in which rows."""
        present, stretches = motion.hand_present, []
        cuts = (np.flatnonzero(np.diff(present)) + 1).tolist()
        for first, last in zip([0, *cuts], [*cuts, len(motion)], strict=True):
            if not present[first]:
                self._follower = None
                continue
            if self._follower is None:
                # A hand that appears does so at its target.
                self._follower = Follower(self._motors, motion.hand[first])
            stretches.append((self._follower, slice(first, last)))
        return stretches

    def end(self, motion: Motion, stretches: Sequence[tuple[Follower, slice]]) -> None:
        """Take over what was followed."""
        path = np.zeros((len(motion) + 1, HAND_DOF))
        path[0] = self._path[-1]
        for follower, rows in stretches:
            path[rows.start + 1 : rows.stop + 1] = follower.path
        self._path = path
        self._present = np.concatenate([self._present[-1:], motion.hand_present])

    def centers(self, row: int) -> npt.NDArray[np.float64]:
        """(n - row, 3) where its base will be after the steps from `row` on (m); inf where there is no hand."""
        return np.where(self._present[row + 1 :, None], self._path[row + 1 :, :3], np.inf)

    def changes(self) -> npt.NDArray[np.bool_]:
        """(n,) whether it is elsewhere after each step than before it, or comes or goes in it."""
        moved = (self._path[1:] != self._path[:-1]).any(axis=1)
        return np.asarray(moved | (self._present[1:] != self._present[:-1]))

    def present_after(self, row: int) -> bool:
        """Whether there is a hand after step `row`."""
        return bool(self._present[row + 1])

    def joints(self, row: int) -> npt.NDArray[np.float64]:
        """(51,) its joints after step `row` (m, rad)."""
        joints: npt.NDArray[np.float64] = self._path[row + 1]
        return joints

    def dof(self, row: int) -> npt.NDArray[np.float32]:
        """The same in float32."""
        return self.joints(row).astype(np.float32)

    def keypoints(self, row: int) -> npt.NDArray[np.float32]:
        """(16, 3) world positions (m) of the wrist and of the 15 finger-joint origins, as `WorldState` has them."""
        joints = self.joints(row)
        if self._seen is None or not np.array_equal(joints, self._seen[0]):
            moving = [link for link, joint in enumerate(self.tree.joints) if joint.kind != "fixed"]
            origins, _ = self.tree.frames(joints[None])
            self._seen = joints, origins[0, keypoint_links(moving)].astype(np.float32)
        keypoints: npt.NDArray[np.float32] = self._seen[1].copy()
        return keypoints


def lead_together(hands: Sequence[HandPath], motions: Sequence[Motion]) -> None:
    """As `HandPath.lead` for some hands, each by its own motion."""
    stretches = [hand.begin(motion) for hand, motion in zip(hands, motions, strict=True)]
    followers = [follower for own in stretches for follower, _ in own]
    rows = [motion.hand[part] for own, motion in zip(stretches, motions, strict=True) for _, part in own]
    follow_together(followers, rows)
    for hand, motion, own in zip(hands, motions, stretches, strict=True):
        hand.end(motion, own)
