"""Rendering of a receiver's motion plan."""

import os
from pathlib import Path

from typing_extensions import Unpack

from handover_marl.config import CameraConfig, check_config
from handover_marl.errors import OptionError
from handover_marl.evaluation.config import (
    MULTI_SCENE_FIELDS,
    REPLAY,
    EpisodeOptions,
    EvaluationConfig,
    ExecutionConfig,
)
from handover_marl.evaluation.rendering.player import ScenePlayer
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import forward_signature, require_modules
from handover_marl.planning.planner import Plan
from handover_marl.policies.reference import PolicyLike
from handover_marl.receivers.omg import OmgReceiver
from handover_marl.visualization.plan_figure import draw_plan_figure
from handover_marl.visualization.video import check_output_path

#: Camera whose width and height give the default size of the image.
PLAN_CAMERA = CameraConfig(width=1200, height=600)


@forward_signature(
    EvaluationConfig,
    ExecutionConfig,
    without=("setup", "split", "scenes", "world_config", *MULTI_SCENE_FIELDS, "progress"),
)
def render_plan(
    scene_id: int,
    out: str | os.PathLike[str],
    *,
    receiver: PolicyLike = "omg",
    giver: PolicyLike = REPLAY,
    camera: CameraConfig = PLAN_CAMERA,
    **options: Unpack[EpisodeOptions],
) -> Path:
    """Render a receiver's first motion plan: start, goals, chosen goal and path of its hand.

    Args:
        scene_id: Number of the scene, 0 to 999 of official data.
        out: Output file, a `.png`.
        receiver: A receiver with a motion planner, such as "omg".
        giver: The person's policy, as in `evaluate_pair`.
        camera: Width and height of the image (pixels); its pose is not used.
        options: `dataset`, `data_dir`, `physics`, `seed` and `trust`, see
            `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Returns:
        Path of the written file.

    Raises:
        OptionError: The receiver has no planner, the suffix is not .png, or matplotlib is not
            installed.
        UnknownNameError, SceneError, DataNotFoundError, DataFormatError: As for `benchmark`.
    """
    path = check_output_path(out, (".png",))
    require_modules("a plan", "plot", "matplotlib")
    check_config("camera", camera, CameraConfig)
    player = ScenePlayer(scene_id, receiver, giver, options)
    policy, dataset = player.receiver, player.dataset
    if not isinstance(policy, OmgReceiver):
        raise OptionError(
            f"receiver must have a motion planner to render, got {receiver!r}; choose omg or omg_hand_aware"
        )
    player.play(lambda: policy.has_planned)
    observation = player.episode.observe()
    player.close()
    target = player.scene.info.target_name
    title = f"{policy.name}, scene {scene_id} ({target}), {dataset.name}: {_describe_plan(policy.plan)}"
    urdfs = [dataset.find_object_urdf(name) for name in player.scene.info.object_names]
    size = (camera.width, camera.height)
    content = draw_plan_figure(policy.plan, policy.arm, policy.world_from_base, observation, urdfs, title, size)
    write_atomically(path, content)
    return path


def _describe_plan(plan: Plan | None) -> str:
    if plan is None:
        return "no goal can be reached"
    return f"{len(plan.goals)} goals (green), the chosen one red, {plan.steps} steps"
