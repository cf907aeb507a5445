"""Posture of the giver's arm, rated by the arm scores of RULA.

RULA is the method of McAtamney and Corlett, "RULA: a survey method for the investigation of work-related
upper limb disorders", Applied Ergonomics 24(2), 1993. Recordings contain the wrist only, so shoulder and
elbow are assumptions, see `ArmModel`.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_DOWN: Final = np.array([0.0, 0.0, -1.0])
_FORWARD: Final = np.array([0.0, -1.0, 0.0])
# Joint angles (deg) at which the score of the upper arm increases, and the range of the forearm without a higher score.
_FLEXIONS, _EXTENSION, _FOREARM_RANGE = (20.0, 45.0, 90.0), 20.0, (60.0, 100.0)
# Angle (deg) of the upper arm to the vertical plane through shoulder and robot above which it is abducted.
_ABDUCTION = 20.0


@dataclass(frozen=True)
class ArmModel:
    """Assumed shoulders and arm lengths of a person who faces the robot, along -y of the world.

    Lengths are those of a person of 1.75 m (Drillis and Contini, 1966): 0.186, 0.146 and 0.129 times the height.
    95 % of the wrist positions in DexYCB are within reach of these shoulders.

    Attributes:
        chest: Point in the middle between both shoulders, world frame (m).
        half_shoulder_width: Distance of a shoulder from that point, along x (m).
        upper_arm: Distance from shoulder to elbow (m).
        forearm: Distance from elbow to wrist (m).
    """

    chest: tuple[float, float, float] = (0.56, 0.65, 1.35)
    half_shoulder_width: float = 0.226
    upper_arm: float = 0.326
    forearm: float = 0.256


DEFAULT_ARM: Final = ArmModel()


def compute_rula_arm_scores(wrist: Array, side: str, arm: ArmModel = DEFAULT_ARM) -> npt.NDArray[np.int_]:
    """Compute the sum of RULA's scores of upper arm (1 to 5) and forearm (1 to 3) at n times, 2 to 8.

    The elbow hangs as low as the wrist's position allows. A wrist out of reach has a straight arm.

    Args:
        wrist: (n, 3) positions of the wrist in the world frame (m).
        side: Side of the arm, "right" or "left".
        arm: Shoulders and lengths.
    """
    # A person who faces -y has the left arm at larger x.
    outward = np.array([1.0 if side == "left" else -1.0, 0.0, 0.0])
    shoulder = np.array(arm.chest) + arm.half_shoulder_width * outward
    upper, elbow_flexion = _pose_arm(wrist - shoulder, arm)
    return _score_upper_arm(upper, outward) + _score_forearm(elbow_flexion, (wrist - shoulder) @ outward, arm)


def _pose_arm(reach: Array, arm: ArmModel) -> tuple[Array, Array]:
    """Return unit vectors (n, 3) from shoulder to elbow, and the flexions of the elbow (n,) in degrees.

    Args:
        reach: (n, 3) vectors from shoulder to wrist (m).
        arm: Lengths.
    """
    longest, shortest = arm.upper_arm + arm.forearm, abs(arm.upper_arm - arm.forearm)
    lengths = np.linalg.norm(reach, axis=1, keepdims=True)
    axis = np.where(lengths > 1e-9, reach / np.maximum(lengths, 1e-9), _FORWARD)
    lengths = np.clip(lengths, max(shortest, 1e-3), longest)
    along = (lengths**2 + arm.upper_arm**2 - arm.forearm**2) / (2.0 * lengths)
    away = np.sqrt(np.maximum(arm.upper_arm**2 - along**2, 0.0))
    low = _DOWN - (axis @ _DOWN)[:, None] * axis
    # An elbow has no lowest position if the wrist is right above or below the shoulder; it is then behind.
    low = np.where(np.linalg.norm(low, axis=1, keepdims=True) > 1e-6, low, -_FORWARD)
    low /= np.linalg.norm(low, axis=1, keepdims=True)
    cosine = (arm.upper_arm**2 + arm.forearm**2 - lengths[:, 0] ** 2) / (2.0 * arm.upper_arm * arm.forearm)
    flexion = 180.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return (along * axis + away * low) / arm.upper_arm, flexion


def _score_upper_arm(upper: Array, outward: Array) -> npt.NDArray[np.int_]:
    """Return the scores (n,) of upper arms with directions (n, 3): 1 to 4, and 1 more if abducted."""
    angle = np.degrees(np.arccos(np.clip(upper @ _DOWN, -1.0, 1.0)))
    is_forward = upper @ _FORWARD >= 0.0
    scores = np.where(is_forward, 1 + np.digitize(angle, _FLEXIONS, right=True), 1 + (angle > _EXTENSION))
    abduction = np.degrees(np.arcsin(np.clip(upper @ outward, -1.0, 1.0)))
    return np.asarray(scores + (abduction > _ABDUCTION))


def _score_forearm(flexion: Array, lateral: Array, arm: ArmModel) -> npt.NDArray[np.int_]:
    """Return the scores (n,) of forearms: 1 or 2, and 1 more if the wrist is out to the side or past the midline.

    Args:
        flexion: (n,) flexions of the elbow (deg).
        lateral: (n,) distances of the wrist from the shoulder, outward (m).
        arm: Shoulder width.
    """
    low, high = _FOREARM_RANGE
    is_bent = (flexion >= low) & (flexion <= high)
    is_beside = (lateral > 0.0) | (lateral < -arm.half_shoulder_width)
    return np.asarray(np.where(is_bent, 1, 2) + is_beside)
