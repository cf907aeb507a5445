"""The command that draws one scene."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from handover_marl.cli.run_options import SceneExecution, SceneRun

if TYPE_CHECKING:
    from handover_marl.config import CameraConfig

_SCENE, _SHOWN = SceneRun(), SceneExecution()
# Fields of a run that also one scene has.
_OF_A_SCENE = ("dataset", "data_dir", "physics", "robot", "renderer", "geometry", "imperfections", "seed", "giver")


def run_render(
    scene: int,
    out: Annotated[str, tyro.conf.arg(metavar="FILE")],
    receiver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    plan: bool = False,
    view: Literal["outside", "wrist"] = "outside",
    key_frames: int = 6,
    width: int | None = None,
    height: int | None = None,
    run: SceneRun = _SCENE,
    how: SceneExecution = _SHOWN,
) -> None:
    """Draw a scene, the episode that policies make of it, or what a receiver plans.

    Args:
        scene: Number of the scene, 0 to 999.
        out: A .png is a sheet of key frames; .gif and .mp4 are films; an .html plays the episode in three dimensions.
        receiver: The robot's policy; without one the robot stays at rest.
        plan: Draw the plan of a receiver such as omg (.png): start, goals, the chosen one, the hand's path.
        view: outside, or wrist: the same beside depth, segmentation and cloud of the robot's wrist camera.
        key_frames: Pictures on a sheet.
        width: Width of a picture in pixels.
        height: Height of a picture in pixels.
        run: What is shown.
        how: How.
    """
    from handover_marl.config import CameraConfig
    from handover_marl.pictures.rendering import render_scene

    told: Any = {key: getattr(run, key) for key in _OF_A_SCENE}
    told |= {"trust": how.trust}
    if plan:
        from handover_marl.pictures.plan_picture import PLAN_CAMERA, render_plan

        seen_from = _sized(PLAN_CAMERA, width, height)
        print(render_plan(scene, out, receiver=receiver or "omg", camera=seen_from, **told))
        return
    # Otherwise each kind of file is seen from where it looks best.
    camera = None if width is None and height is None else _sized(CameraConfig(), width, height)
    told |= {"progress": how.progress}
    print(render_scene(scene, out, receiver=receiver, key_frames=key_frames, camera=camera, view=view, **told))


def _sized(camera: "CameraConfig", width: int | None, height: int | None) -> "CameraConfig":
    wide = camera.width if width is None else width
    return replace(camera, width=wide, height=camera.height if height is None else height)
