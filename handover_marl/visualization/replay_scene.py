"""Animated 3D scene of an episode in the viewer viser; needs the extra `replay`."""

import contextlib
import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, CameraConfig
from handover_marl.execution.options import require_modules
from handover_marl.geometry.panda import FINGER_LINKS, GRIPPER_OUTLINE, HAND_LINK
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.visualization.colors import LABEL_COLORS
from handover_marl.visualization.replay_bodies import (
    LinkTrajectory,
    compute_link_trajectories,
    compute_robot_link_poses,
    find_nearest_point,
)
from handover_marl.visualization.replay_recorder import EpisodeLog, ReplayFrame
from handover_marl.visualization.replay_text import describe_frame

if TYPE_CHECKING:
    from viser import SceneApi

Array = npt.NDArray[np.float64]
Color = tuple[int, int, int]

_REQUIRED_MODULES = ("fast_simplification", "trimesh", "viser")
# Resolution of stored positions (m) and quaternions: invisible, but the page compresses better.
_POSITION_STEP, _ROTATION_STEP = 2.0**-13, 2.0**-12
_ROBOT_COLOR, _GOAL_COLOR, _PLAN_COLOR = (205, 208, 214), (60, 160, 90), (190, 60, 200)
_GROUND_COLOR = (120, 120, 130)  # of the light from below
_FINGER_CONTACT_COLOR, _HAND_CONTACT_COLOR = (255, 200, 0), (230, 30, 40)
_FINGER_CONTACT_RADIUS, _HAND_CONTACT_RADIUS, _CLOUD_POINT_RADIUS = 0.006, 0.025, 0.002  # m
_LABEL_HEIGHT = 0.3  # m above the center of the goal region
_FLAT_SHADING_FACES = 300  # meshes with fewer triangles look better with flat shading
# Viser hides the scene until its map of the surroundings, from which light comes, has been decoded.
_SHOW_AT_ONCE = "<style>canvas{opacity:1!important;animation:appear .3s}@keyframes appear{from{opacity:0}}</style>"
#: Duration for which the end is shown before the animation starts again (s).
END_PAUSE_S = 1.5


def require_replay_extra() -> None:
    """Check that the packages for replays are installed.

    Raises:
        OptionError: A package is missing.
    """
    require_modules("a replay (.html)", "replay", *_REQUIRED_MODULES)


def build_viser_page(log: EpisodeLog, camera: CameraConfig) -> str:
    """Return viser's HTML page with the animated episode, which needs no network.

    Args:
        log: Recorded episode.
        camera: Initial camera.

    Raises:
        OptionError: The extra `replay` is not installed.
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    require_replay_extra()
    links = list(compute_link_trajectories(log))
    with _run_server() as server:
        scene, view = server.scene, server.initial_camera
        scene.set_up_direction("+z")
        scene.add_light_hemisphere("/sky", ground_color=_GROUND_COLOR, intensity=1.2)
        view.position, view.look_at = camera.position, camera.target
        view.fov = np.radians(camera.vertical_fov)
        serializer = server.get_scene_serializer()
        rules = log.config.protocol
        scene.add_icosphere(
            "/goal", rules.goal_radius, _GOAL_COLOR, opacity=0.15, position=rules.goal_center, cast_shadow=False
        )
        elements: list[_SceneElement] = [
            *(_AnimatedLink(scene, link) for link in links),
            _FingerContacts(scene, log),
            _HandContactMarker(scene, links),
            _PlannedPath(scene),
            _ObservedCloud(scene, log),
            _StatusLabel(scene, log),
        ]
        for index, frame in enumerate(log.frames):
            for element in elements:
                element.show(index, frame)
            if frame is not log.frames[-1]:
                serializer.insert_sleep((log.frames[index + 1].step - frame.step) * TIME_STEP)
        serializer.insert_sleep(END_PAUSE_S)
        page = str(serializer.as_html())
    # Dark mode follows the browser's setting, as on the page around it.
    dark_mode = "{darkMode:matchMedia('(prefers-color-scheme: dark)').matches}"
    return page.replace("{darkMode:false}", dark_mode, 1).replace("</head>", f"{_SHOW_AT_ONCE}</head>", 1)


def build_color_legend(log: EpisodeLog) -> list[tuple[str, str]]:
    """Return the HTML colors in an episode's 3D scene, with their meanings."""
    legend = [
        (LABEL_COLORS[SegmentationLabel.TARGET], "object"),
        (LABEL_COLORS[SegmentationLabel.HAND], "person's hand"),
    ]
    if len(log.scene.assets.objects) > 1:
        legend.append((LABEL_COLORS[SegmentationLabel.OTHER_OBJECT], "other objects"))
    legend.append((_html_from_rgb(_FINGER_CONTACT_COLOR), "contacts of fingers and object"))
    legend.append((_html_from_rgb(_GOAL_COLOR), "goal region"))
    if any(frame.touches_hand for frame in log.frames):
        legend.append((_html_from_rgb(_HAND_CONTACT_COLOR), "contact of robot and hand (approximate)"))
    if any(frame.planned_path is not None for frame in log.frames):
        legend.append((_html_from_rgb(_PLAN_COLOR), "planned path of the gripper"))
    if log.clouds:
        legend.append((LABEL_COLORS[SegmentationLabel.TARGET], "dots: observed point cloud"))
    return legend


