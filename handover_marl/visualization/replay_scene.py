"""Web page that replays an episode in 3D, in the viewer viser, beside its outcome, events and settings.

Needs the extra `replay`.
"""

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
from PIL import ImageColor

from handover_marl.config import HAND_DOF, TIME_STEP, CameraConfig
from handover_marl.execution.files import render_template
from handover_marl.execution.options import require_modules
from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.kinematic_tree import compute_link_trajectory, read_tree
from handover_marl.geometry.model_files.meshes import VisualMesh, read_visual_meshes
from handover_marl.geometry.model_files.urdf import read_model_mtimes
from handover_marl.geometry.panda import FINGER_LINKS, GRIPPER_OUTLINE, HAND_LINK
from handover_marl.geometry.poses import IDENTITY, poses_from_rotations, transform_points
from handover_marl.simulation.camera.images import LABEL_COLORS, JointSnapshot, SegmentationLabel
from handover_marl.version import __version__
from handover_marl.visualization.replay_recorder import ReplayFrame, ReplayRecorder, describe_frame, list_events

if TYPE_CHECKING:
    from viser import SceneApi

Array = npt.NDArray[np.float64]
Color = tuple[int, int, int]

# Resolution of stored positions (m) and quaternions: invisible, but the page compresses better.
_POSITION_STEP, _ROTATION_STEP = 2.0**-13, 2.0**-12
_ROBOT_COLOR, _GOAL_COLOR, _PLAN_COLOR = (205, 208, 214), (60, 160, 90), (190, 60, 200)
_GROUND_COLOR = (120, 120, 130)  # of the light from below
_FINGER_CONTACT_COLOR, _HAND_CONTACT_COLOR = (255, 200, 0), (230, 30, 40)
_FINGER_CONTACT_RADIUS, _CLOUD_POINT_RADIUS = 0.006, 0.002  # m
# Largest number of triangles of a link of the robot and of other bodies; more make the page large without a visible
# difference.
_MAX_ROBOT_FACES, _MAX_FACES = 3000, 900
_CLOUD_LABELS = (SegmentationLabel.TARGET, SegmentationLabel.HAND)
_LABEL_HEIGHT = 0.3  # m above the center of the goal region
_FLAT_SHADING_FACES = 300  # meshes with fewer triangles look better with flat shading
# Viser hides the scene until its map of the surroundings, from which light comes, has been decoded.
_SHOW_AT_ONCE = "<style>canvas{opacity:1!important;animation:appear .3s}@keyframes appear{from{opacity:0}}</style>"
#: Duration for which the end is shown before the animation starts again (s).
END_PAUSE_S = 1.5


@dataclass(frozen=True, eq=False)
class LinkTrajectory:
    """Poses of a link over the frames of a replay.

    Attributes:
        name: Unique name, such as "robot/3".
        label: Segmentation label of the body to which the link belongs.
        mesh: Visual mesh of the link.
        poses: (m, 7) world pose at each frame, xyz (m) and quaternion xyzw; (1, 7) if it is fixed.
        is_present: (m,) whether the link exists at each frame; (1,) if it is fixed.
    """

    name: str
    label: SegmentationLabel
    mesh: VisualMesh
    poses: Array
    is_present: npt.NDArray[np.bool_]


def require_replay_extra() -> None:
    """Check that the packages for replays are installed; raise `OptionError` if one is missing."""
    require_modules("a replay (.html)", "replay", "fast_simplification", "trimesh", "viser")


def build_replay_page(log: ReplayRecorder, facts: str, camera: CameraConfig = CameraConfig()) -> str:
    """Return a self-contained HTML page that replays a recorded episode and shows the text `facts` below the outcome.

    The first view of the 3D scene is from `camera`.
    """
    info, steps = log.scene.info, log.frames[-1].step
    outcome = f"{log.status.label} after {steps * TIME_STEP:.2f} s" if log.status else "the recording alone"
    return render_template(
        "handover_marl.visualization",
        "replay.html",
        version=__version__,
        title=f"Scene {info.scene_id}, {info.target_name}: {outcome}",
        mark=f"scene {info.scene_id}, {log.status.label}, {steps} steps",
        facts=facts,
        events=list_events(log),
        key=build_color_legend(log),
        stage=_build_viser_page(log, camera),
    )


