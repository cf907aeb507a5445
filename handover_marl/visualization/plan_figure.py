"""Figure of a motion plan in a scene; needs matplotlib (extra `plot`)."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.panda import GRIPPER_OUTLINE
from handover_marl.geometry.poses import transform_points
from handover_marl.planning.hand_tracker import hand_capsules_from_observation
from handover_marl.planning.planner import Plan

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
