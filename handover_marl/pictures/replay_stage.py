"""An episode as a page that plays it in three dimensions, by viser. Needs the extra `replay`."""

import contextlib
import importlib.util
import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, CameraConfig
from handover_marl.errors import OptionError
from handover_marl.models.panda import FINGER_LINKS, GRIPPER_OUTLINE, HAND_LINK
from handover_marl.models.poses import compose_point
from handover_marl.pictures.replay_bodies import MovingLink, moving_links, nearest_place, robot_links
from handover_marl.pictures.replay_recorder import EpisodeLog, Moment
from handover_marl.pictures.replay_words import words_of
from handover_marl.pictures.seen_colors import SEEN_COLORS
from handover_marl.sim.camera.photo import Seen

if TYPE_CHECKING:
    from viser import SceneApi

Array = npt.NDArray[np.float64]
Color = tuple[int, int, int]

_NEEDED = ("fast_simplification", "trimesh", "viser")
# Places (m) and shares of a quaternion are told in steps of these, which packs well and which nobody sees.
_PLACE_STEP, _TURN_STEP = 2.0**-13, 2.0**-12
_CONTACT, _HURT, _GOAL, _INTENTION = (255, 200, 0), (230, 30, 40), (60, 160, 90), (190, 60, 200)
_ROBOT_COLOR = (205, 208, 214)
_CONTACT_RADIUS, _HURT_RADIUS, _SEEN_RADIUS = 0.006, 0.025, 0.002  # m
_LABEL_ABOVE = 0.3  # m over the middle of the goal region
#: How long the end stays to be looked at before it all begins again (s).
END_STAYS = 1.5


def check_replay() -> None:
    """Check that what replays need is there.

    Raises:
        OptionError: It is not.
    """
    missing = [module for module in _NEEDED if importlib.util.find_spec(module) is None]
    if missing:
        raise OptionError(f"a replay (.html) needs {', '.join(missing)}: pip install 'handover-marl[replay]'")


def stage_page(log: EpisodeLog, camera: CameraConfig) -> str:
    """Viser's page with the episode in it; complete, to be opened without a network.

    Args:
        log: The episode.
        camera: Where to look from at first.

    Raises:
        OptionError: The extra `replay` is not installed.
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    check_replay()
    links = list(moving_links(log))
    with _server() as server:
        scene, first = server.scene, server.initial_camera
        scene.set_up_direction("+z")
        first.position, first.look_at, first.fov = camera.position, camera.target, np.radians(camera.vertical_fov)
        recording = server.get_scene_serializer()
        shown = [_Link(scene, link) for link in links]
        extras: list[_Shown] = [
            _Goal(scene, log),
            _Touches(scene, log),
            _Hurt(scene, links),
            _Intention(scene),
            _Cloud(scene, log),
            _Words(scene, log),
        ]
        for number, moment in enumerate(log.moments):
            for part in (*shown, *extras):
                part.show(number, moment)
            if moment is not log.moments[-1]:
                recording.insert_sleep((log.moments[number + 1].step - moment.step) * TIME_STEP)
        recording.insert_sleep(END_STAYS)
        page = str(recording.as_html())
    # Light or dark as the page around it.
    return page.replace("{darkMode:false}", "{darkMode:matchMedia('(prefers-color-scheme: dark)').matches}", 1)


def stage_key(log: EpisodeLog) -> list[tuple[str, str]]:
    """What the colours of an episode's stage mean: colours as HTML writes them, and words."""
    key = [(SEEN_COLORS[Seen.TARGET], "object"), (SEEN_COLORS[Seen.HAND], "person's hand")]
    if len(log.scene.assets.objects) > 1:
        key.append((SEEN_COLORS[Seen.OTHER_OBJECT], "other objects"))
    key += [(_html(_CONTACT), "fingers on object"), (_html(_GOAL), "goal region")]
    if any(moment.on_hand for moment in log.moments):
        key.append((_html(_HURT), "robot on hand, about there"))
    if any(moment.intended is not None for moment in log.moments):
        key.append((_html(_INTENTION), "what the robot means to do"))
    if log.clouds:
        key.append((SEEN_COLORS[Seen.TARGET], "dots: what the robot sees"))
    return key


@contextlib.contextmanager
def _server() -> Iterator[Any]:
    """Viser's server, which alone can make scenes; nobody else can reach it, and it ends with the block."""
    import viser

    # Also when told to be quiet it greets and takes leave.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class _Shown(Protocol):
    """Something on the stage."""

    def show(self, number: int, moment: Moment) -> None:
        """Be as at a moment, the so manieth."""


class _Link:
    """A link of a body."""

    def __init__(self, scene: "SceneApi", link: MovingLink) -> None:
        color = _ROBOT_COLOR if link.seen is Seen.ROBOT else _rgb(SEEN_COLORS[link.seen])
        self._poses = np.concatenate(
            [_rounded(link.poses[:, :3], _PLACE_STEP), _rounded(link.poses[:, 3:], _TURN_STEP)], axis=1
        )
        self._there = link.there
        self._handle = scene.add_mesh_simple(
            f"/{link.name}",
            link.mesh.vertices,
            link.mesh.faces,
            color=color,
            flat_shading=len(link.mesh.faces) < 300,
            side="double",
        )
        self._last: int | None = None

    def show(self, number: int, moment: Moment) -> None:
        number = min(number, len(self._poses) - 1)
        if number == self._last:
            return
        pose, before = self._poses[number], None if self._last is None else self._poses[self._last]
        if before is None or (pose[:3] != before[:3]).any():
            self._handle.position = pose[:3]
        if before is None or (pose[3:] != before[3:]).any():
            self._handle.wxyz = np.roll(pose[3:], 1)
        if self._last is None or self._there[number] != self._there[self._last]:
            self._handle.visible = bool(self._there[number])
        self._last = number


