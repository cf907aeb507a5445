"""Find the causes of failures of a receiver.

    python experiments/analysis/failures.py --data-dir DIR --split train --stride 10
    python experiments/analysis/failures.py --data-dir DIR --receiver vision:wait=3.0 --robot panda_camera

The script prints every failure with its cause, a table of causes, decision times and memory. The
cause of a contact names the robot link nearest to the hand and the phase of the receiver. A dropped
object was pushed out of the hand, slipped at the release, or was lost during the retreat. Causes of
a timeout of `reactive` or `vision` are: no clear grasp, no reachable grasp, a grasp that was not
reached, or no path to the goal. The phase of other receivers is derived from their finger targets.

In scenes with several objects, the script counts the episodes in which the robot touched an object
besides the target, or in which the held target touched another object or the table. A failed
episode counts as "lost" if such a contact occurred before its end, even if another event caused the
failure.
"""

import resource
from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl import givers, receivers
from handover_marl.cli.options import SceneNumbers
from handover_marl.config import ARM_DOF
from handover_marl.episode.callbacks import EpisodeCallback, PolicyDecision
from handover_marl.episode.camera_observations import WristCameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus, ReleaseReason
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import map_with_progress
from handover_marl.geometry.arm import ArmKinematics, transform_body_points
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import CLOSED, OPEN
from handover_marl.geometry.poses import invert_pose, transform_points
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.planning.hand_tracker import hand_capsules_from_observation
from handover_marl.planning.trajectory_cost import sample_body_points
from handover_marl.receivers import Receiver
from handover_marl.receivers.reactive.controller import ControllerReceiver, ReactivePhase

Array = npt.NDArray[np.float64]

