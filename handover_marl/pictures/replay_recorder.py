"""What is noted of an episode while it is played, so that it can be looked at again from all sides."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.config import WorldConfig
from handover_marl.datasets.scene import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.sight import CLOUDS, IMAGES
from handover_marl.episode.watchers import Decision, Watcher
from handover_marl.policies.policy import Policy
from handover_marl.protocol.contacts import Points
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.sim.world import Snapshot

Array = npt.NDArray[np.float64]

#: Physics steps between two moments (40 ms).
MOMENT_STEPS = 40
# Points of a cloud that are kept; more cannot be told apart.
_MOST_POINTS = 300


@dataclass(frozen=True, eq=False)
class Moment:
    """How things stand after a step.

    Attributes:
        step: Physics steps since the start.
        joints: Of everything.
        finger_points: Where the left and the right finger touch the object, (n, 3) each in the finger's frame (m).
        on_object: Whether the robot has touched the object since the moment before.
        on_hand: Whether it has touched the person.
        held_out: Whether the person holds the object.
        released: Whether the person has let go.
        intended: (k, 7) world poses through which the robot means to bring its hand link, or None.
    """

    step: int
    joints: Snapshot
    finger_points: tuple[Points, Points]
    on_object: bool
    on_hand: bool
    held_out: bool
    released: bool
    intended: Array | None


@dataclass(frozen=True, eq=False)
class SeenCloud:
    """What a receiver that sees points was shown.

    Attributes:
        step: When.
        joints: Of everything at that time.
        object_points: (n, 3) of the object in the frame of the Panda's hand link (m).
        hand_points: (m, 3) of the person's hand, likewise.
    """

    step: int
    joints: Snapshot
    object_points: Points
    hand_points: Points


@dataclass(frozen=True, eq=False)
class EpisodeLog:
    """An episode that was played.

    Attributes:
        scene: Its scene.
        config: Its world and rules.
        moments: From the start to the end; the last one may come sooner after the one before it than the others.
        clouds: What the receiver was shown; empty if it does not look.
        status: How it ended.
        release: Why the person let go, or None.
        release_step: When, or None.
    """

    scene: Scene
    config: WorldConfig
    moments: tuple[Moment, ...]
    clouds: tuple[SeenCloud, ...]
    status: EpisodeStatus
    release: Release | None
    release_step: int | None


class ReplayRecorder(Watcher):
    """Makes the log of every episode that it watches.

    Args:
        receiver: Whose intentions and clouds to note, or None.

    Attributes:
        log: Of the last episode, once it has ended.
    """

    log: EpisodeLog

    def __init__(self, receiver: Policy | None = None) -> None:
        self._receiver = receiver

    def started(self, episode: Episode) -> None:
        """Forget the last episode."""
        self._moments: list[Moment] = []
        self._clouds: list[SeenCloud] = []
        self._on_object = self._on_hand = False
        self._note(episode)

    def decided(self, episode: Episode, decision: Decision) -> None:
        """Note what the receiver was shown."""
        sight = None if self._receiver is None else self._receiver.sight
        if sight is not None and decision.robot_asked:
            points = (_thinned(cloud) for cloud in _shown(episode, sight))
            self._clouds.append(SeenCloud(episode.steps, episode.world.snapshot(), *points))

    def stepped(self, episode: Episode) -> None:
        """Note contacts, and now and then how everything stands."""
        self._on_object |= episode.contacts.robot_object
        self._on_hand |= episode.contacts.robot_hand
        if episode.steps % MOMENT_STEPS == 0:
            self._note(episode)

    def ended(self, episode: Episode) -> None:
        """Make the log."""
        if self._moments[-1].step < episode.steps:
            self._note(episode)
        self.log = EpisodeLog(
            episode.scene,
            episode.config,
            tuple(self._moments),
            tuple(self._clouds),
            episode.status,
            episode.release,
            episode.release_step,
        )

    def _note(self, episode: Episode) -> None:
        self._moments.append(
            Moment(
                step=episode.steps,
                joints=episode.world.snapshot(),
                finger_points=episode.contacts.finger_points,
                on_object=self._on_object,
                on_hand=self._on_hand,
                held_out=episode.held_out,
                released=episode.release is not None,
                intended=None if self._receiver is None else self._receiver.intention,
            )
        )
        self._on_object = self._on_hand = False


def _shown(episode: Episode, sight: str) -> tuple[Points, Points]:
    """The points of object and hand that a kind of sight shows now; they are not drawn again."""
    if sight == IMAGES:
        view = episode.look()
        return view.object_points, view.hand_points
    seen = episode.observe_sight(sight)
    kind = "cloud" if sight == CLOUDS else "points"
    counts = seen["wrist_point_counts"].astype(int)
    item, hand = (seen[f"wrist_{of}_{kind}"][:count] for of, count in zip(("object", "hand"), counts, strict=True))
    return item, hand


def _thinned(cloud: Points) -> Points:
    """(n, 3) of a cloud, every so manieth point."""
    return np.array(cloud[:: len(cloud) // _MOST_POINTS + 1])
