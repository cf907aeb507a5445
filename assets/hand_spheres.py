"""Approximation of hands by capsules and spheres."""

from typing import Final

import numpy as np

from handover_marl.assets.hand_model import FloatArray, HandGeometry

#: Number of spheres of a phalanx.
N_SPHERES: Final = 3

#: Tapered capsule (m): start (3,), end (3,), radius at the start, radius at the end.
Capsule = tuple[FloatArray, FloatArray, float, float]


def make_palm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return the capsules of a palm: metacarpals and balls of thumb and little finger."""
    index, middle, little, ring, thumb = _unscale_points(hand, hand.joint_origins[::3])
    drop, wrist = np.array([0.0, -0.004, 0.0]), 0.0155
    capsules = [
        (np.array([-0.012, -0.002, 0.013]), index + drop, wrist, 0.0128),
        (np.array([-0.012, -0.002, 0.005]), middle + drop, wrist, 0.0130),
        (np.array([-0.012, -0.002, -0.005]), ring + drop, wrist, 0.0125),
        (np.array([-0.012, -0.003, -0.012]), little + drop / 2, wrist, 0.0118),
        (thumb + np.array([0.004, 0.0, -0.006]), thumb + np.array([-0.024, -0.006, 0.004]), 0.0150, 0.0125),
        (np.array([-0.022, -0.008, -0.019]), little + np.array([0.022, -0.006, 0.002]), 0.0135, 0.0115),
    ]
    return _scale_capsules(hand, capsules)


def make_forearm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return the capsules of the end of the forearm in the palm's frame."""
    return _scale_capsules(
        hand,
        [(np.array([0.075, 0.0, z]), np.array([0.0, 0.0, z * 8.0 / 9.0]), 0.024, 0.0165) for z in (0.009, -0.009)],
    )


def spheres_from_capsules(capsules: list[Capsule], count: int) -> tuple[FloatArray, FloatArray]:
    """Return centers (len(capsules) * count, 3) and radii of spheres spaced evenly in capsules."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    centers = [start + t * (end - start) for start, end, _, _ in capsules]
    radii = [first + t[:, 0] * (last - first) for _, _, first, last in capsules]
    return np.vstack(centers), np.concatenate(radii)


def _compute_scale(hand: HandGeometry) -> FloatArray:
    return np.asarray(hand.scale * np.array([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0]))


def _unscale_points(hand: HandGeometry, points: FloatArray) -> FloatArray:
    return np.asarray(points / _compute_scale(hand))


def _scale_capsules(hand: HandGeometry, capsules: list[Capsule]) -> list[Capsule]:
    stretch, across = _compute_scale(hand), float(hand.scale[1])
    return [(a * stretch, b * stretch, r0 * across, r1 * across) for a, b, r0, r1 in capsules]


class HandSpheres:
    """Approximation of a right hand by spheres: three per phalanx, others in palm and forearm.

    Args:
        model: Geometry of a right hand.

    Attributes:
        model: Geometry of the hand.
        along: (15, 3, 3) centers (m) of the phalanges' spheres, in the frames of the phalanges.
        radii: (15, 3) radii (m) of the phalanges' spheres.
        palm: Centers (k, 3) and radii (k,) (m) of the palm's spheres, in the palm's frame.
        forearm: Centers and radii of the forearm's spheres, in the palm's frame (m).
    """

    def __init__(self, model: HandGeometry) -> None:
        self.model = model
        t = (np.arange(N_SPHERES) + 1.0) / N_SPHERES
        self.along = model.tips[:, None, :] * t[:, None]
        self.radii = model.radii[:, :1] + (model.radii[:, 1:] - model.radii[:, :1]) * t
        self.palm = spheres_from_capsules(make_palm_capsules(model), 6)
        self.forearm = spheres_from_capsules(make_forearm_capsules(model), 4)

    def place_phalanges(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return centers (n, 15, 3, 3) in m of three spheres per phalanx, and the phalanges' rotations.

        Both are in the palm's frame, for finger joint angles (n, 45) in rad.
        """
        dof = np.concatenate([np.zeros((len(angles), 6)), angles], axis=1)
        dof[:, :3] = -self.model.palm_offset
        positions, rotations = self.model.compute_link_poses(dof)
        centers = positions[:, 1:, None, :] + np.einsum("nlij,lbj->nlbi", rotations[:, 1:], self.along)
        return centers, rotations[:, 1:]