def _build_viser_page(log: ReplayRecorder, camera: CameraConfig) -> str:
    """Return viser's HTML page with the animated 3D scene of an episode; the page needs no network."""
    require_replay_extra()
    links = list(compute_link_trajectories(log))
    with _run_server() as server:
        scene, view = server.scene, server.initial_camera
        scene.set_up_direction("+z")
        scene.add_light_hemisphere("/sky", ground_color=_GROUND_COLOR, intensity=1.2)
        view.position, view.look_at, view.up = camera.position, camera.target, camera.up
        view.fov = np.radians(camera.vertical_fov)
        serializer = server.get_scene_serializer()
        rules = log.config.protocol
        scene.add_icosphere(
            "/goal", rules.goal_radius, _GOAL_COLOR, opacity=0.15, position=rules.goal_center, cast_shadow=False
        )
        elements = [
            *(_add_link(scene, link) for link in links),
            _add_finger_contacts(scene, log),
            _add_planned_path(scene),
            _add_observed_points(scene, log),
            _add_status(scene, log),
        ]
        for index, frame in enumerate(log.frames):
            for show in elements:
                show(index, frame)
            if frame is not log.frames[-1]:
                serializer.insert_sleep((log.frames[index + 1].step - frame.step) * TIME_STEP)
        serializer.insert_sleep(END_PAUSE_S)
        page = str(serializer.as_html())
    # Dark mode follows the browser's setting, as on the page around it.
    dark_mode = "{darkMode:matchMedia('(prefers-color-scheme: dark)').matches}"
    return page.replace("{darkMode:false}", dark_mode, 1).replace("</head>", f"{_SHOW_AT_ONCE}</head>", 1)


def build_color_legend(log: ReplayRecorder) -> list[tuple[str, str]]:
    """Return pairs (HTML color, meaning) of the colors in an episode's 3D scene."""
    legend = [
        (LABEL_COLORS[SegmentationLabel.TARGET], "object"),
        (LABEL_COLORS[SegmentationLabel.HAND], "person's hand"),
    ]
    if len(log.scene.assets.objects) > 1:
        legend.append((LABEL_COLORS[SegmentationLabel.OTHER_OBJECT], "other objects"))
    legend += [(f"rgb{_FINGER_CONTACT_COLOR}", "contacts of fingers and object"), (f"rgb{_GOAL_COLOR}", "goal region")]
    if any(frame.touches_hand for frame in log.frames):
        legend.append((f"rgb{_HAND_CONTACT_COLOR}", "hand that the robot touches"))
    if any(frame.planned_path is not None for frame in log.frames):
        legend.append((f"rgb{_PLAN_COLOR}", "planned path of the gripper"))
    if log.clouds:
        legend.append((LABEL_COLORS[SegmentationLabel.TARGET], "dots: observed point cloud"))
    return legend


@contextlib.contextmanager
def _run_server() -> Iterator[Any]:
    """Yield a running server of viser, which is needed to build scenes; only this machine can reach it."""
    import viser

    # Viser prints messages at start and end even with verbose=False.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


# Function that shows an element of the scene at one frame; its arguments are the index of the frame, and the frame.
_Show: TypeAlias = Callable[[int, ReplayFrame], None]


def _make_setter(handle: Any) -> Callable[..., None]:
    """Return a function that sets properties of a viser element by name, if their values change.

    Only changes are recorded, because every recorded value makes the page larger.
    """
    shown = dict[str, Any]()

    def set_properties(**values: Any) -> None:
        for name, value in values.items():
            if name not in shown or not np.array_equal(shown[name], value):
                setattr(handle, name, value)
                shown[name] = value

    return set_properties


