"""Reference motions (joint targets) of human hand and objects, and motions that track them without contact.

Row k is step k of the current reference motion; row -1 is the state before its first step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import HandConfig, MotorConfig, ObjectConfig
from handover_marl.geometry.arrays import AnyArray

Array = npt.NDArray[np.float64]

#: Number of joints that carry the whole human hand: three prismatic, three revolute.
BASE_JOINTS = 6
#: Number of the human hand's link at the wrist.
WRIST_LINK = 6


@dataclass(frozen=True, eq=False)
class ReferenceMotion:
    """Joint targets of human hand and objects in n physics steps, of one world or of r worlds (world frame, m, rad).

    Attributes:
        objects: Joint targets (n, m, 6) of one world's m objects in the scene's order: xyz, intrinsic XYZ Euler angles,
            float32; or (r, n, 5, 6) of r worlds, with zeros for no object.
        hand: Joint targets (n, 51) or (r, n, 51) of the human hand, float32.
        hand_present: Whether the hand is in the scene in each step, (n,) or (r, n).
    """

    objects: AnyArray
    hand: AnyArray
    hand_present: AnyArray

    def select_rows(self, rows: AnyArray) -> "ReferenceMotion":
        """Return the reference motion of some of the r worlds: those with the indices `rows`."""
        return ReferenceMotion(self.objects[rows], self.hand[rows], self.hand_present[rows])

    def select(self, number: int, n_objects: int) -> "ReferenceMotion":
        """Return the reference motion of the one world with the index `number`, which has `n_objects` objects."""
        return ReferenceMotion(self.objects[number, :, :n_objects], self.hand[number], self.hand_present[number])

    def list_hand_targets(self) -> list[list[float] | None]:
        """Return the hand's 51 joint targets in each step of one world's motion; None in steps without a hand."""
        return [
            row if present else None
            for row, present in zip(self.hand.tolist(), self.hand_present.tolist(), strict=True)
        ]


def list_hand_motors(config: HandConfig) -> list[MotorConfig]:
    """Return the motor parameters of the human hand's 51 joints."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3 + [config.finger_motor] * 45


def list_object_motors(config: ObjectConfig) -> list[MotorConfig]:
    """Return the motor parameters of an object's six joints: xyz, then intrinsic XYZ Euler angles."""
    return [config.translation_motor] * 3 + [config.rotation_motor] * 3


def select_keypoint_links(joints: Sequence[int]) -> list[int]:
    """Return the numbers of the links whose origins are the 16 keypoints of a human hand: wrist and 15 finger joints.

    Args:
        joints: Numbers of the child links of the 51 moving joints. A finger joint consists of three moving joints, one
            for each axis; the child link of the first one has its origin at the finger joint.
    """
    return [WRIST_LINK, *joints[BASE_JOINTS::3]]


class BodyTrajectory:
    """Joint trajectory of a human hand or an object that tracks its reference motion without contact.

    The position error of each joint falls by a fixed ratio per step, as with Bullet's motors. The joint positions
    differ by less than 1e-4 (m, rad) from simulated ones. `track_references` computes them.

    Args:
        motors: Parameters of the motors of the d joints.
        start: Joint positions (d,) at the start, at rest (m, rad); None for a body that is absent at first.

    Attributes:
        gains: Fraction (d,) of its position error that each joint corrects in a step.
        joints: Joint positions (n + 2, d) in m and rad, zeros while the body is absent. Rows 0 and 1 are the last two
            steps before the reference motion; row k + 2 is after its step k.
        present: Whether the body is in the scene in each row of `joints`, (n + 2,).
    """

    def __init__(self, motors: Sequence[MotorConfig], start: npt.NDArray[np.float32] | None) -> None:
        self.gains = np.array([motor.position_gain for motor in motors])
        self.reset(start)

    def reset(self, start: npt.NDArray[np.float32] | None) -> None:
        """Set the body to joint positions (d,) (m, rad), at rest; None for a body that is absent at first."""
        self.present = np.full(2, start is not None)
        self.joints: Array = np.zeros((2, len(self.gains)))
        if start is not None:
            self.joints[:] = start

    def get_positions(self, row: int) -> Array:
        """Return the world positions (n - row, 3) of wrist or object origin in m after each step from `row` on.

        The reference motion has n steps. Positions are inf while the body is absent.
        """
        return np.where(self.present[row + 2 :, None], self.joints[row + 2 :, :3], np.inf)

    def is_present_after(self, row: int) -> bool:
        """Return whether the body is in the scene after step `row` of the current reference motion.

        Rows -1 and -2 are the last two steps before this motion.
        """
        return bool(self.present[row + 2])

    def get_joints(self, row: int) -> Array:
        """Return the joint positions (d,) (m, rad) after step `row`, -2 or more, of the current reference motion."""
        joints: Array = self.joints[row + 2]
        return joints


#: Body, its joint targets (n, d) in the next n steps (m, rad), and whether it is present in them (n,), None for always.
TrackedReference = tuple[BodyTrajectory, npt.NDArray[np.float32], npt.NDArray[np.bool_] | None]


def track_references(references: Sequence[TrackedReference]) -> None:
    """Replace `joints` and `present` of bodies by the trajectories under new reference motions.

    Each trajectory starts where the last one ends, and does not depend on how its steps are divided into calls.
    """
    moving: dict[int, list[tuple[BodyTrajectory, int, Array, Array]]] = {}
    for body, targets, presence in references:
        wanted, n_steps = targets.astype(np.float64), len(targets)
        position = body.joints[-1] if body.present[-1] else None
        joints, present = np.zeros((n_steps + 2, wanted.shape[1])), np.ones(n_steps + 2, dtype=bool)
        joints[:2], present[:2] = body.joints[-2:], body.present[-2:]
        cuts: list[int] = []
        if presence is not None:
            present[2:] = presence
            cuts = (np.flatnonzero(presence[1:] != presence[:-1]) + 1).tolist()
        body.joints, body.present = joints, present
        for first, last in zip([0, *cuts], [*cuts, n_steps], strict=True):
            if present[first + 2]:
                # A body appears at its target.
                start, part = wanted[first] if position is None else position, wanted[first:last]
                if (part == start).all():
                    # For joints at rest, the loop below would give the same values, only slower.
                    joints[first + 2 : last + 2] = part
                else:
                    moving.setdefault(len(part), []).append((body, first + 2, start, part))
            position = None
    # The joints of all bodies with equally many steps are computed together.
    for steps, group in moving.items():
        bodies, rows, starts, parts = zip(*group, strict=True)
        gains, position = np.concatenate([body.gains for body in bodies]), np.concatenate(starts)
        wanted, error = np.concatenate(parts, axis=1), np.empty(position.shape)
        trajectories, ends = np.empty(wanted.shape), np.cumsum([len(start) for start in starts])
        for step in range(steps):
            np.subtract(wanted[step], position, out=error)
            np.multiply(gains, error, out=error)
            position = np.add(position, error, out=trajectories[step])
        for body, row, own in zip(bodies, rows, np.split(trajectories, ends[:-1], axis=1), strict=True):
            body.joints[row : row + steps] = own
