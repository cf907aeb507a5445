"""Metrics of fluency, safety and effort of a handover, in addition to HandoverSim's metrics.

Idle times, concurrent activity and functional delay follow Hoffman, "Evaluating Fluency in Human-Robot Collaboration",
IEEE Transactions on Human-Machine Systems 49(3), 2019. For handovers, the task is the whole episode; a person is active
while the wrist moves faster than `ACTIVE_SPEED`; a robot is active while its hand link moves faster than `ACTIVE_SPEED`
or its fingers faster than `ACTIVE_FINGER_SPEED`. Smoothness is the spectral arc length of Balasubramanian et al., "On
the analysis of movement smoothness", Journal of NeuroEngineering and Rehabilitation 12:112, 2015. Smoothness does not
depend on speed and duration. The root mean square of the jerk depends on both; it is minimal in the minimum-jerk model
of human reaching (Flash and Hogan, Journal of Neuroscience 5(7), 1985). The jerk is computed by the filter of Savitzky
and Golay, Analytical Chemistry 36(8), 1964. The exchange begins with the receiver's first contact and ends
with the release, as the physical handover phase of Ortenzi et al., "Object Handovers: A Review for Robotics", IEEE
Transactions on Robotics 37(6), 2021. RULA (rapid upper limb assessment) rates postures: McAtamney and Corlett, Applied
Ergonomics 24(2), 1993.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP
from handover_marl.episode.metrics.motion import (
    EpisodeTrace,
    compute_rms_jerk,
    compute_spectral_arc_length,
    compute_speeds,
    find_activities,
)

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

ACTIVE_SPEED, ACTIVE_FINGER_SPEED = 0.05, 0.005  # m/s
_DOWN: Final = np.array([0.0, 0.0, -1.0])
_FORWARD: Final = np.array([0.0, -1.0, 0.0])
# Angles (deg) of the upper arm, forward and backward, at which its score increases, and range of the elbow's flexion in
# which the forearm has its lowest score.
_FLEXIONS, _EXTENSION, _FOREARM_RANGE = (20.0, 45.0, 90.0), 20.0, (60.0, 100.0)
# The upper arm is abducted if its angle (deg) to the vertical plane through shoulder and robot is larger than this.
_ABDUCTION = 20.0
#: Assumed arms of a person who faces the robot, along -y of the world: middle between both shoulders in the world
#: frame, distance of a shoulder from it along x, and lengths of upper arm and forearm (m). The lengths are those of a
#: person of 1.75 m (Drillis and Contini, 1966): 0.186, 0.146 and 0.129 times the height. 95 % of the wrist positions in
#: DexYCB are within reach of these shoulders.
CHEST, HALF_SHOULDER_WIDTH, UPPER_ARM, FOREARM = (0.56, 0.65, 1.35), 0.226, 0.326, 0.256


def compute_rula_arm_scores(wrist: Array, side: str) -> npt.NDArray[np.int_]:
    """Compute the sums (n,) of RULA's scores of upper arm (1 to 5) and forearm (1 to 3) at n times.

    The elbow hangs as low as the wrist's position allows. If the wrist is out of reach, the arm is straight.

    Args:
        wrist: (n, 3) positions of the wrist in the world frame (m).
        side: Side of the arm, "right" or "left".
    """
    # A person who faces -y has the left arm at larger x.
    outward = np.array([1.0 if side == "left" else -1.0, 0.0, 0.0])
    shoulder = np.array(CHEST) + HALF_SHOULDER_WIDTH * outward
    upper, elbow_flexion = _pose_arm(wrist - shoulder)
    return _score_upper_arm(upper, outward) + _score_forearm(elbow_flexion, (wrist - shoulder) @ outward)


def _pose_arm(reach: Array) -> tuple[Array, Array]:
    """Return unit vectors (n, 3) from shoulder to elbow, and the flexions of the elbow (n,) in degrees.

    Args:
        reach: (n, 3) vectors from shoulder to wrist (m).
    """
    longest, shortest = UPPER_ARM + FOREARM, abs(UPPER_ARM - FOREARM)
    lengths = np.linalg.norm(reach, axis=1, keepdims=True)
    axis = np.where(lengths > 1e-9, reach / np.maximum(lengths, 1e-9), _FORWARD)
    lengths = np.clip(lengths, max(shortest, 1e-3), longest)
    along = (lengths**2 + UPPER_ARM**2 - FOREARM**2) / (2.0 * lengths)
    away = np.sqrt(np.maximum(UPPER_ARM**2 - along**2, 0.0))
    low = _DOWN - (axis @ _DOWN)[:, None] * axis
    # An elbow has no lowest position if the wrist is right above or below the shoulder; it is then behind.
    low = np.where(np.linalg.norm(low, axis=1, keepdims=True) > 1e-6, low, -_FORWARD)
    low /= np.linalg.norm(low, axis=1, keepdims=True)
    cosine = (UPPER_ARM**2 + FOREARM**2 - lengths[:, 0] ** 2) / (2.0 * UPPER_ARM * FOREARM)
    flexion = 180.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return (along * axis + away * low) / UPPER_ARM, flexion


def _score_upper_arm(upper: Array, outward: Array) -> npt.NDArray[np.int_]:
    """Return RULA's scores (n,) of upper arms with directions (n, 3): 1 to 4, and 1 more if abducted `outward` (3,)."""
    angle = np.degrees(np.arccos(np.clip(upper @ _DOWN, -1.0, 1.0)))
    is_forward = upper @ _FORWARD >= 0.0
    scores = np.where(is_forward, 1 + np.digitize(angle, _FLEXIONS, right=True), 1 + (angle > _EXTENSION))
    abduction = np.degrees(np.arcsin(np.clip(upper @ outward, -1.0, 1.0)))
    return np.asarray(scores + (abduction > _ABDUCTION))


