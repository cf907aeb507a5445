"""The way to a grasp as a field: from where a hand is, relative to where it is to be, to the step of one decision.

What a network is to imitate must follow from what it sees. A field over the relative pose does: wherever a hand
strays to, the label says how to get from there to the grasp, and no label depends on how it got there.

The hand turns and moves to a point before the grasp first, as fast as the decisions that are left want it, and goes in
from there in one step. GA-DDPG's rule closes the fingers as soon as 50 of 1,024 points are between them, at the end of
a decision, and commands the same pose while they close: who goes in by small steps has the object by the fingertips
when they close, who goes in by one has it where the grasp is. Who arrives early meets a person who still lifts it.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import compose, inverse

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ApproachConfig:
    """Of the field (m, rad).

    Attributes:
        standoff: The point before the grasp, back along the hand's z axis; nobody goes in from farther than this and
        over: this.
        pads: From the hand's origin to the middle between its pads, which has to be beside the axis by
        aligned: less than this for the hand to go all the way in; the point retreats evenly until it is
        astray: beside it by this, or by so much more as a turn that is missing counts:
        arm: metres a radian.
        cone: Metres that the point retreats for each metre beyond that.
        farthest: So far at most.
        shift: Longest step along an axis, and
        turn: largest turn about one.
        gain: What of the way a step covers before the hand goes in; more than 1 makes up for an arm that lags.
        spare: The way is shared out so that so many decisions are left at its end, but
        slowest: steps are allowed to be this long, and
        close: nearer than this as long as they may be at all.
    """

    standoff: float = 0.055
    over: float = 0.02
    pads: float = 0.1
    aligned: float = 0.008
    astray: float = 0.018
    arm: float = 0.05
    cone: float = 0.5
    farthest: float = 0.12
    shift: float = 0.06
    turn: float = np.pi / 6.0
    gain: float = 1.0
    spare: int = 20
    slowest: float = 0.02
    close: float = 0.1


def steps_to_goals(hands: Array, goals: Array, remaining: Array, config: ApproachConfig) -> Array:
    """Steps towards grasps.

    Args:
        hands: (n, 7) poses of the hand link.
        goals: (n, 7) its poses at the grasps, in the same frame.
        remaining: (n,) decisions left, this one counted.
        config: Of the field.

    Returns:
        (n, 6) translations (m) and Euler angles (rad) about x, y, z, axes at rest, in the hands' frames.
    """
    relative = compose(inverse(goals), hands)
    turns = Rotation.from_quat(relative[:, 3:])
    back, apart = _retreats(relative, turns, config)
    aims = goals.copy()
    aims[:, :3] -= back[:, None] * Rotation.from_quat(goals[:, 3:]).as_matrix()[..., 2]
    ways = compose(inverse(hands), aims)
    length = np.linalg.norm(ways[:, :3], axis=1)
    pace = length / (np.maximum(remaining - config.spare, 1.0))
    shift = np.where(length < config.close, config.shift, np.clip(pace, config.slowest, config.shift))
    gain = 1.0 + (config.gain - 1.0) * apart
    return _limited(
        gain[:, None] * ways[:, :3], gain[:, None] * Rotation.from_quat(ways[:, 3:]).as_rotvec(), shift, config
    )


def _retreats(relative: Array, turns: Rotation, config: ApproachConfig) -> tuple[Array, Array]:
    """(n,) how far before the grasp to go to, from (n, 7) poses in its frame, and (n,) that as a share, 0 to go in."""
    pads = relative[:, :3] + config.pads * turns.as_matrix()[..., 2]
    aside = np.linalg.norm(pads[:, :2], axis=1) + config.arm * turns.magnitude()
    astray = (aside - config.aligned) / (config.astray - config.aligned)
    # Half of the tolerance either way, since labels that jump cannot be learned.
    far = (-relative[:, 2] - config.standoff - 0.5 * config.over) / config.over
    share = np.clip(np.maximum(astray, far), 0.0, 1.0)
    more = config.cone * np.maximum(0.0, aside - config.astray)
    return share * np.minimum(config.standoff + more, config.farthest), share


def _limited(ways: Array, angles: Array, shift: Array, config: ApproachConfig) -> Array:
    """(n, 6) the same ways and rotation vectors, as much of both as one decision allows of either; shift is (n,)."""
    long = np.abs(ways).max(axis=1) / shift
    turned = np.abs(angles).max(axis=1) / config.turn
    # Together: who turns sooner than it moves loses the object out of sight.
    share = 1.0 / np.maximum(1.0, np.maximum(long, turned))
    euler = Rotation.from_rotvec(share[:, None] * angles).as_euler("xyz")
    return np.concatenate([share[:, None] * ways, np.clip(euler, -config.turn, config.turn)], axis=1)
