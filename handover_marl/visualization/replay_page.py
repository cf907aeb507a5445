"""Web page that replays an episode in 3D beside its outcome, events and settings."""

from handover_marl.config import TIME_STEP, CameraConfig
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.version import __version__
from handover_marl.visualization.replay_recorder import EpisodeLog, list_events
from handover_marl.visualization.replay_scene import build_color_legend, build_viser_page
from handover_marl.visualization.web_page import render_page

# As the camera of images, but a little nearer.
_CAMERA = CameraConfig(vertical_fov=42.0, target=(0.5, -0.15, 1.15))


def build_replay_page(log: EpisodeLog, facts: str, camera: CameraConfig | None = None) -> str:
    """Return a self-contained HTML page with the replay of an episode.

    Args:
        log: Recorded episode.
        facts: Description of data, policies and simulation.
        camera: Initial camera; default: in front of the robot.

    Raises:
        OptionError: The extra `replay` is not installed.
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    info, steps = log.scene.info, log.frames[-1].step
    outcome = f"{log.status.label} after {steps * TIME_STEP:.2f} s" if log.status else "the recording alone"
    return render_page(
        "replay.html",
        version=__version__,
        title=f"Scene {info.scene_id}, {info.target_name}: {outcome}",
        mark=format_episode_caption(info.scene_id, log.status, steps),
        facts=facts,
        events=list_events(log),
        key=build_color_legend(log),
        stage=build_viser_page(log, camera or _CAMERA),
    )


def format_episode_caption(scene_id: int, status: EpisodeStatus, steps: int) -> str:
    """Return the caption near the start of a replay page, which identifies the episode."""
    return f"scene {scene_id}, {status.label}, {steps} steps"