def _score_forearm(flexion: Array, lateral: Array) -> npt.NDArray[np.int_]:
    """Return RULA's scores (n,) of forearms: 1 or 2, 1 more if the wrist is outside the shoulder or past the midline.

    Args:
        flexion: (n,) flexions of the elbow (deg).
        lateral: (n,) distances of the wrist from the shoulder, outward (m).
    """
    low, high = _FOREARM_RANGE
    is_bent = (flexion >= low) & (flexion <= high)
    is_beside = (lateral > 0.0) | (lateral < -HALF_SHOULDER_WIDTH)
    return np.asarray(np.where(is_bent, 1, 2) + is_beside)


@dataclass(frozen=True)
class FluencyMetrics:
    """Fluency, safety and effort of one episode.

    Attributes:
        handover_time: Time from the start of the episode to the release of the object (s); None if there is no release.
        human_idle: Share of the episode (0 to 1) in which the person does not move or is absent.
        robot_idle: Share of the episode (0 to 1) in which the robot does not move.
        concurrent: Share of the episode (0 to 1) in which person and robot both move.
        functional_delay: Time from the end of the person's last activity before the release to the start of the robot's
            last activity before the release, as share of the episode; negative if the robot starts earlier, None
            without a release or without such activities.
        max_robot_object_force: Largest sum of the normal forces between robot and object in one physics step (N).
        min_distance: Smallest distance between the surfaces of robot and human hand (m), sampled every 20 ms; 0
            after contact, None if there is no hand.
        giver_path: Length (m) of the path of the person's wrist, until the release or the end.
        giver_smoothness: Spectral arc length of the wrist's speed until the release or the end; at
            most 0, smoother if closer to 0; None if the wrist does not move.
        reach: Largest distance (m) of the wrist from its first position until the release or the
            end, a measure of how far a person has to reach.
        max_robot_hand_force: Largest sum of the normal forces between robot and human hand in one
            physics step of 1 ms (N); None if there is no contact. By the official rules a contact ends the
            episode, so the value is the force of the first step.
        robot_hand_impulse: Sum over all physics steps of the normal forces between robot and human
            hand, times 1 ms (N s); None if there is no contact.
        giver_jerk: Root mean square jerk of the person's wrist (m/s^3), until the release or the end;
            None if the hand is present for less than 240 ms.
        gripper_jerk: Root mean square jerk of the robot's hand link (m/s^3) in the whole episode; None
            in episodes shorter than 240 ms.
        gripper_path: Length (m) of the path of the robot's hand link.
        gripper_max_speed: Largest speed of the robot's hand link (m/s), averaged over 80 ms.
        gripper_mean_speed: Mean speed of the robot's hand link in the whole episode (m/s): path length
            divided by duration.
        exchange_time: Time from the robot's first contact with the object to the release (s); None
            without a release after such a contact.
        gripper_contact_speed: Speed of the robot's hand link at the first contact with the object (m/s),
            averaged over 80 ms; None if there is no contact.
        robot_object_impulse: Sum over all physics steps until the release or the end of the normal forces
            between robot and object, times 1 ms (N s); None if there is no contact until then.
        min_separation_margin: Smallest separation margin (m), sampled every 20 ms: the distance between the
            surfaces of robot and human hand minus the protective separation distance of ISO/TS 15066.
            Negative if the robot could touch the hand before it stops; None if there is no hand.
        giver_rula: Mean of RULA's scores of the giver's upper arm and forearm, 2 (best) to 8, until
            the release or the end, for an assumed shoulder; None if there is no hand.
    """

    # Metadata: unit in tables, and factor to this unit.
    handover_time: float | None = field(metadata={"unit": "s"})
    human_idle: float = field(metadata={"unit": "%", "scale": 100.0})
    robot_idle: float = field(metadata={"unit": "%", "scale": 100.0})
    concurrent: float = field(metadata={"unit": "%", "scale": 100.0})
    functional_delay: float | None = field(metadata={"unit": "%", "scale": 100.0})
    max_robot_object_force: float = field(metadata={"unit": "N"})
    min_distance: float | None = field(metadata={"unit": "cm", "scale": 100.0})
    giver_path: float = field(metadata={"unit": "m"})
    giver_smoothness: float | None = field(metadata={"unit": "SPARC"})
    reach: float = field(metadata={"unit": "m"})
    max_robot_hand_force: float | None = field(metadata={"unit": "N"})
    robot_hand_impulse: float | None = field(metadata={"unit": "N s"})
    giver_jerk: float | None = field(metadata={"unit": "m/s^3"})
    gripper_jerk: float | None = field(metadata={"unit": "m/s^3"})
    gripper_path: float | None = field(metadata={"unit": "m"})
    gripper_max_speed: float | None = field(metadata={"unit": "m/s"})
    gripper_mean_speed: float | None = field(metadata={"unit": "m/s"})
    exchange_time: float | None = field(metadata={"unit": "s"})
    gripper_contact_speed: float | None = field(metadata={"unit": "m/s"})
    robot_object_impulse: float | None = field(metadata={"unit": "N s"})
    min_separation_margin: float | None = field(metadata={"unit": "cm", "scale": 100.0})
    giver_rula: float | None