class _Goal:
    """The region to which the gripper must bring the object."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        rules = log.config.protocol
        scene.add_icosphere(
            "/goal", rules.goal_radius, _GOAL, opacity=0.15, position=rules.goal_center, cast_shadow=False
        )

    def show(self, number: int, moment: Moment) -> None:
        """Nothing: it stays."""


class _Touches:
    """Where the fingers touch the object."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        self._fingers = robot_links(log, [moment.joints for moment in log.moments], FINGER_LINKS)
        self._points = _Points(scene, "/contacts", _CONTACT, 2 * _CONTACT_RADIUS)

    def show(self, number: int, moment: Moment) -> None:
        """Balls at the points."""
        touched = zip(self._fingers[number], moment.finger_points, strict=True)
        self._points.show(np.concatenate([compose_point(finger, points) for finger, points in touched]))


class _Hurt:
    """Where the robot touches the person: the rules tell that it does, the models about where."""

    def __init__(self, scene: "SceneApi", links: Sequence[MovingLink]) -> None:
        self._links = links
        self._handle = scene.add_icosphere("/touch", _HURT_RADIUS, _HURT, opacity=0.6, visible=False)

    def show(self, number: int, moment: Moment) -> None:
        """A ball there."""
        place = nearest_place(self._links, Seen.ROBOT, Seen.HAND, number) if moment.on_hand else None
        if place is not None:
            self._handle.position = place
        if self._handle.visible != (place is not None):
            self._handle.visible = place is not None


class _Intention:
    """The way that the receiver means to bring the gripper, and the gripper at its end."""

    def __init__(self, scene: "SceneApi") -> None:
        nothing = np.zeros((1, 2, 3), dtype=np.float32)
        self._handle = scene.add_line_segments(
            "/intention", nothing, _INTENTION, thickness=3.0, thickness_units="screen", visible=False
        )
        self._last: Array | None = None

    def show(self, number: int, moment: Moment) -> None:
        """Lines, where they have changed."""
        meant, last = moment.intended, self._last
        if meant is not None and (last is None or not np.array_equal(last, meant)):
            fork = compose_point(meant[-1], np.array(GRIPPER_OUTLINE))
            lines = np.concatenate([_segments(meant[:, :3]), _segments(fork)])
            self._handle.points = _rounded(lines, _PLACE_STEP).astype(np.float32)
        if (meant is None) != (last is None):
            self._handle.visible = meant is not None
        self._last = meant


class _Cloud:
    """What the receiver was shown last of object and hand."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        self._looks: list[tuple[int, Array, Array]] = []
        if log.clouds:
            hands = robot_links(log, [cloud.joints for cloud in log.clouds], (HAND_LINK,))[:, 0]
            self._looks = [
                (cloud.step, compose_point(hand, cloud.object_points), compose_point(hand, cloud.hand_points))
                for cloud, hand in zip(log.clouds, hands, strict=True)
            ]
        self._points = [
            _Points(scene, f"/seen/{seen.name.lower()}", _rgb(SEEN_COLORS[seen]), 2 * _SEEN_RADIUS)
            for seen in (Seen.TARGET, Seen.HAND)
        ]
        self._next = 0

    def show(self, number: int, moment: Moment) -> None:
        """The points of the last look, if there was one since the moment before."""
        before = self._next
        while self._next < len(self._looks) and self._looks[self._next][0] <= moment.step:
            self._next += 1
        if self._next > before:
            _, *clouds = self._looks[self._next - 1]
            for shown, points in zip(self._points, clouds, strict=True):
                shown.show(points)


class _Points:
    """A cloud of points, which is there from the start but may show nothing."""

    def __init__(self, scene: "SceneApi", name: str, color: Color, size: float) -> None:
        nothing = np.zeros((1, 3), dtype=np.float16)
        self._handle = scene.add_point_cloud(
            name, nothing, color, point_size=size, point_shape="circle", point_shading="flat", visible=False
        )

    def show(self, points: Array) -> None:
        """Show (n, 3) points (m) from now on."""
        if len(points):
            self._handle.points = points.astype(np.float16)
        if self._handle.visible != bool(len(points)):
            self._handle.visible = bool(len(points))


class _Words:
    """Time and state, over the goal region."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        x, y, z = log.config.protocol.goal_center
        self._log = log
        self._handle = scene.add_label("/words", "", position=(x, y, z + _LABEL_ABOVE), anchor="bottom-center")

    def show(self, number: int, moment: Moment) -> None:
        """The words of the moment."""
        self._handle.text = words_of(self._log, moment)


def _segments(points: Array) -> Array:
    """(n - 1, 2, 3) lines from each point (n, 3) to the next."""
    return np.stack([points[:-1], points[1:]], axis=1)


def _rounded(values: Array, step: float) -> Array:
    found: Array = np.round(values / step) * step
    return found


def _html(color: Color) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def _rgb(html: str) -> Color:
    return int(html[1:3], 16), int(html[3:5], 16), int(html[5:7], 16)