#: An object lost within this many steps after the release slipped.
SOON = 60
POINTS = 40
FINGER, HALF_OPEN = ARM_DOF, (OPEN + CLOSED) / 2.0  # m


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the analysis of a receiver's failures.

    Attributes:
        split: Split of the setup: train or val.
        robot: Robot model: panda or panda_camera.
        camera_noise: Noise of the wrist camera: realsense; default: no noise.
        stride: Evaluate every n-th scene of the split.
        offset: Index of the first evaluated scene in the split.
        scenes: Scene numbers to evaluate instead of a split.
        giver: Name of the giver.
        all: Whether to print successful episodes too.
        receiver: Name of the receiver, with options.
    """

    split: str = "val"
    robot: str = "panda"
    camera_noise: str | None = None
    stride: int = 1
    offset: int = 0
    scenes: SceneNumbers = None
    giver: str = "replay"
    workers: int | None = 1
    all: bool = False
    receiver: str = "reactive"


class FailureRecorder(EpisodeCallback):
    """Callback that records the data from which causes of failures are derived.

    Attributes:
        times: Pair of wall-clock times (s) for each call of the receiver's policy: of the call, and
            of rendering the wrist camera before it.
        gripped: Last physics step with both fingers in contact with the object, or None if there
            was no such step.
        closing: Whether the last finger targets of the receiver close the gripper.
        touched_others: Whether the robot touched an object besides the target, or the held target
            touched another object or the table.
    """

    def __init__(self) -> None:
        self.times: list[tuple[float, float]] = []
        self.gripped: int | None = None
        self.closing = False
        self.touched_others = False

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        self.closing = bool(decision.receiver_action[FINGER] < HALF_OPEN)
        if decision.receiver_decided:
            self.times.append((decision.planning_time, decision.rendering_time))

    def on_step(self, episode: Episode) -> None:
        contacts = episode.contacts
        if contacts.both_fingers_touch:
            self.gripped = episode.steps
        is_held_target_touched = contacts.both_fingers_touch and contacts.object_supported
        self.touched_others |= contacts.robot_touches_others or is_held_target_touched


class FailureClassifier:
    """Classifier of the causes of failed episodes.

    Args:
        receiver: Receiver policy that acts in the episodes.
    """

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._arm = ArmKinematics(read_tree(receiver.context.panda_urdf))
        self._links = tuple(self._arm.link_names)
        self._body = sample_body_points(receiver.context.panda_urdf, self._links, POINTS)
        panda = receiver.context.panda
        self._base_from_world = invert_pose(np.array([*panda.base_position, *panda.base_orientation]))

    def classify(self, episode: Episode, recorder: FailureRecorder) -> str:
        """Return the cause of failure of a finished episode, as text for the table.

        Args:
            episode: Finished episode.
            recorder: Callback that recorded this episode.
        """
        status = episode.status
        if status & EpisodeStatus.HUMAN_CONTACT:
            return f"contact of {self._nearest_link(episode)} {self._describe_phase(recorder)}"
        if status & EpisodeStatus.OBJECT_DROP:
            return self._drop(episode, recorder.gripped)
        if status & EpisodeStatus.TIMEOUT:
            return f"timeout{self._timeout(recorder)}"
        return status.label

    def _describe_phase(self, recorder: FailureRecorder) -> str:
        if isinstance(self._receiver, ControllerReceiver):
            return f"while in {self._receiver.phase.value}"
        return "while closing" if recorder.closing else "with open fingers"

    def _drop(self, episode: Episode, gripped: int | None) -> str:
        if episode.release_reason is ReleaseReason.PASSIVE:
            return "drop: pushed out of the hand"
        if gripped is None or episode.release_step is None or gripped - episode.release_step < SOON:
            return "drop: slipped at the release"
        return "drop: lost during the retreat"

    def _timeout(self, recorder: FailureRecorder) -> str:
        if not isinstance(self._receiver, ControllerReceiver):
            return f" {self._describe_phase(recorder)}"
        if self._receiver.phase is ReactivePhase.RETREAT:
            return ": no path to the goal"
        if self._receiver.phase is ReactivePhase.WAIT:
            return ": no object was presented"
        return f": {self._receiver.selector.failure_reason or 'the grasp was not reached'}"

    def _nearest_link(self, episode: Episode) -> str:
        observation = episode.observe()
        hand = hand_capsules_from_observation(observation)
        if hand is None:
            return "?"
        joints = observation["robot_joint_position"][None, :ARM_DOF].astype(np.float64)
        points = transform_body_points(self._arm.compute_link_frames(joints), self._body)[..., 0].T
        world: Array = transform_points(invert_pose(self._base_from_world), points)
        return self._links[int(np.argmin(hand.compute_distances(world))) // POINTS]


@dataclass(frozen=True, eq=False)
class FinishedEpisode:
    """Outcome of an episode, and the cause of its failure.

    Attributes:
        scene: Scene number.
        target: YCB class name of the handed-over object.
        status: Outcome of the episode.
        steps: Number of physics steps until the end.
        cause: Cause of the failure; the name of the outcome for a success.
        times: (n, 2) wall-clock times of each decision and of rendering before it (s).
        memory: Peak memory of the process (MiB).
        touched_others: Whether the robot touched an object besides the target, or the held target
            touched another object or the table.
    """

    scene: int
    target: str
    status: EpisodeStatus
    steps: int
    cause: str
    times: Array
    memory: float
    touched_others: bool


class SceneRunner:
    """Simulator of episodes with the chosen policies, in one process."""

    def __init__(self, args: Args) -> None:
        self._data = args.open_dataset(args.robot)
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._giver = givers.make(args.giver, self._data, setup=args.setup)
        self._episode = Episode(args.physics, wrist_camera=WristCameraConfig(camera_noise=args.camera_noise))
        self._causes = FailureClassifier(self._receiver)

    def run(self, number: int) -> FinishedEpisode:
        """Simulate the scene of a given number and return its outcome with the cause."""
        scene, episode, recorder = self._data.load_scene(number), self._episode, FailureRecorder()
        episode.reset(scene)
        run_episode(episode, self._receiver, self._giver, seed=0, callbacks=[recorder])
        cause = self._causes.classify(episode, recorder)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        times = np.reshape(recorder.times, (-1, 2))
        target, touched = scene.info.target_name, recorder.touched_others
        return FinishedEpisode(number, target, episode.status, episode.steps, cause, times, memory, touched)


def main(args: Args) -> None:
    args = args.resolve_setup()
    data = args.open_dataset()
    scenes = args.scenes or data.list_scenes(args.setup, args.split)[args.offset :: args.stride]
    horizon = Episode(args.physics).config.protocol.horizon_steps
    finished = []
    for _, played in map_with_progress(
        lambda: SceneRunner(args).run, scenes, "simulating", PoolConfig(args.workers), True
    ):
        finished.append(played)
        if args.all or played.status is not EpisodeStatus.SUCCESS:
            touched = ", touched another object" if played.touched_others else ""
            print(f"{played.scene:4d} {played.target:24s} {played.steps:6d} {played.cause}{touched}", flush=True)
    count = len(scenes)
    share = sum(1.0 - played.steps / horizon for played in finished if played.status is EpisodeStatus.SUCCESS)
    times = np.concatenate([played.times for played in finished])
    print(
        f"{data.name}, {args.setup} {args.split}, {count} episodes, giver {args.giver}, receiver {args.receiver}, "
        f"{args.robot}, {args.physics} physics, camera {args.camera_noise or 'perfect'}"
    )
    causes = Counter(played.cause for played in finished).most_common()
    print(format_table(["cause", "episodes", "%"], [[name, n, f"{100 * n / count:.1f}"] for name, n in causes]))
    touching = [played for played in finished if played.touched_others]
    n_lost = sum(played.status is not EpisodeStatus.SUCCESS for played in touching)
    print(f"touched another object: {len(touching)} episodes, {n_lost} of them failed")
    print(f"AS {100 * share / count:.1f} %; decisions: {format_times(times[:, 0])}")
    if times[:, 1].any():
        memory = max(played.memory for played in finished)
        print(f"with rendering: {format_times(times.sum(axis=1))}; peak memory of a process {memory:.0f} MB")


def format_times(seconds: Array) -> str:
    """Return the median, 95th percentile and maximum (ms) of times (s) as text."""
    median, percentile, longest = 1000.0 * np.quantile(seconds, [0.5, 0.95, 1.0])
    return f"median {median:.1f}, 95 % {percentile:.1f}, max {longest:.0f} ms"


if __name__ == "__main__":
    main(tyro.cli(Args))
