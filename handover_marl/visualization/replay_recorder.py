"""Recording of an episode's states and contacts for a 3D replay, and its description in words."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback, PolicyDecision
from handover_marl.episode.referee import EpisodeStatus, ReleaseReason
from handover_marl.episode.spaces import POINTCLOUD, SCENE_POINTCLOUD, STATE, has_camera, parse_obs_mode
from handover_marl.policies.policy import Policy
from handover_marl.simulation.camera.images import JointSnapshot
from handover_marl.simulation.world import Points

#: Physics steps between two frames of a replay (40 ms).
FRAME_STEPS = 40
# Largest number of points of a stored cloud; more make the page large without a visible difference.
_MAX_POINTS = 300
_RELEASE_PHRASES = {
    ReleaseReason.ACTIVE: "the person lets go because the fingers hold the object",
    ReleaseReason.PASSIVE: "the person lets go because the robot pushes the object",
    ReleaseReason.VOLUNTARY: "the person lets go voluntarily",
}


@dataclass(frozen=True, eq=False)
class ReplayFrame:
    """State of an episode after a physics step.

    Attributes:
        step: Number of physics steps since the start.
        snapshot: Joint positions of the robot, the objects and the person's hand.
        finger_points: Contact points (n, 3) of left and right finger with the object, in the finger's frame (m).
        touches_object: Whether the robot has touched the object since the previous frame.
        touches_hand: Whether the robot has touched the person since the previous frame.
        object_offered: Whether the person has picked up the object and not released it.
        released: Whether the person has released the object.
        planned_path: (k, 7) planned world poses of the hand link, xyz (m) and quaternion xyzw; None without a plan.
    """

    step: int
    snapshot: JointSnapshot
    finger_points: tuple[Points, Points]
    touches_object: bool
    touches_hand: bool
    object_offered: bool
    released: bool
    planned_path: npt.NDArray[np.float64] | None


class ReplayRecorder(EpisodeCallback):
    """Recorder of an episode's states and contacts for a replay.

    Args:
        receiver: Receiver whose plans and point clouds are recorded, or None.

    Attributes:
        scene: Scene of the last episode.
        config: World and rules of the episode.
        frames: States every `FRAME_STEPS` steps, and at the end.
        clouds: Point clouds that the receiver observed, as tuples: physics step, joint positions, points (n, 3) of the
            object and (m, 3) of the person's hand (m), both in the frame of the Panda's hand link.
        status: Outcome of the episode; set at the end, like the release.
        release: Reason why the person released the object, or None.
        release_step: Physics step of the release, or None.
    """

    scene: Scene
    config: WorldConfig
    status: EpisodeStatus
    release: ReleaseReason | None
    release_step: int | None

    def __init__(self, receiver: Policy | None = None) -> None:
        self._receiver = receiver
        self.frames: list[ReplayFrame] = []
        self.clouds: list[tuple[int, JointSnapshot, Points, Points]] = []
        self._touches_object = self._touches_hand = False

    def on_reset(self, episode: Episode) -> None:
        """Discard the recording of the previous episode and record the initial state."""
        self.scene, self.config, self.frames, self.clouds = episode.scene, episode.config, [], []
        self._touches_object = self._touches_hand = False
        self._record_frame(episode)

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        """Record point clouds whenever a new action of a receiver that observes the wrist camera takes effect."""
        obs_mode = STATE if self._receiver is None else self._receiver.obs_mode
        if has_camera(obs_mode) and decision.receiver_action_changed and episode.has_wrist_camera:
            clouds = _observed_clouds(episode, obs_mode)
            object_points, hand_points = (np.array(cloud[:: len(cloud) // _MAX_POINTS + 1]) for cloud in clouds)
            self.clouds.append((episode.steps, episode.world.read_joint_snapshot(), object_points, hand_points))

    def on_step(self, episode: Episode) -> None:
        """Collect contacts, and record a frame every `FRAME_STEPS` steps."""
        self._touches_object |= episode.contacts.robot_touches_object
        self._touches_hand |= episode.contacts.robot_touches_hand
        if episode.steps % FRAME_STEPS == 0:
            self._record_frame(episode)

    def on_end(self, episode: Episode) -> None:
        """Record the final state and the outcome."""
        if self.frames[-1].step < episode.steps:
            self._record_frame(episode)
        self.status, self.release, self.release_step = episode.status, episode.release_reason, episode.release_step

    def _record_frame(self, episode: Episode) -> None:
        self.frames.append(
            ReplayFrame(
                step=episode.steps,
                snapshot=episode.world.read_joint_snapshot(),
                finger_points=episode.contacts.finger_points,
                touches_object=self._touches_object,
                touches_hand=self._touches_hand,
                object_offered=episode.object_offered,
                released=episode.release_reason is not None,
                planned_path=None if self._receiver is None else self._receiver.planned_goal,
            )
        )
        self._touches_object = self._touches_hand = False


def describe_frame(log: ReplayRecorder, frame: ReplayFrame) -> str:
    """Return time and state of a recorded episode at a frame, as text such as "3.20 s - released - robot on object"."""
    parts = [f"{frame.step * TIME_STEP:.2f} s"]
    if frame.step == log.frames[-1].step and log.status:
        parts.append(log.status.label)
    elif frame.released:
        parts.append("released")
    else:
        parts.append("held out" if frame.object_offered else "lies")
    if frame.touches_hand:
        parts.append("robot on hand")
    if all(len(points) for points in frame.finger_points):
        parts.append("both fingers on object")
    elif frame.touches_object:
        parts.append("robot on object")
    return " - ".join(parts)


def list_events(log: ReplayRecorder) -> list[tuple[float, str]]:
    """Return pairs (time in s, description) of an episode's events, such as pick-up, contacts and release, in order.

    The times of the release and of the end are exact. Other events have the time of the next recorded frame.
    """
    flags = {
        "the person has picked the object up": [frame.object_offered for frame in log.frames],
        "the robot touches the object": [frame.touches_object for frame in log.frames],
        "both fingers are on the object": [all(map(len, frame.finger_points)) for frame in log.frames],
    }
    events = [
        (log.frames[occurred.index(True)].step, description) for description, occurred in flags.items() if any(occurred)
    ]
    if log.release is not None and log.release_step is not None:
        events.append((log.release_step, _RELEASE_PHRASES[log.release]))
    events.append((log.frames[-1].step, log.status.label if log.status else "the recording ends"))
    return [(step * TIME_STEP, description) for step, description in sorted(events, key=lambda event: event[0])]


def _observed_clouds(episode: Episode, obs_mode: str) -> tuple[Points, Points]:
    """Return the observed points (n, 3) of object and person's hand, in the frame of the robot's hand link (m)."""
    if not parse_obs_mode(obs_mode) & {POINTCLOUD, SCENE_POINTCLOUD}:
        view = episode.capture_wrist_camera()
        return view.object_points, view.hand_points
    observation = episode.observe_camera(obs_mode)
    counts = observation["wrist_point_counts"].astype(int)
    object_count, hand_count = counts[:2]
    return observation["wrist_object_points"][:object_count], observation["wrist_hand_points"][:hand_count]
