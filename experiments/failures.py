"""Why receivers fail where they do.

    python experiments/failures.py --data-dir DIR --split train --stride 10
    python experiments/failures.py --data-dir DIR --receiver vision:wait=3.0 --robot panda_camera

Plays scenes and prints every failure with its cause, a table of causes, how long decisions took, and memory. Of a
contact it tells which part of the robot was nearest to the hand and what the receiver was doing; of a drop whether the
object was pushed out of the hand, slipped as the person let go, or was lost on the way; of a timeout, for `reactive`
and `vision`, whether there was no grasp with room, none within reach, one that was never reached, or no way to the
goal. What other receivers were doing is told by their fingers.
"""

import resource
from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl import givers, receivers
from handover_marl.benchmarking.tables import table
from handover_marl.config import ARM_JOINTS
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.sight import SightConfig
from handover_marl.episode.watchers import Decision, Watcher
from handover_marl.models.arm import Arm, body_points
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import CLOSED, OPEN
from handover_marl.models.poses import compose_point, inverse
from handover_marl.planning.body_samples import body_samples
from handover_marl.planning.capsules import hand_capsules
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.receivers import Receiver
from handover_marl.receivers.reactive.reactive_receiver import Phase, ReactiveReceiver

#: A grip lost this soon after the person let go has slipped then (steps).
SOON = 60
POINTS = 40
FINGER, HALF_OPEN = ARM_JOINTS, (OPEN + CLOSED) / 2.0  # m


@dataclass(frozen=True)
class Args:
    """What to play.

    Attributes:
        setup: Official setup, s0 to s3.
        split: train or val.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        robot: panda or panda_camera.
        physics: fast, exact or mujoco.
        imperfections: What is wrong with the camera: nothing, or as with a realsense.
        stride: Take every n-th scene,
        offset: from this one on.
        scenes: Instead of a split: these scenes.
        giver: Who hands over.
        workers: Processes.
        all: Print all episodes, not failures only.
        receiver: Name of the receiver, with options.
    """

    setup: str = "s0"
    split: str = "val"
    data_dir: str | None = None
    dataset: str = "auto"
    robot: str = "panda"
    physics: str = "fast"
    imperfections: str | None = None
    stride: int = 1
    offset: int = 0
    scenes: tuple[int, ...] = ()
    giver: str = "replay"
    workers: int = 1
    all: bool = False
    receiver: str = "reactive"


