"""A replay: one page with an episode to look at from all sides, and what there is to know about it."""

from handover_marl._version import __version__
from handover_marl.config import TIME_STEP, CameraConfig
from handover_marl.datasets import DATASET_TITLES
from handover_marl.pages.page import page
from handover_marl.pictures.replay_recorder import EpisodeLog
from handover_marl.pictures.replay_stage import stage_key, stage_page
from handover_marl.pictures.replay_words import events_of
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.run import Run, reference_of

# The one of pictures, from a little nearer.
_CAMERA = CameraConfig(vertical_fov=42.0, target=(0.5, -0.15, 1.15))


def replay_page(log: EpisodeLog, facts: str, camera: CameraConfig | None = None) -> str:
    """A page that loads nothing from elsewhere.

    Args:
        log: The episode.
        facts: What was played how, in words.
        camera: Where to look from at first.

    Raises:
        OptionError: The extra `replay` is not installed.
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    info, steps = log.scene.info, log.moments[-1].step
    outcome = f"{log.status.label} after {steps * TIME_STEP:.2f} s" if log.status else "the recording alone"
    return page(
        "replay.html",
        version=__version__,
        title=f"Scene {info.scene_id}, {info.target_name}: {outcome}",
        mark=episode_mark(info.scene_id, log.status, steps),
        facts=facts,
        events=events_of(log),
        key=stage_key(log),
        stage=stage_page(log, camera or _CAMERA),
    )


def replay_facts(run: Run, models: str) -> str:
    """What was played how, in words.

    Args:
        run: What, with its dataset's name and its policies resolved.
        models: What is not HandoverSim's own, in words.
    """
    receiver, giver = reference_of(run.receiver), reference_of(run.giver)
    sees = run.camera.described(receiver.sight, receiver.observes, run.physics)
    told = [
        DATASET_TITLES.get(run.dataset, run.dataset) + (f", {models}" if models else ""),
        f"receiver {receiver.label}{f' ({sees})' if sees else ''}, giver {giver.label}",
        f"{run.physics} physics",
        f"robot {run.robot}",
        f"seed {run.seed}",
        f"handover_marl {__version__}",
    ]
    return "; ".join(told)


def episode_mark(scene_id: int, status: EpisodeStatus, steps: int) -> str:
    """What a replay says, near its beginning, about which episode it shows."""
    return f"scene {scene_id}, {status.label}, {steps} steps"
