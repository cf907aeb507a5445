"""Replay pages of episodes in a result folder: `episodes/209.html`, an animated 3D scene each."""

from pathlib import Path

from handover_marl.datasets.registry import format_dataset_title
from handover_marl.episode.metrics.motion import EpisodeTrace
from handover_marl.evaluation.config import REPLAYS_ALL, EvaluationConfig, require_policy_reference
from handover_marl.evaluation.results import (
    REPLAYS,
    EpisodeRecorder,
    EpisodeResult,
    EpisodeWriter,
)
from handover_marl.policies.policy import Policy
from handover_marl.version import __version__
from handover_marl.visualization.replay_recorder import ReplayRecorder
from handover_marl.visualization.replay_scene import build_replay_page


def format_replay_facts(config: EvaluationConfig, models: str) -> str:
    """Return one line of text on data, policies and simulation of a replayed episode, for its page.

    Args:
        config: Resolved configuration of the evaluation.
        models: Description of substitutes for HandoverSim's models; empty without any.
    """
    receiver, giver = require_policy_reference(config.receiver), require_policy_reference(config.giver)
    camera = config.wrist_camera.describe(receiver.obs_mode, config.physics)
    observation = f" (obs_mode {receiver.obs_mode}, {camera})" if camera else ""
    parts = [
        format_dataset_title(config.dataset) + (f", {models}" if models else ""),
        f"receiver {receiver.label}{observation}, giver {giver.label}",
        f"{config.physics} physics",
        f"robot {config.robot}",
        f"seed {config.seed}",
        f"handover_marl {__version__}",
    ]
    return "; ".join(parts)


class ReplayWriter(EpisodeWriter):
    """Writer of a replay page for each episode, or for each failed episode.

    Args:
        folder: Result folder of the evaluation.
        replays: Episodes with a page, "all" or "failed".

    Raises:
        ResultsError: The folder for the pages cannot be created.
    """

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

    def get_path(self, result: EpisodeResult) -> Path:
        """Return the path of an episode's replay page, which is named after the scene: `episodes/209.html`."""
        return self.path / f"{result.scene_id or 0:03d}.html"