class Notes(Watcher):
    """What the causes are told from.

    Attributes:
        seconds: Wall-clock time of every decision of every episode (s); beside it
        drawing: that of drawing what it is shown.
        gripped: The last step with both fingers on the object, or None.
        closing: Whether the fingers were told to close.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.drawing: list[float] = []
        self.gripped: int | None = None
        self.closing = False

    def decided(self, episode: Episode, decision: Decision) -> None:
        self.closing = bool(decision.robot[FINGER] < HALF_OPEN)
        if decision.robot_asked:
            self.seconds.append(decision.seconds)
            self.drawing.append(decision.drawing)

    def stepped(self, episode: Episode) -> None:
        if episode.grasped:
            self.gripped = episode.steps


class Causes:
    """Tells causes.

    Args:
        receiver: Who played.
    """

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._arm = Arm(read_tree(receiver.context.panda_urdf))
        self._links = tuple(self._arm.link_names)
        self._body = body_samples(receiver.context.panda_urdf, self._links, POINTS)
        panda = receiver.context.panda
        self._base_from_world = inverse(np.array([*panda.base_position, *panda.base_orientation]))

    def of(self, episode: Episode, notes: Notes) -> str:
        """The cause of an episode's end, in words."""
        status = episode.status
        if status & EpisodeStatus.HUMAN_CONTACT:
            return f"contact of {self._nearest_link(episode)} {self._doing(notes)}"
        if status & EpisodeStatus.OBJECT_DROP:
            return self._drop(episode, notes.gripped)
        if status & EpisodeStatus.TIMEOUT:
            return f"timeout{self._timeout(notes)}"
        return status.label

    def _doing(self, notes: Notes) -> str:
        if isinstance(self._receiver, ReactiveReceiver):
            return f"while in {self._receiver.phase.value}"
        return "once it was closing" if notes.closing else "with open fingers"

    def _drop(self, episode: Episode, gripped: int | None) -> str:
        if episode.release is Release.PASSIVE:
            return "drop: pushed out of the hand"
        if gripped is None or episode.release_step is None or gripped - episode.release_step < SOON:
            return "drop: slipped as the person let go"
        return "drop: lost on the way"

    def _timeout(self, notes: Notes) -> str:
        if not isinstance(self._receiver, ReactiveReceiver):
            return f" {self._doing(notes)}"
        if self._receiver.phase is Phase.RETREAT:
            return ": no way to the goal"
        if self._receiver.phase is Phase.WAIT:
            return ": nothing was offered"
        return f": {self._receiver.choice.trouble or 'the grasp was never reached'}"

    def _nearest_link(self, episode: Episode) -> str:
        observation = episode.observe()
        hand = hand_capsules(observation)
        if hand is None:
            return "?"
        joints = observation["robot_joint_position"][None, :ARM_JOINTS].astype(np.float64)
        points = body_points(self._arm.frames(joints), self._body)[..., 0].T
        world: npt.NDArray[np.float64] = compose_point(inverse(self._base_from_world), points)
        return self._links[int(np.argmin(hand.distances(world))) // POINTS]


@dataclass(frozen=True)
class Played:
    """An episode: its scene, the object's name, its end, its length in steps, the cause, its decisions' times.

    And how much memory the process had taken by then at most (MB).
    """

    scene: int
    target: str
    status: EpisodeStatus
    steps: int
    cause: str
    seconds: tuple[float, ...]
    drawing: tuple[float, ...]
    memory: float


class Player:
    """Plays scenes in one process."""

    def __init__(self, args: Args) -> None:
        self._data = open_dataset(args.dataset, args.data_dir, args.robot)
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._giver = givers.make(args.giver, self._data, setup=args.setup)
        self._episode = Episode(args.physics, sight=SightConfig(imperfections=args.imperfections))
        self._causes = Causes(self._receiver)

    def play(self, number: int) -> Played:
        """One scene."""
        scene, episode, notes = self._data.scene(number), self._episode, Notes()
        episode.reset(scene)
        play(episode, self._receiver, self._giver, seed=0, watchers=[notes])
        cause = self._causes.of(episode, notes)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        times = tuple(notes.seconds), tuple(notes.drawing)
        return Played(number, scene.info.target_name, episode.status, episode.steps, cause, *times, memory)


def main(args: Args) -> None:
    data = open_dataset(args.dataset, args.data_dir)
    scenes = args.scenes or data.split(args.setup, args.split)[args.offset :: args.stride]
    horizon = Episode(args.physics).config.protocol.horizon_steps
    found: Counter[str] = Counter()
    seconds: list[float] = []
    drawing: list[float] = []
    share = memory = 0.0
    for _, played in worked_on(lambda: Player(args).play, scenes, "playing", PoolConfig(args.workers), True):
        found[played.cause] += 1
        seconds += played.seconds
        drawing += played.drawing
        memory = max(memory, played.memory)
        if played.status is EpisodeStatus.SUCCESS:
            share += 1.0 - played.steps / horizon
        if args.all or played.status is not EpisodeStatus.SUCCESS:
            print(f"{played.scene:4d} {played.target:24s} {played.steps:6d} {played.cause}", flush=True)
    count = len(scenes)
    print(
        f"{data.name}, {args.setup} {args.split}, {count} episodes, giver {args.giver}, receiver {args.receiver}, "
        f"{args.robot}, {args.physics} physics, camera {args.imperfections or 'perfect'}"
    )
    print(
        table(["cause", "episodes", "%"], [[name, str(n), f"{100 * n / count:.1f}"] for name, n in found.most_common()])
    )
    print(f"AS {100 * share / count:.1f} %; decisions: {spread(seconds)}")
    if any(drawing):
        print(
            f"with what is drawn for them: {spread(np.add(seconds, drawing))}; a process takes {memory:.0f} MB at most"
        )


def spread(seconds: npt.ArrayLike) -> str:
    """Times in words."""
    low, middle, high = 1000.0 * np.quantile(seconds, [0.5, 0.95, 1.0])
    return f"median {low:.1f}, 95 % {middle:.1f}, most {high:.0f} ms"


if __name__ == "__main__":
    main(tyro.cli(Args))