def compute_fluency(trace: EpisodeTrace) -> FluencyMetrics:
    """Compute fluency, safety and effort of an episode from its motion trace."""
    person = compute_speeds(trace.wrist, trace.period) > ACTIVE_SPEED
    gripper_speeds = compute_speeds(trace.gripper, trace.period)
    robot = gripper_speeds > ACTIVE_SPEED
    robot |= compute_speeds(trace.fingers, trace.period) > ACTIVE_FINGER_SPEED
    release_step = trace.release_step
    end = trace.steps if release_step is None else release_step
    path = trace.wrist[: trace.count_samples_until(end)]
    path = path[~np.isnan(path[:, 0])]
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    contact, exchange, contact_speed = trace.contact_step, None, None
    if contact is not None:
        # At the last sample up to the contact.
        contact_speed = float(gripper_speeds[trace.count_samples_until(contact) - 1])
        exchange = end - contact if contact <= end else None
    gripper_path = float(np.linalg.norm(np.diff(trace.gripper, axis=0), axis=1).sum())
    return FluencyMetrics(
        handover_time=trace.release_time,
        human_idle=float(1.0 - person.mean()),
        robot_idle=float(1.0 - robot.mean()),
        concurrent=float((person & robot).mean()),
        functional_delay=None if release_step is None else _compute_delay(person, robot, trace, release_step),
        max_robot_object_force=trace.max_object_force,
        min_distance=trace.min_distance,
        giver_path=float(lengths.sum()),
        giver_smoothness=compute_spectral_arc_length(lengths, 1.0 / trace.period),
        reach=float(np.linalg.norm(path - path[0], axis=1).max()) if len(path) else 0.0,
        max_robot_hand_force=trace.max_hand_force,
        robot_hand_impulse=trace.hand_impulse,
        giver_jerk=compute_rms_jerk(path, trace.period),
        gripper_jerk=compute_rms_jerk(trace.gripper, trace.period),
        gripper_path=gripper_path,
        gripper_max_speed=float(gripper_speeds.max()),
        gripper_mean_speed=gripper_path / trace.duration,
        exchange_time=None if release_step is None or exchange is None else exchange * TIME_STEP,
        gripper_contact_speed=contact_speed,
        robot_object_impulse=None if exchange is None else trace.object_impulse,
        min_separation_margin=trace.min_separation_margin,
        giver_rula=float(compute_rula_arm_scores(path, trace.side).mean()) if len(path) else None,
    )


def has_early_grab(trace: EpisodeTrace) -> bool | None:
    """Return whether the robot's fingers begin to close before the person's last movement ends.

    Only movements until the release count, or until the end of the episode without a release. Returns None if the
    fingers do not close or the hand does not move until then.
    """
    n = trace.count_samples_until(trace.steps if trace.release_step is None else trace.release_step)
    person = compute_speeds(trace.wrist, trace.period) > ACTIVE_SPEED
    opening = trace.fingers[:n].mean(axis=1)
    closing = np.flatnonzero(np.diff(opening) < -ACTIVE_FINGER_SPEED * trace.period)
    giving = find_activities(person[:n], trace.period)
    return bool(closing[0] < giving[-1][1]) if len(closing) and giving else None


def _compute_delay(person: Flags, robot: Flags, trace: EpisodeTrace, release_step: int) -> float | None:
    n = trace.count_samples_until(release_step)
    giving, taking = find_activities(person[:n], trace.period), find_activities(robot[:n], trace.period)
    if not giving or not taking:
        return None
    return float((taking[-1][0] - giving[-1][1]) * trace.period / trace.duration)
