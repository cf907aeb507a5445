"""Figure of a motion plan in a scene; needs matplotlib (extra `plot`)."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arm import ArmKinematics, LinkFrames
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.panda import GRIPPER_OUTLINE
from handover_marl.geometry.poses import transform_points
from handover_marl.planning.hand_tracker import hand_capsules_from_observation
from handover_marl.planning.planner import Plan

Array = npt.NDArray[np.float64]

_GRIPPER_OUTLINE = np.array(GRIPPER_OUTLINE)
_DPI = 100
# Elevation and azimuth of the two views (degrees): from the side and from above.
_VIEWS = ((20.0, -20.0), (89.0, -90.0))
_TOP_VIEW_ELEVATION = 80.0  # degrees
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
    for number, (elevation, azimuth) in enumerate(_VIEWS, start=1):
        axes = figure.add_subplot(1, len(_VIEWS), number, projection="3d")
        _draw_objects(axes, observation, object_urdfs)
        _draw_person_hand(axes, observation)
        if plan is not None:
            _draw_plan(axes, plan, arm, world_from_base)
        axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
        axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elevation, azimuth)
        if elevation > _TOP_VIEW_ELEVATION:
            # Seen along the z axis, its tick labels overlap.
            axes.set(zlabel="", zticks=[])
    figure.axes[0].legend(loc="upper left", fontsize="small")
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _draw_objects(axes: Any, observation: Observation, object_urdfs: Sequence[Path]) -> None:
    for number, urdf in enumerate(object_urdfs):
        vertices, faces = read_collision_mesh(urdf)
        x, y, z = transform_points(observation["object_poses"][number].astype(np.float64), vertices).T
        color, label = ("tab:brown", "object") if number == 0 else ("tab:gray", "other objects")
        label_once = label if number < 2 else None
        axes.plot_trisurf(x, y, z, triangles=faces, color=color, alpha=0.35, label=label_once)


def _draw_person_hand(axes: Any, observation: Observation) -> None:
    hand = hand_capsules_from_observation(observation)
    if hand is None:
        return
    labels = ["person's hand"] + [None] * (len(hand.radii) - 1)
    for start, end, radius, label in zip(hand.starts, hand.ends, hand.radii, labels, strict=True):
        bone = np.stack([start, end]).T
        axes.plot(*bone, color="tab:orange", linewidth=400 * radius, alpha=0.6, label=label)


def _draw_plan(axes: Any, plan: Plan, arm: ArmKinematics, world_from_base: Array) -> None:
    def to_world(points: Array) -> Array:
        return np.asarray(transform_points(world_from_base, points))

    def arm_line(joints: Array) -> Array:
        origins = arm.compute_chain_frames(joints[None]).origins[..., 0]
        return to_world(np.concatenate([np.zeros((1, 3)), origins]))

    for outline in _gripper_outlines(arm, plan.goals.goals):
        axes.plot(*to_world(outline).T, color="tab:green", linewidth=0.8, alpha=0.6)
    (chosen,) = _gripper_outlines(arm, plan.trajectory[-1:])
    axes.plot(*to_world(chosen).T, color="tab:red", linewidth=2.5, label="chosen goal")
    start, end = arm_line(plan.start).T, arm_line(plan.trajectory[-1]).T
    axes.plot(*start, color="black", linewidth=3, alpha=0.5, label="arm at the start")
    axes.plot(*end, color="tab:red", linewidth=3, alpha=0.3, label="arm at the end")
    waypoints = np.concatenate([plan.start[None], plan.trajectory])
    path = to_world(arm.compute_chain_frames(waypoints).origins[-1].T)
    tail = plan.goals.tails.shape[1]
    axes.plot(*path.T, color="tab:blue", marker=".", label="hand link at each waypoint")
    axes.plot(*path[-tail:].T, color="tab:purple", linewidth=3, label="straight approach to the grasp")


def _gripper_outlines(arm: ArmKinematics, joints: Array) -> Sequence[Array]:
    """Return the gripper's outline, (p, 3) in the base frame (m), for each of (n, 7) joint angles."""
    chain: LinkFrames = arm.compute_chain_frames(joints)
    origins, rotations = chain.origins[-1], chain.rotations[-1]
    return [_GRIPPER_OUTLINE @ rotations[..., number].T + origins[:, number] for number in range(len(joints))]
