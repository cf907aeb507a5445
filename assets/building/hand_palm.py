"""The palm's and forearm's shape as tapered capsules: what meshes are made of and contacts are searched with."""

import numpy as np

from handover_marl.assets.hand_model import FloatArray, HandModel

#: A tapered capsule: start (3), end (3), radius at the start, radius at the end, all in metres.
Capsule = tuple[FloatArray, FloatArray, float, float]


def palm_capsules(hand: HandModel) -> list[Capsule]:
    """The palm of a hand in its own frame: four metacarpals and the balls of thumb and little finger."""
    index, middle, little, ring, thumb = _unscaled(hand, hand.joint_origins[::3])
    drop, wrist = np.array([0.0, -0.004, 0.0]), 0.0155
    capsules = [
        (np.array([-0.012, -0.002, 0.013]), index + drop, wrist, 0.0128),
        (np.array([-0.012, -0.002, 0.005]), middle + drop, wrist, 0.0130),
        (np.array([-0.012, -0.002, -0.005]), ring + drop, wrist, 0.0125),
        (np.array([-0.012, -0.003, -0.012]), little + drop / 2, wrist, 0.0118),
        (thumb + np.array([0.004, 0.0, -0.006]), thumb + np.array([-0.024, -0.006, 0.004]), 0.0150, 0.0125),
        (np.array([-0.022, -0.008, -0.019]), little + np.array([0.022, -0.006, 0.002]), 0.0135, 0.0115),
    ]
    return _scaled(hand, capsules)


def forearm_capsules(hand: HandModel) -> list[Capsule]:
    """The stub of the forearm behind the wrist, in the palm's frame."""
    return _scaled(
        hand,
        [(np.array([0.075, 0.0, z]), np.array([0.0, 0.0, z * 8.0 / 9.0]), 0.024, 0.0165) for z in (0.009, -0.009)],
    )


def capsule_balls(capsules: list[Capsule], count: int) -> tuple[FloatArray, FloatArray]:
    """Centres (len(capsules) * count, 3) and radii of balls spread evenly along capsules."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    centres = [start + t * (end - start) for start, end, _, _ in capsules]
    radii = [first + t[:, 0] * (last - first) for _, _, first, last in capsules]
    return np.vstack(centres), np.concatenate(radii)


def _stretch(hand: HandModel) -> FloatArray:
    return np.asarray(hand.scale * np.array([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0]))


def _unscaled(hand: HandModel, points: FloatArray) -> FloatArray:
    return np.asarray(points / _stretch(hand))


def _scaled(hand: HandModel, capsules: list[Capsule]) -> list[Capsule]:
    stretch, across = _stretch(hand), float(hand.scale[1])
    return [(a * stretch, b * stretch, r0 * across, r1 * across) for a, b, r0, r1 in capsules]