def _add_link(scene: "SceneApi", link: LinkTrajectory) -> _Show:
    color = _ROBOT_COLOR if link.label is SegmentationLabel.ROBOT else ImageColor.getrgb(LABEL_COLORS[link.label])[:3]
    is_flat = len(link.mesh.faces) < _FLAT_SHADING_FACES
    mesh = (f"/{link.name}", link.mesh.vertices, link.mesh.faces)
    set_properties = _make_setter(scene.add_mesh_simple(*mesh, color=color, flat_shading=is_flat, side="double"))
    positions = _quantize(link.poses[:, :3], _POSITION_STEP)
    rotations = _quantize(np.roll(link.poses[:, 3:], 1, axis=1), _ROTATION_STEP)

    def show(index: int, frame: ReplayFrame) -> None:
        row = min(index, len(positions) - 1)
        is_touched = frame.touches_hand and link.label is SegmentationLabel.HAND
        set_properties(position=positions[row], wxyz=rotations[row], visible=bool(link.is_present[row]))
        set_properties(color=_HAND_CONTACT_COLOR if is_touched else color)

    return show


def _add_finger_contacts(scene: "SceneApi", log: ReplayRecorder) -> _Show:
    """Add the contact points of fingers and object; return the function that shows the points of a frame."""
    poses = compute_robot_link_poses(log, [frame.snapshot for frame in log.frames], FINGER_LINKS)
    show_points = _add_points(scene, "/contacts", _FINGER_CONTACT_COLOR, 2 * _FINGER_CONTACT_RADIUS)

    def show(index: int, frame: ReplayFrame) -> None:
        fingers = zip(poses[index], frame.finger_points, strict=True)
        show_points(np.concatenate([transform_points(finger, points) for finger, points in fingers]))

    return show


def _add_planned_path(scene: "SceneApi") -> _Show:
    """Add the hand link's planned path with the gripper at its end; return the function that shows it at a frame."""
    empty = np.zeros((1, 2, 3), dtype=np.float32)
    style: Any = {"thickness": 3.0, "thickness_units": "screen", "visible": False}
    set_properties = _make_setter(scene.add_line_segments("/planned_path", empty, _PLAN_COLOR, **style))

    def show(index: int, frame: ReplayFrame) -> None:
        path = frame.planned_path
        if path is not None:
            outline = transform_points(path[-1], np.array(GRIPPER_OUTLINE))
            # Line segments (n - 1, 2, 3) between successive points (n, 3).
            lines = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in (path[:, :3], outline)])
            set_properties(points=_quantize(lines, _POSITION_STEP).astype(np.float32))
        set_properties(visible=path is not None)

    return show


def _add_observed_points(scene: "SceneApi", log: ReplayRecorder) -> _Show:
    """Add observed points of object and person's hand; return the function that shows the latest ones at a frame."""
    steps = np.array([step for step, *_ in log.clouds])
    snapshots = [snapshot for _, snapshot, *_ in log.clouds]
    hands = compute_robot_link_poses(log, snapshots, (HAND_LINK,))[:, 0] if log.clouds else np.zeros((0, 7))
    colors = {label: ImageColor.getrgb(LABEL_COLORS[label])[:3] for label in _CLOUD_LABELS}
    clouds = [
        _add_points(scene, f"/observed/{label.name.lower()}", color, 2 * _CLOUD_POINT_RADIUS)
        for label, color in colors.items()
    ]

    def show(index: int, frame: ReplayFrame) -> None:
        latest = int(np.searchsorted(steps, frame.step, side="right")) - 1
        if latest >= 0:
            for show_points, points in zip(clouds, log.clouds[latest][2:], strict=True):
                show_points(transform_points(hands[latest], points))

    return show


def _add_points(scene: "SceneApi", name: str, color: Color, size: float) -> Callable[[Array], None]:
    """Add a point cloud; return a function that replaces its points (n, 3) (m), and hides it if there are none."""
    style: Any = {"point_size": size, "point_shape": "circle", "point_shading": "flat", "visible": False}
    set_properties = _make_setter(scene.add_point_cloud(name, np.zeros((1, 3), dtype=np.float16), color, **style))

    def show(points: Array) -> None:
        if len(points):
            set_properties(points=points.astype(np.float16))
        set_properties(visible=bool(len(points)))

    return show


def _add_status(scene: "SceneApi", log: ReplayRecorder) -> _Show:
    """Add text on time and state of the episode above the goal region; return the function that updates it."""
    x, y, z = log.config.protocol.goal_center
    set_properties = _make_setter(
        scene.add_label("/status", "", position=(x, y, z + _LABEL_HEIGHT), anchor="bottom-center")
    )
    return lambda index, frame: set_properties(text=describe_frame(log, frame))


