"""Figures: the wrist camera's view, a motion plan in a scene, and success rates as a heat map.

All but the first need matplotlib (extra `plot`).
"""

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageColor

from handover_marl.config import CameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.panda import GRIPPER_OUTLINE
from handover_marl.geometry.poses import transform_points
from handover_marl.planning.hand_tracker import hand_capsules_from_observation
from handover_marl.planning.planner import Plan
from handover_marl.simulation.camera.images import LABEL_COLORS, SegmentationLabel
from handover_marl.simulation.camera.optics import FAR

Picture = npt.NDArray[np.uint8]

_PALETTE = np.array([ImageColor.getrgb(LABEL_COLORS[label]) for label in SegmentationLabel], dtype=np.uint8)


def draw_wrist_view(episode: Episode, camera: CameraConfig) -> Picture:
    """Return an RGB image (h, w, 3): an outside view above colours, depth and segmentation of the wrist camera.

    The depth is brighter the nearer it is, and black from 2 m on.

    Args:
        episode: Episode, whose current state is drawn.
        camera: Outside camera.
    """
    frame = episode.capture_wrist_camera()
    depth = np.clip(255.0 * (1.0 - frame.depth / FAR), 0.0, 255.0).astype(np.uint8)
    images = (frame.rgb, np.stack([depth] * 3, axis=-1), _PALETTE[frame.segmentation])
    side = camera.width // len(images)
    strip = np.full((side, camera.width, 3), 255, dtype=np.uint8)
    for number, image in enumerate(images):
        resized = Image.fromarray(image).resize((side, side), Image.Resampling.NEAREST)
        strip[:, number * side : (number + 1) * side] = np.asarray(resized)
    picture: Picture = np.concatenate([episode.render(camera), strip])
    # H.264 videos need an even number of pixels a side.
    return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]


Array = npt.NDArray[np.float64]

_DPI = 100
# Elevation and azimuth of the two views (degrees): from the side and from above.
_VIEWS = ((20.0, -20.0), (89.0, -90.0))
_HALF_EXTENT = 0.45  # m from the target object to the edges of the figure


def draw_plan_figure(
    plan: Plan | None,
    arm: ArmKinematics,
    world_from_base: Array,
    observation: Observation,
    object_urdfs: Sequence[Path],
    title: str,
    size: tuple[int, int],
) -> bytes:
    """Draw objects, hand of the person and a motion plan from two sides; return a PNG.

    Args:
        plan: Motion plan; None draws the scene alone.
        arm: Kinematics of the robot arm.
        world_from_base: (7,) world pose of the robot base, xyz (m) and quaternion xyzw.
        observation: Observation of the scene when the plan was made.
        object_urdfs: URDF file of each object, in the order of the observation.
        title: Title of the figure.
        size: Width and height (pixels).
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, layout="constrained")
    figure.suptitle(title)
    center = observation["object_poses"][0, :3]
    limits = [(value - _HALF_EXTENT, value + _HALF_EXTENT) for value in center]
    meshes = [read_collision_mesh(urdf) for urdf in object_urdfs]
    hand = hand_capsules_from_observation(observation)
    lines = [] if plan is None else _list_plan_lines(plan, arm, world_from_base)
    for number, (elevation, azimuth) in enumerate(_VIEWS, start=1):
        axes = figure.add_subplot(1, len(_VIEWS), number, projection="3d")
        for index, (vertices, faces) in enumerate(meshes):
            pose, label = observation["object_poses"][index], ("object", "other objects")[index] if index < 2 else None
            color = "tab:gray" if index else "tab:brown"
            axes.plot_trisurf(
                *transform_points(pose.astype(np.float64), vertices).T,
                triangles=faces,
                color=color,
                alpha=0.35,
                label=label,
            )
        for start, end, radius in () if hand is None else zip(hand.starts, hand.ends, hand.radii, strict=True):
            label = None if axes.lines else "person's hand"
            axes.plot(*np.stack([start, end]).T, color="tab:orange", linewidth=400 * radius, alpha=0.6, label=label)
        for points, style in lines:
            axes.plot(*points.T, **style)
        axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
        axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elevation, azimuth)
    # Seen along the z axis, its tick labels overlap.
    axes.set(zlabel="", zticks=[])
    figure.axes[0].legend(loc="upper left", fontsize="small")
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _list_plan_lines(plan: Plan, arm: ArmKinematics, world_from_base: Array) -> list[tuple[Array, dict[str, Any]]]:
    """Return the lines that show a plan: points (n, 3) in the world (m), and keywords of matplotlib's `plot`."""

    def compute_chain(joints: Array) -> tuple[Array, Array]:
        """Return the world positions (n, 1 + links, 3) of base and links, and the gripper's outlines (n, points, 3)."""
        frames = arm.compute_chain_frames(joints)
        origins = np.moveaxis(frames.origins, 2, 0)
        rotations = np.moveaxis(frames.rotations[-1], 2, 0)
        outlines = np.array(GRIPPER_OUTLINE) @ rotations.transpose(0, 2, 1) + origins[:, -1:]
        chains = np.concatenate([np.zeros((len(joints), 1, 3)), origins], axis=1)
        return transform_points(world_from_base, chains), transform_points(world_from_base, outlines)

    waypoints, outlines = compute_chain(np.concatenate([plan.start[None], plan.trajectory]))
    tail = plan.goals.tails.shape[1]
    goal_style = {"color": "tab:green", "linewidth": 0.8, "alpha": 0.6}
    return [
        *((outline, goal_style) for outline in compute_chain(plan.goals.goals)[1]),
        (outlines[-1], {"color": "tab:red", "linewidth": 2.5, "label": "chosen goal"}),
        (waypoints[0], {"color": "black", "linewidth": 3, "alpha": 0.5, "label": "arm at the start"}),
        (waypoints[-1], {"color": "tab:red", "linewidth": 3, "alpha": 0.3, "label": "arm at the end"}),
        (waypoints[:, -1], {"color": "tab:blue", "marker": ".", "label": "hand link at each waypoint"}),
        (waypoints[-tail:, -1], {"color": "tab:purple", "linewidth": 3, "label": "straight approach to the grasp"}),
    ]


