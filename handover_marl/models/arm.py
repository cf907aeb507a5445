"""The arm as planning sees it: where its hand and its body are, for many configurations at once.

Arrays have the configurations last, so that every operation runs along memory: (3, n) points, (3, 3, n) rotations,
all in the frame of the robot's base.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import KinematicTree
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK, OPEN

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Frames:
    """Link frames of n configurations: `origins` (L, 3, n) in m, and `rotations` (L, 3, 3, n)."""

    origins: Array
    rotations: Array


class Arm:
    """Forward kinematics and Jacobians of a Panda with its fingers at one opening.

    Links are numbered as planning counts them: 0-6 the arm's, 7 the hand, 8 and 9 the fingers.

    Args:
        tree: The robot.
        opening: Position of both finger joints (m).

    Raises:
        SimulationError: It is no Panda: a link is missing, or a joint does not turn about its z axis.
    """

    def __init__(self, tree: KinematicTree, opening: float = OPEN) -> None:
        names = [joint.link for joint in tree.joints]
        missing = {HAND_LINK, *FINGER_LINKS} - set(names)
        if missing:
            raise SimulationError(f"planning needs a Panda's model; links {sorted(missing)} are not there")
        hand = names.index(HAND_LINK)
        self._turning = tree.turning_joints(hand)
        self.link_names = [names[link] for link in self._turning] + [HAND_LINK, *FINGER_LINKS]
        self.n_joints = len(self._turning)
        steps = []
        for link, before in zip(self._turning, [-1, *self._turning], strict=False):
            if not np.allclose(tree.joints[link].axis, (0.0, 0.0, 1.0)):
                raise SimulationError(f"planning knows joints that turn about z; that of {names[link]} does not")
            steps.append(_fixed(tree, link, before, opening))
        self._steps = steps
        self._hand = _fixed(tree, hand, self._turning[-1], opening)
        self._fingers = [_fixed(tree, names.index(finger), hand, opening) for finger in FINGER_LINKS]

    def chain(self, joints: Array) -> Frames:
        """Frames of the turning links and the hand for configurations (n, 7)."""
        count = len(joints)
        origins = np.empty((self.n_joints + 1, 3, count))
        rotations = np.empty((self.n_joints + 1, 3, 3, count))
        sines, cosines = np.sin(joints.T), np.cos(joints.T)
        origin, rotation = np.zeros((3, count)), np.repeat(np.eye(3)[..., None], count, axis=2)
        for number, (offset, turn) in enumerate(self._steps):
            origin = origin + offset @ rotation
            x, y, z = np.moveaxis(turn.T @ rotation, 1, 0)
            sine, cosine = sines[number], cosines[number]
            rotation = np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)
            origins[number], rotations[number] = origin, rotation
        offset, turn = self._hand
        origins[-1], rotations[-1] = origin + offset @ rotation, turn.T @ rotation
        return Frames(origins, rotations)

    def frames(self, joints: Array) -> Frames:
        """Frames of all ten links for configurations (n, 7)."""
        chain = self.chain(joints)
        hand, turned = chain.origins[-1], chain.rotations[-1]
        fingers = [(hand + offset @ turned, turn.T @ turned) for offset, turn in self._fingers]
        return Frames(
            np.concatenate([chain.origins, [origin for origin, _ in fingers]]),
            np.concatenate([chain.rotations, [rotation for _, rotation in fingers]]),
        )

    def jacobian(self, chain: Frames) -> Array:
        """(6, 7, n): how the hand's origin moves (m/rad) and turns with each joint."""
        axes = chain.rotations[:-1, :, 2]
        levers = chain.origins[-1] - chain.origins[:-1]
        columns = np.concatenate([np.cross(axes, levers, axis=1), axes], axis=1)
        jacobian: Array = columns.transpose(1, 0, 2)
        return jacobian


def body_points(frames: Frames, on_links: Sequence[Array]) -> Array:
    """Points of a body for n configurations.

    Args:
        frames: Of L links.
        on_links: (m, 3) points in each link's frame (m).

    Returns:
        (3, L * m, n), link by link.
    """
    moved = [
        points @ rotation + origin[:, None]
        for points, origin, rotation in zip(on_links, frames.origins, frames.rotations, strict=True)
    ]
    return np.concatenate(moved, axis=1)


def _fixed(tree: KinematicTree, link: int, before: int, opening: float) -> tuple[Array, Array]:
    """Offset (3,) and turn (3, 3) of a link in the frame of one that carries it, sliding joints opened."""
    offset, turn = np.zeros(3), np.eye(3)
    while link != before:
        joint = tree.joints[link]
        slide = opening * joint.axis if joint.kind == "prismatic" else np.zeros(3)
        offset = joint.offset + joint.turn @ (slide + offset)
        turn = joint.turn @ turn
        link = joint.parent
    return offset, turn