@contextlib.contextmanager
def _run_server() -> Iterator[Any]:
    """Run viser's server, which is needed to build scenes; only this machine can reach it."""
    import viser

    # Viser prints messages at start and end even with verbose=False.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class _SceneElement(Protocol):
    """Element of the 3D scene whose changes over the frames viser records."""

    def show(self, index: int, frame: ReplayFrame) -> None:
        """Update the element to its state at a frame."""


class _AnimatedLink:
    """Mesh of a link that moves."""

    def __init__(self, scene: "SceneApi", link: LinkTrajectory) -> None:
        is_robot = link.label is SegmentationLabel.ROBOT
        positions, rotations = link.poses[:, :3], link.poses[:, 3:]
        self._poses = np.concatenate(
            [_quantize(positions, _POSITION_STEP), _quantize(rotations, _ROTATION_STEP)], axis=1
        )
        self._is_present = link.is_present
        self._handle = scene.add_mesh_simple(
            f"/{link.name}",
            link.mesh.vertices,
            link.mesh.faces,
            color=_ROBOT_COLOR if is_robot else _rgb_from_html(LABEL_COLORS[link.label]),
            flat_shading=len(link.mesh.faces) < _FLAT_SHADING_FACES,
            side="double",
        )
        self._shown: int | None = None

    def show(self, index: int, frame: ReplayFrame) -> None:
        index = min(index, len(self._poses) - 1)
        if index == self._shown:
            return
        pose, before = self._poses[index], None if self._shown is None else self._poses[self._shown]
        if before is None or (pose[:3] != before[:3]).any():
            self._handle.position = pose[:3]
        if before is None or (pose[3:] != before[3:]).any():
            self._handle.wxyz = np.roll(pose[3:], 1)
        if self._shown is None or self._is_present[index] != self._is_present[self._shown]:
            self._handle.visible = bool(self._is_present[index])
        self._shown = index


