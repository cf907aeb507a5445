"""Rendering of one scene: image grids, videos and replay pages."""

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.config import CameraConfig, check_config
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeCallback, derive_robot_seed, run_episode
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, ExecutionConfig, build_configs, set_dataset
from handover_marl.evaluation.episode_runner import EpisodeRunner
from handover_marl.evaluation.recordings import format_replay_facts
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_boolean, check_positive_integer, forward_signature
from handover_marl.policies.reference import PolicyLike, parse_policy
from handover_marl.simulation.camera.renderers import check_rendering, resolve_renderer
from handover_marl.visualization.pictures import (
    FRAME_PERIOD_MS,
    SUFFIXES,
    FrameRecorder,
    Picture,
    draw_caption,
    draw_wrist_view,
    encode_grid,
    encode_video,
    format_caption,
    prepare_output_path,
)
from handover_marl.visualization.replay_recorder import ReplayRecorder
from handover_marl.visualization.replay_scene import build_replay_page, require_replay_extra

_GRID_COLUMNS = 3
# Duration for which a scene without a receiver is shown after the recorded motion.
_STILL_SCENE_DURATION_MS = 500
# Fields of both configurations that do not apply to a single scene.
_SINGLE_SCENE = ("split", "scenes", "workers", "ray_address", "shard", "overwrite", "replays", "traces")


def _simulate(
    runner: EpisodeRunner, scene: Scene, until: int | Callable[[], bool] | None = None, *callbacks: EpisodeCallback
) -> int:
    """Simulate a scene to its end, for a number of steps, or until a predicate holds; return the number of steps."""
    seed = runner.config.seed
    runner.episode.reset(scene, derive_robot_seed(seed, scene))
    policies, passed = (runner.receiver, runner.giver), runner.config.inference_time
    run_episode(runner.episode, *policies, seed=seed, until=until, callbacks=callbacks, inference_time=passed)
    return runner.episode.steps


@forward_signature(EvaluationConfig, ExecutionConfig, without=dict.fromkeys(_SINGLE_SCENE, "there is one scene"))
def render_scene(
    scene_id: int,
    out: str | os.PathLike[str],
    *,
    receiver: PolicyLike | None = None,
    giver: PolicyLike = REPLAY,
    key_frames: int = 6,
    camera: CameraConfig = CameraConfig(),
    view: str = "outside",
    caption: bool = True,
    **options: Any,
) -> Path:
    """Render a scene, or the episode of two policies in it, to a file; return the path of the file.

    Args:
        scene_id: Number of the scene, 0 to 999 of official data.
        out: Output file: `.png` for a grid of key frames, `.gif` or `.mp4` for a video, `.html` for a 3D replay page.
        receiver: The robot's policy, as in `benchmark`; None keeps the robot at rest until 0.5 s after the recording.
        giver: The person's policy, as in `evaluate_pair`.
        key_frames: Number of images of a `.png`, evenly spaced from start to end of the episode.
        camera: Pose, field of view and image size of the outside camera.
        view: "outside", or "wrist" for the outside image above colors, depth and segmentation of the wrist camera.
        caption: Whether images and videos show the simulated time and the state of the episode:
            "object touched", "released", "contact", "drop", "timeout" or "goal reached".
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`, except those for
            several scenes or result folders, such as `split` and `workers`; `setup` selects weights of some policies.

    Raises:
        OptionError: The file's suffix is unknown, a library for it is not installed, or a value is out of range.
        ResultsError: The file cannot be written; raised before rendering if that can be foreseen.
        UnknownNameError: The view, or another name, is unknown.
        SceneError, DataNotFoundError, DataFormatError: As for `benchmark`.
    """
    path = prepare_output_path(out, SUFFIXES)
    suffix = path.suffix.lower()
    check_name("view", view, ("outside", "wrist"))
    if suffix != ".html":
        check_rendering(f"drawing {path.name}")
    else:
        require_replay_extra()
        if view != "outside":
            raise OptionError(f"view of a replay (.html) must be 'outside', got {view!r}")
    check_config("camera", camera, CameraConfig)
    check_boolean("caption", caption)
    check_positive_integer("key_frames", key_frames)
    given: Any = {"receiver": receiver or "hold", "giver": giver}
    config, execution = build_configs(options, **given)
    dataset = config.open_dataset()
    setup = dataset.resolve_setup(config.setup)
    policies: Any = {
        agent: parse_policy(agent, policy, execution.trust).resolve(dataset, config.world_config, setup)
        for agent, policy in given.items()
    }
    config = set_dataset(replace(config, setup=setup, **policies), dataset)
    scene = dataset.load_scene(scene_id)
    if view == "wrist":
        resolve_renderer(config.renderer, config.physics)
    until, world = scene.n_frames + _STILL_SCENE_DURATION_MS if receiver is None else None, config.world_config
    protocol = replace(world.protocol, horizon_steps=max(until or 0, world.protocol.horizon_steps))
    config = replace(config, world_config=replace(world, protocol=protocol))

    def draw(episode: Episode) -> Picture:
        picture = draw_wrist_view(episode, camera) if view == "wrist" else episode.render(camera)
        return draw_caption(picture, format_caption(episode)) if caption else picture

    def record_frames(steps: Sequence[int]) -> list[Picture]:
        recorder = FrameRecorder(steps, draw, execution.progress)
        _simulate(runner, scene, until, recorder)
        return recorder.frames

    with contextlib.closing(EpisodeRunner(config)) as runner:
        if suffix == ".html":
            recorder = ReplayRecorder(runner.receiver)
            _simulate(runner, scene, until, recorder)
            facts = format_replay_facts(config, runner.dataset.describe_models(scene_id))
            content = build_replay_page(recorder, facts, camera).encode()
        elif suffix == ".png":
            # Simulated twice: the steps of the key frames are known only after the episode's end.
            end = _simulate(runner, scene) if until is None else until
            steps = np.linspace(0, end, key_frames).round().astype(int).tolist()
            content = encode_grid(record_frames(steps)[:key_frames], _GRID_COLUMNS)
        else:
            horizon = until or config.world_config.protocol.horizon_steps
            content = encode_video(record_frames(range(0, horizon, FRAME_PERIOD_MS)), suffix)
    write_atomically(path, content)
    return path
