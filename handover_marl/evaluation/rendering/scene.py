"""Rendering of a scene or an episode as an image grid, a video or a replay page."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from typing_extensions import Unpack

from handover_marl.config import CameraConfig, check_config
from handover_marl.episode.episode import Episode
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.config import (
    MULTI_SCENE_FIELDS,
    REPLAY,
    EpisodeOptions,
    EvaluationConfig,
    ExecutionConfig,
)
from handover_marl.evaluation.rendering.player import ScenePlayer
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_boolean, forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.camera.renderers import check_rendering, resolve_renderer
from handover_marl.visualization.replay_scene import require_replay_extra
from handover_marl.visualization.video import (
    FRAME_PERIOD_MS,
    SUFFIXES,
    FrameRecorder,
    Picture,
    check_output_path,
    draw_caption,
    encode_grid,
    encode_video,
    format_caption,
)
from handover_marl.visualization.wrist_view import draw_wrist_view

#: Names of the views.
VIEWS = ("outside", "wrist")

_GRID_COLUMNS = 3
# Duration for which a scene without a receiver is shown after the recorded motion.
_STILL_SCENE_DURATION_MS = 500


@forward_signature(
    EvaluationConfig, ExecutionConfig, without=("setup", "split", "scenes", "world_config", *MULTI_SCENE_FIELDS)
)
def render_scene(
    scene_id: int,
    out: str | os.PathLike[str],
    *,
    receiver: PolicyLike | None = None,
    giver: PolicyLike = REPLAY,
    key_frames: int = 6,
    camera: CameraConfig | None = None,
    view: str = "outside",
    caption: bool = True,
    **options: Unpack[EpisodeOptions],
) -> Path:
    """Render a scene, or the episode of two policies in it, to a file.

    Args:
        scene_id: Number of the scene, 0 to 999 of official data.
        out: Output file: `.png` for a grid of key frames, `.gif` or `.mp4` for a video, `.html` for
            a page that replays the episode in 3D.
        receiver: The robot's policy, as in `benchmark`; None keeps the robot at rest.
        giver: The person's policy, as in `evaluate_pair`.
        key_frames: Number of images of a `.png`, evenly spaced from start to end of the episode.
        camera: Pose and image size of the outside camera.
        view: "outside", or "wrist" for the outside image above colours, depth and segmentation of
            the wrist camera.
        caption: Whether images and videos show the simulated time and the state of the episode:
            "object touched", "released", "contact", "drop", "timeout" or "goal reached".
        options: `dataset`, `data_dir`, `physics`, `robot`, `renderer`, `camera_model`,
            `camera_noise`, `seed`, `progress` and `trust`, see `handover_marl.EvaluationConfig`
            and `handover_marl.ExecutionConfig`.

    Returns:
        Path of the written file.

    Raises:
        OptionError: The file's suffix is unknown, a library for it is not installed, or a size is
            impossible.
        ResultsError: The file cannot be written; raised before rendering.
        UnknownNameError: The view, or another name, is unknown.
        SceneError, DataNotFoundError, DataFormatError: As for `benchmark`.
    """
    path = check_output_path(out, SUFFIXES)
    suffix = path.suffix.lower()
    _check_view(view, path)
    if camera is not None:
        check_config("camera", camera, CameraConfig)
    check_boolean("caption", caption)
    draw = _make_draw_function(view, camera or CameraConfig(), caption)
    if isinstance(key_frames, bool) or not isinstance(key_frames, int) or key_frames < 1:
        raise OptionError(f"key_frames must be an integer of at least 1, got {key_frames!r}")
    player = ScenePlayer(scene_id, "hold" if receiver is None else receiver, giver, options)
    wrist_camera = player.config.camera
    if view == "wrist":
        resolve_renderer(wrist_camera.renderer, player.config.physics)
    until = player.scene.n_frames + _STILL_SCENE_DURATION_MS if receiver is None else None

    def record_frames(steps: Sequence[int], with_end: bool) -> list[Picture]:
        recorder = FrameRecorder(steps, draw, player.execution.progress, with_end)
        player.play(until, [recorder])
        return recorder.frames

    if suffix == ".html":
        content = player.build_replay_page(until, camera)
    elif suffix == ".png":
        # Simulated twice: the steps of the key frames are known only after the episode's end.
        end = player.play(None, []) if until is None else until
        steps = np.linspace(0, end, key_frames).round().astype(int).tolist()
        content = encode_grid(record_frames(steps, False), _GRID_COLUMNS)
    else:
        horizon = until or player.config.world_config.protocol.horizon_steps
        content = encode_video(record_frames(range(0, horizon, FRAME_PERIOD_MS), True), suffix)
    player.close()
    write_atomically(path, content)
    return path


def _check_view(view: str, path: Path) -> None:
    check_name("view", view, VIEWS)
    if path.suffix.lower() != ".html":
        check_rendering(f"drawing {path.name}")
        return
    require_replay_extra()
    if view != "outside":
        raise OptionError(f"view of a replay (.html) must be 'outside', got {view!r}")


def _make_draw_function(view: str, camera: CameraConfig, caption: bool) -> Callable[[Episode], Picture]:
    def draw(episode: Episode) -> Picture:
        picture = draw_wrist_view(episode, camera) if view == "wrist" else episode.render(camera)
        return draw_caption(picture, format_caption(episode)) if caption else picture

    return draw