# Success rate above which a cell is so dark that its text is white.
_WHITE_TEXT_THRESHOLD = 0.55
# Number of characters above which names of columns are rotated, so that they do not overlap.
_MAX_HORIZONTAL_TEXT = 16
# Longest line, and most lines, of the name of a policy with many options.
_MAX_LINE, _MAX_LINES = 30, 3


def draw_heat_map(
    rates: Sequence[Sequence[float]],
    rows: Sequence[str],
    columns: Sequence[str],
    title: str,
    axis_labels: tuple[str, str] = ("giver", "receiver"),
) -> bytes:
    """Draw success rates of pairs of policies as a heat map; return it as PNG.

    Args:
        rates: Success rates (0 to 1), by row and column.
        rows: Names of the rows; long names are wrapped and cut off.
        columns: Names of the columns; likewise.
        title: Title of the figure.
        axis_labels: What the rows and the columns are.
    """
    from matplotlib.figure import Figure

    rows, columns = ([_wrap_name(name) for name in names] for names in (rows, columns))
    figure = Figure(figsize=(2.6 + 1.3 * len(columns), 1.9 + 0.55 * len(rows)), dpi=150)
    axes = figure.add_subplot()
    image = axes.imshow(rates, cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
    if max(len(line) for name in columns for line in name.splitlines()) > _MAX_HORIZONTAL_TEXT:
        axes.set_xticks(range(len(columns)), columns, rotation=30, ha="right", rotation_mode="anchor")
    else:
        axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_ylabel(axis_labels[0])
    axes.set_xlabel(axis_labels[1])
    for row, line in enumerate(rates):
        for column, rate in enumerate(line):
            color = "white" if rate > _WHITE_TEXT_THRESHOLD else "black"
            axes.text(column, row, f"{100 * rate:.0f} %", ha="center", va="center", color=color)
    axes.set_title(title, fontsize=8)
    figure.colorbar(image, ax=axes, label="success")
    figure.tight_layout()
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _wrap_name(name: str) -> str:
    """Return a name with line breaks between options, cut off after `_MAX_LINES` lines."""
    lines = textwrap.wrap(
        name.replace(",", ", ").replace(":", ": "), _MAX_LINE, max_lines=_MAX_LINES, placeholder=" ..."
    )
    return "\n".join(lines)