class _FingerContacts:
    """Contact points of fingers and object."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        snapshots = [frame.snapshot for frame in log.frames]
        self._fingers = compute_robot_link_poses(log, snapshots, FINGER_LINKS)
        self._cloud = _PointCloud(scene, "/contacts", _FINGER_CONTACT_COLOR, 2 * _FINGER_CONTACT_RADIUS)

    def show(self, index: int, frame: ReplayFrame) -> None:
        fingers = zip(self._fingers[index], frame.finger_points, strict=True)
        self._cloud.show(np.concatenate([transform_points(finger, points) for finger, points in fingers]))


class _HandContactMarker:
    """Sphere at the contact of robot and person; its position is approximated by the meshes."""

    def __init__(self, scene: "SceneApi", links: Sequence[LinkTrajectory]) -> None:
        self._links = links
        self._handle = scene.add_icosphere(
            "/touch", _HAND_CONTACT_RADIUS, _HAND_CONTACT_COLOR, opacity=0.6, visible=False
        )

    def show(self, index: int, frame: ReplayFrame) -> None:
        point = None
        if frame.touches_hand:
            point = find_nearest_point(self._links, SegmentationLabel.ROBOT, SegmentationLabel.HAND, index)
        if point is not None:
            self._handle.position = point
        if self._handle.visible != (point is not None):
            self._handle.visible = point is not None


class _PlannedPath:
    """Planned path of the hand link, with the gripper's outline at its end."""

    def __init__(self, scene: "SceneApi") -> None:
        empty = np.zeros((1, 2, 3), dtype=np.float32)
        self._handle = scene.add_line_segments(
            "/planned_path", empty, _PLAN_COLOR, thickness=3.0, thickness_units="screen", visible=False
        )
        self._shown: Array | None = None

    def show(self, index: int, frame: ReplayFrame) -> None:
        path, shown = frame.planned_path, self._shown
        if path is not None and (shown is None or not np.array_equal(shown, path)):
            outline = transform_points(path[-1], np.array(GRIPPER_OUTLINE))
            lines = np.concatenate([_segments(path[:, :3]), _segments(outline)])
            self._handle.points = _quantize(lines, _POSITION_STEP).astype(np.float32)
        if (path is None) != (shown is None):
            self._handle.visible = path is not None
        self._shown = path


class _ObservedCloud:
    """Latest observed points of the object and of the person's hand."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        self._recordings: list[tuple[int, Array, Array]] = []
        if log.clouds:
            snapshots = [cloud.snapshot for cloud in log.clouds]
            hands = compute_robot_link_poses(log, snapshots, (HAND_LINK,))[:, 0]
            self._recordings = [
                (cloud.step, transform_points(hand, cloud.object_points), transform_points(hand, cloud.hand_points))
                for cloud, hand in zip(log.clouds, hands, strict=True)
            ]
        self._clouds = [
            _PointCloud(
                scene, f"/observed/{label.name.lower()}", _rgb_from_html(LABEL_COLORS[label]), 2 * _CLOUD_POINT_RADIUS
            )
            for label in (SegmentationLabel.TARGET, SegmentationLabel.HAND)
        ]
        self._next = 0

    def show(self, index: int, frame: ReplayFrame) -> None:
        before = self._next
        while self._next < len(self._recordings) and self._recordings[self._next][0] <= frame.step:
            self._next += 1
        if self._next > before:
            _, *positions = self._recordings[self._next - 1]
            for cloud, points in zip(self._clouds, positions, strict=True):
                cloud.show(points)


class _PointCloud:
    """Points that can be replaced; invisible while there are none."""

    def __init__(self, scene: "SceneApi", name: str, color: Color, size: float) -> None:
        empty = np.zeros((1, 3), dtype=np.float16)
        self._handle = scene.add_point_cloud(
            name, empty, color, point_size=size, point_shape="circle", point_shading="flat", visible=False
        )

    def show(self, points: Array) -> None:
        """Show (n, 3) points (m)."""
        if len(points):
            self._handle.points = points.astype(np.float16)
        if self._handle.visible != bool(len(points)):
            self._handle.visible = bool(len(points))


class _StatusLabel:
    """Time and state of the episode, above the goal region."""

    def __init__(self, scene: "SceneApi", log: EpisodeLog) -> None:
        x, y, z = log.config.protocol.goal_center
        self._log = log
        self._handle = scene.add_label("/status", "", position=(x, y, z + _LABEL_HEIGHT), anchor="bottom-center")

    def show(self, index: int, frame: ReplayFrame) -> None:
        self._handle.text = describe_frame(self._log, frame)


def _segments(points: Array) -> Array:
    """Return the line segments (n - 1, 2, 3) between successive points (n, 3)."""
    return np.stack([points[:-1], points[1:]], axis=1)


def _quantize(values: Array, step: float) -> Array:
    quantized: Array = np.round(values / step) * step
    return quantized


def _html_from_rgb(color: Color) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def _rgb_from_html(html: str) -> Color:
    return int(html[1:3], 16), int(html[3:5], 16), int(html[5:7], 16)
