"""Command that renders one scene."""

from dataclasses import replace
from typing import Annotated, Any, Literal

import tyro

from handover_marl.cli.options import RenderArguments, RenderExecutionArguments
from handover_marl.cli.streams import print_result

_SCENE, _EXECUTION = RenderArguments(), RenderExecutionArguments()
# Fields of `EvaluationConfig` that apply to a single scene.
_SCENE_FIELDS = ("dataset", "data_dir", "physics", "robot", "renderer", "camera_model", "camera_noise", "seed", "giver")


def run_render(
    scene: int,
    out: Annotated[str, tyro.conf.arg(metavar="FILE")],
    receiver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    plan: bool = False,
    view: Literal["outside", "wrist"] = "outside",
    key_frames: int = 6,
    width: int | None = None,
    height: int | None = None,
    evaluation: RenderArguments = _SCENE,
    execution: RenderExecutionArguments = _EXECUTION,
) -> None:
    """Render a scene, an episode in it, or a receiver's motion plan.

    Args:
        scene: Number of the scene, 0 to 999.
        out: Output file: .png for a grid of key frames, .gif or .mp4 for a film, .html for a 3D replay.
        receiver: The robot's policy; default: the robot stays at rest.
        plan: Render the plan of a receiver such as omg (.png): start, goals, chosen goal, hand path.
        view: outside, or wrist for depth, segmentation and point cloud of the wrist camera beside it.
        key_frames: Number of key frames of a .png.
        width: Width of an image in pixels.
        height: Height of an image in pixels.
        evaluation: Scene data, giver and simulation.
        execution: Progress bar, and trust in policy files.
    """
    from handover_marl.config import CameraConfig
    from handover_marl.evaluation.rendering.scene import render_scene

    options: Any = {key: getattr(evaluation, key) for key in _SCENE_FIELDS} | {"trust": execution.trust}
    size: dict[str, Any] = {
        name: pixels for name, pixels in (("width", width), ("height", height)) if pixels is not None
    }
    if plan:
        from handover_marl.evaluation.rendering.plan import PLAN_CAMERA, render_plan

        options["camera"] = replace(PLAN_CAMERA, **size)
        print_result(render_plan(scene, out, receiver=receiver or "omg", **options))
        return
    # Without a size, each kind of file has its own default camera.
    options |= {"camera": CameraConfig(**size) if size else None}
    options |= {"progress": execution.progress, "view": view, "key_frames": key_frames}
    print_result(render_scene(scene, out, receiver=receiver, **options))
