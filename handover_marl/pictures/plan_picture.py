"""A picture of what a planning receiver has in mind. Needs matplotlib (extra `plot`)."""

import importlib.util
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from typing_extensions import Unpack

from handover_marl.config import CameraConfig
from handover_marl.datasets import Dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.episode.play import play
from handover_marl.errors import OptionError
from handover_marl.files import write_atomically
from handover_marl.models.arm import Arm, Frames
from handover_marl.models.meshes import model_triangles
from handover_marl.models.panda import GRIPPER_OUTLINE
from handover_marl.models.poses import compose_point
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.options import shows
from handover_marl.pictures.rendering import checked_path
from handover_marl.planning.capsules import hand_capsules
from handover_marl.planning.planner import Plan
from handover_marl.policies.reference import PolicyLike, policy_reference
from handover_marl.receivers.omg import OmgReceiver
from handover_marl.run import OF_SEVERAL, REPLAY, Execution, Run, SceneOptions, describe

Array = npt.NDArray[np.float64]

_FORK = np.array(GRIPPER_OUTLINE)
# Elevation and azimuth of the two views (degrees).
_VIEWS = ((20.0, -20.0), (89.0, -90.0))
_STEEP = 80.0  # degrees
_ROOM = 0.45  # m from the middle to the edges

#: Size of a picture.
PLAN_CAMERA = CameraConfig(width=1200, height=600)


@shows(Run, Execution, without=("setup", "split", "scenes", "config", *OF_SEVERAL, "progress"))
def render_plan(
    scene_id: int,
    out: str | os.PathLike[str],
    *,
    receiver: PolicyLike = "omg",
    giver: PolicyLike = REPLAY,
    camera: CameraConfig = PLAN_CAMERA,
    **options: Unpack[SceneOptions],
) -> Path:
    """Draw the plan of a receiver for a scene: start, goal set, chosen goal, the hand link's path, person's hand.

    Args:
        scene_id: The scene, 0 to 999.
        out: Where to write a `.png`.
        receiver: A receiver that plans, as in `benchmark`.
        giver: As in `evaluate_pair`.
        camera: Its width and height are the picture's.
        options: `dataset`, `data_dir`, `physics`, `seed` and `trust`, as `handover_marl.Run` and
            `handover_marl.Execution` say.

    Returns:
        The file that was written.

    Raises:
        OptionError: The receiver plans nothing, the suffix is not .png, or matplotlib is not installed.
        UnknownNameError, SceneError, DataNotFoundError, DataFormatError: As for a benchmark.
    """
    path = checked_path(out, (".png",))
    if importlib.util.find_spec("matplotlib") is None:
        raise OptionError("drawing a plan needs matplotlib: pip install 'handover-marl[plot]'")
    run, how = describe("s0", options, receiver=receiver, giver=giver)
    data = run.open_dataset()
    policy, person = (
        policy_reference(agent, getattr(run, agent), how.trust).make(data, run.config, run.setup)
        for agent in ("receiver", "giver")
    )
    if not isinstance(policy, OmgReceiver):
        raise OptionError(f"receiver {receiver!r} plans nothing that could be drawn; choose omg or omg_hand_aware")
    episode = Episode(run.physics, run.config)
    episode.reset(data.scene(scene_id))
    play(episode, policy, person, seed=run.seed, until=lambda: policy.has_planned)
    observation = episode.observe()
    episode.close()
    name = CLASS_NAMES[int(observation["object_classes"][0])]
    title = f"{policy.name}, scene {scene_id} ({name}), {data.name}: {_summary(policy.plan)}"
    write_atomically(path, _draw(policy, observation, data, title, camera))
    return path


def _summary(plan: Plan | None) -> str:
    if plan is None:
        return "no goal can be reached"
    return f"{len(plan.goals)} goals (green), the chosen one red, {plan.steps} steps"


def _draw(policy: OmgReceiver, observation: Observation, data: Dataset, title: str, camera: CameraConfig) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(camera.width / 100, camera.height / 100), dpi=100, layout="constrained")
    figure.suptitle(title)
    middle = observation["object_poses"][0, :3]
    for number, (elevation, azimuth) in enumerate(_VIEWS, start=1):
        axes = figure.add_subplot(1, len(_VIEWS), number, projection="3d")
        _draw_things(axes, observation, data)
        if policy.plan is not None:
            _draw_plan(axes, policy.plan, policy.arm, policy.world_from_base)
        axes.set(
            xlim=(middle[0] - _ROOM, middle[0] + _ROOM),
            ylim=(middle[1] - _ROOM, middle[1] + _ROOM),
            zlim=(middle[2] - _ROOM, middle[2] + _ROOM),
            xlabel="x (m)",
            ylabel="y (m)",
            zlabel="z (m)",
        )
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elevation, azimuth)
        if elevation > _STEEP:
            # Seen along it, an axis shows all its numbers in one place.
            axes.set(zlabel="", zticks=[])
    figure.axes[0].legend(loc="upper left", fontsize="small")
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _draw_things(axes: Any, observation: Observation, data: Dataset) -> None:
    for number in np.flatnonzero(observation["object_mask"]):
        vertices, faces = model_triangles(data.object_urdf(CLASS_NAMES[int(observation["object_classes"][number])]))
        x, y, z = compose_point(observation["object_poses"][number].astype(np.float64), vertices).T
        color, label = ("tab:brown", "object") if number == 0 else ("tab:gray", "other objects")
        axes.plot_trisurf(x, y, z, triangles=faces, color=color, alpha=0.35, label=label if number < 2 else None)
    hand = hand_capsules(observation)
    if hand is not None:
        titles = ["person's hand"] + [None] * (len(hand.radii) - 1)
        for start, end, radius, title in zip(hand.starts, hand.ends, hand.radii, titles, strict=True):
            axes.plot(*np.stack([start, end]).T, color="tab:orange", linewidth=400 * radius, alpha=0.6, label=title)


def _draw_plan(axes: Any, plan: Plan, arm: Arm, world_from_base: Array) -> None:
    def world(points: Array) -> Array:
        return compose_point(world_from_base, points)

    def arm_line(joints: Array) -> Array:
        return world(np.concatenate([np.zeros((1, 3)), arm.chain(joints[None]).origins[..., 0]]))

    for outline in _hands(arm, plan.goals.goals):
        axes.plot(*world(outline).T, color="tab:green", linewidth=0.8, alpha=0.6)
    (chosen,) = _hands(arm, plan.trajectory[-1:])
    axes.plot(*world(chosen).T, color="tab:red", linewidth=2.5, label="chosen goal")
    axes.plot(*arm_line(plan.start).T, color="black", linewidth=3, alpha=0.5, label="arm at the start")
    axes.plot(*arm_line(plan.trajectory[-1]).T, color="tab:red", linewidth=3, alpha=0.3, label="arm at the end")
    path = world(arm.chain(np.concatenate([plan.start[None], plan.trajectory])).origins[-1].T)
    tail = plan.goals.tails.shape[1]
    axes.plot(*path.T, color="tab:blue", marker=".", label="hand link, a dot a waypoint")
    axes.plot(*path[-tail:].T, color="tab:purple", linewidth=3, label="straight to the grasp")


def _hands(arm: Arm, joints: Array) -> Sequence[Array]:
    """Outlines of the gripper in the base frame, (p, 3) each, for configurations (n, 7)."""
    chain: Frames = arm.chain(joints)
    origins, rotations = chain.origins[-1], chain.rotations[-1]
    return [_FORK @ rotations[..., number].T + origins[:, number] for number in range(len(joints))]
