"""Command that renders one scene."""

from dataclasses import replace
from typing import Annotated, Any, Literal

import tyro

from handover_marl.cli.options import ArgumentError, RenderArguments, RenderExecutionArguments
from handover_marl.cli.streams import print_result

_SCENE, _EXECUTION = RenderArguments(), RenderExecutionArguments()
# Fields of `EvaluationConfig` that apply to a single scene.
_SCENE_FIELDS = ("dataset", "data_dir", "physics", "robot", "renderer", "camera_model", "camera_noise", "seed", "giver")

_Point = Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")]


def run_render(
    scene: int,
    out: Annotated[str, tyro.conf.arg(metavar="FILE")],
    receiver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    plan: bool = False,
    view: Literal["outside", "wrist"] = "outside",
    key_frames: int = 6,
    caption: bool = True,
    width: int | None = None,
    height: int | None = None,
    position: _Point = None,
    target: _Point = None,
    vertical_fov: float | None = None,
    evaluation: RenderArguments = _SCENE,
    execution: RenderExecutionArguments = _EXECUTION,
) -> None:
    """Render a scene, an episode in it, or a receiver's motion plan.

    Args:
        scene: Number of the scene, 0 to 999.
        out: Output file: .png for a grid of key frames, .gif or .mp4 for a video, .html for a 3D replay.
        receiver: The robot's policy; default: the robot stays at rest.
        plan: Render the plan of a receiver such as omg (.png): start, goals, chosen goal, hand path.
        view: outside, or wrist for colours, depth and segmentation of the wrist camera below it.
        key_frames: Number of key frames of a .png.
        caption: Show the time and the state of the episode (released, contact, goal reached) in images and videos.
        width: Width of an image in pixels.
        height: Height of an image in pixels.
        position: Position of the outside camera in the world frame (m); default: 1.95 -0.2 1.75.
        target: Point at the center of its image in the world frame (m); default: 0.45 -0.2 1.15.
        vertical_fov: Vertical field of view of the outside camera (degrees); default: 54.
        evaluation: Scene data, giver and simulation.
        execution: Progress bar, and trust in policy files.
    """
    from handover_marl.config import CameraConfig
    from handover_marl.evaluation.rendering import render_scene

    options: Any = {key: getattr(evaluation, key) for key in _SCENE_FIELDS} | {"trust": execution.trust}
    size, pose = {"width": width, "height": height}, {"position": position, "target": target}
    given = {**size, **pose, "vertical_fov": vertical_fov}
    camera: Any = {name: value for name, value in given.items() if value is not None}
    if plan:
        from handover_marl.evaluation.rendering import PLAN_CAMERA, render_plan

        if not camera.keys() <= size.keys():
            raise ArgumentError("--position, --target and --vertical-fov do not apply to --plan; leave them out")
        options["camera"] = replace(PLAN_CAMERA, **camera)
        print_result(render_plan(scene, out, receiver=receiver or "omg", **options))
        return
    # Without these options, each kind of file has its own default camera.
    options |= {"camera": CameraConfig(**camera) if camera else None}
    options |= {"progress": execution.progress, "view": view, "key_frames": key_frames, "caption": caption}
    print_result(render_scene(scene, out, receiver=receiver, **options))
