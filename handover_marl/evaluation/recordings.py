"""Time series and replay pages in a result folder, one file for each scene.

`traces/209.csv` has a row for every 20 ms of the episode in scene 209; `episodes/209.html` is an animated 3D scene.
"""

from pathlib import Path

import numpy as np

from handover_marl.datasets.registry import format_dataset_title
from handover_marl.episode.loop import EpisodeCallback
from handover_marl.episode.metrics.motion import EpisodeTrace, compute_speeds
from handover_marl.evaluation.config import (
    REPLAYS_ALL,
    EvaluationConfig,
    format_inference_time,
    require_policy_reference,
)
from handover_marl.evaluation.reports.tables import format_csv
from handover_marl.evaluation.results import REPLAYS, EpisodeRecorder, EpisodeResult, EpisodeWriter
from handover_marl.policies.policy import Policy
from handover_marl.version import __version__
from handover_marl.visualization.replay_recorder import ReplayRecorder
from handover_marl.visualization.replay_scene import build_replay_page

_POSITIONS = tuple(f"{point}_{axis}" for point in ("gripper", "wrist") for axis in "xyz")
#: Columns: time (s); positions of the robot's hand link and of the person's wrist in the world frame (m), their speeds,
#: averaged over 80 ms (m/s), and their distance (m); largest sums of the robot's normal forces on object and person's
#: hand since the previous row (N). Columns of the wrist are empty while the person's hand is absent.
COLUMNS = (
    *("time", *_POSITIONS, "gripper_speed", "wrist_speed", "gripper_wrist_distance"),
    *("robot_object_force", "robot_hand_force"),
)


class TraceWriter(EpisodeWriter):
    """Writer of the time series of each episode, as a CSV file with the columns `COLUMNS`."""

    suffix = ".csv"

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Return an empty callback, as every evaluation records the trace, and the function that encodes it as CSV."""
        return EpisodeCallback(), lambda _, trace: format_trace(trace).encode()


def format_trace(trace: EpisodeTrace) -> str:
    """Return a motion trace as CSV text with the columns `COLUMNS`."""
    has_hand = np.isfinite(trace.wrist[:, 0])
    values = np.column_stack(
        [
            np.arange(len(trace.gripper)) * trace.period,
            trace.gripper,
            trace.wrist,
            compute_speeds(trace.gripper, trace.period),
            np.where(has_hand, compute_speeds(trace.wrist, trace.period), np.nan),
            np.linalg.norm(trace.gripper - trace.wrist, axis=1),
            trace.forces,
        ]
    )
    return format_csv([COLUMNS, *([None if np.isnan(cell) else f"{cell:.6g}" for cell in row] for row in values)])


def format_replay_facts(config: EvaluationConfig, models: str) -> str:
    """Return one line of text on data, policies and simulation of a replayed episode of a resolved configuration.

    Substitutes for HandoverSim's models are described by `models`, which is empty if there are none.
    """
    receiver, giver = require_policy_reference(config.receiver), require_policy_reference(config.giver)
    camera = config.sensors.describe(receiver.obs_mode, config.physics)
    observation = f" (obs_mode {receiver.obs_mode}, {camera})" if camera else ""
    parts = [
        format_dataset_title(config.dataset) + (f", {models}" if models else "") + f", setup {config.setup}",
        f"receiver {receiver.label}{observation}, giver {giver.label}",
        f"{config.physics} physics",
        *filter(None, [format_inference_time(config.inference_time)]),
        f"robot {config.robot}",
        f"seed {config.seed}",
        f"handover_marl {__version__}",
    ]
    return "; ".join(parts)


class ReplayWriter(EpisodeWriter):
    """Writer of replay pages of all episodes (`replays` is "all") or failed ones ("failed") in a result folder."""

    suffix = ".html"

    def __init__(self, folder: Path, replays: str) -> None:
        super().__init__(folder / REPLAYS)
        self._include_successes = replays == REPLAYS_ALL

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create the recorder of states and contacts, and the function that returns the page of an episode."""
        recorder = ReplayRecorder(receiver)

        def encode(result: EpisodeResult, trace: EpisodeTrace) -> bytes:
            if result.success and not self._include_successes:
                return b""
            return build_replay_page(recorder, format_replay_facts(config, result.models or "")).encode()

        return recorder, encode

    def contains(self, result: EpisodeResult) -> bool:
        """Return whether the page of an episode exists, or is not requested."""
        return (result.success and not self._include_successes) or super().contains(result)