def _quantize(values: Array, step: float) -> Array:
    quantized: Array = np.round(values / step) * step
    return quantized


def compute_link_trajectories(log: ReplayRecorder) -> Iterator[LinkTrajectory]:
    """Yield the trajectories of all links with a visual mesh in a recorded episode."""
    assets, config = log.scene.assets, log.config.physics
    snapshots = [frame.snapshot for frame in log.frames]
    always = np.ones(len(snapshots), dtype=bool)
    table = np.array([*config.table_position, 0.0, 0.0, 0.0, 1.0])
    yield from _compute_body("table", SegmentationLabel.TABLE, assets.table, np.zeros((1, 0)), always[:1], table)
    base = np.array([*config.panda.base_position, *config.panda.base_orientation])
    yield from _compute_body("robot", SegmentationLabel.ROBOT, assets.panda, _stack_robot(snapshots), always, base)
    for number, urdf in enumerate(assets.objects):
        label = SegmentationLabel.OTHER_OBJECT if number else SegmentationLabel.TARGET
        joints = np.array([snapshot.objects[number] for snapshot in snapshots])
        yield from _compute_body(f"object{number}", label, urdf, joints, always)
    is_present = np.array([snapshot.hand is not None for snapshot in snapshots])
    if is_present.any():
        absent = np.zeros(HAND_DOF)
        joints = np.array([absent if snapshot.hand is None else snapshot.hand for snapshot in snapshots])
        yield from _compute_body("hand", SegmentationLabel.HAND, assets.hand, joints, is_present)


def compute_robot_link_poses(log: ReplayRecorder, snapshots: Sequence[JointSnapshot], names: Sequence[str]) -> Array:
    """Return the world poses (m, k, 7) of k links of the robot, xyz (m) and quaternions xyzw, in m snapshots."""
    urdf, panda = log.scene.assets.panda, log.config.physics.panda
    base = [*panda.base_position, *panda.base_orientation]
    origins, rotations = compute_link_trajectory(urdf, _stack_robot(snapshots), base)
    chosen = [read_tree(urdf).get_link(name) for name in names]
    return poses_from_rotations(origins[:, chosen], rotations[:, chosen])


def _stack_robot(snapshots: Sequence[JointSnapshot]) -> Array:
    return np.array([snapshot.robot for snapshot in snapshots], dtype=np.float64)


def _compute_body(
    name: str,
    label: SegmentationLabel,
    urdf: Path,
    joints: npt.NDArray[np.floating],
    is_present: npt.NDArray[np.bool_],
    base: Array = IDENTITY,
) -> Iterator[LinkTrajectory]:
    origins, rotations = compute_link_trajectory(urdf, joints, base)
    max_faces = _MAX_ROBOT_FACES if label is SegmentationLabel.ROBOT else _MAX_FACES
    for mesh in load_simplified_meshes(urdf, max_faces):
        poses, present = base[None], is_present[:1]
        if mesh.link >= 0:
            poses = poses_from_rotations(origins[:, mesh.link], rotations[:, mesh.link])
            present = is_present
        yield LinkTrajectory(f"{name}/{mesh.link + 1}", label, mesh, poses, present)


@cached_by_file(64, read_model_mtimes)
def load_simplified_meshes(urdf: Path, max_faces: int = _MAX_FACES) -> tuple[VisualMesh, ...]:
    """Return the visual meshes of a model's links with at most `max_faces` triangles each; cached."""
    # Imported only here, because they are optional dependencies.
    import fast_simplification
    import trimesh

    simplified = []
    for part in read_visual_meshes(urdf, read_tree(urdf)):
        # Vertices that triangles do not share would open gaps in the simplified mesh.
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        mesh.merge_vertices(merge_norm=True, merge_tex=True)
        points, triangles = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
        if len(triangles) > max_faces:
            points, triangles = fast_simplification.simplify(points, triangles, target_count=max_faces)
        simplified.append(VisualMesh(part.link, points.astype(np.float32), triangles.astype(np.int32)))
    return tuple(simplified)
