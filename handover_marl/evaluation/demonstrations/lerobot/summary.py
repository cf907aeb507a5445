"""Summary of a data set in LeRobot's format."""

from dataclasses import dataclass
from pathlib import Path

from handover_marl.evaluation.demonstrations.data_card import describe_recording
from handover_marl.evaluation.results.metadata import ResultMetadata


@dataclass(frozen=True)
class LeRobotSummary:
    """Summary of a data set in LeRobot's format that `demonstrate` wrote.

    `lerobot.datasets.lerobot_dataset.LeRobotDataset(repo_id, root=summary.folder)` reads its episodes.

    Attributes:
        folder: Folder of the data set.
        fps: Frames per second.
        total_frames: Number of frames of all episodes.
        evaluation: Identity of the evaluation that was recorded.
        simulated: Number of simulated episodes by outcome.
        recorded: Number of recorded episodes by outcome.
    """

    folder: Path
    fps: int
    total_frames: int
    evaluation: ResultMetadata
    simulated: dict[str, int]
    recorded: dict[str, int]

    @property
    def n_episodes(self) -> int:
        """Number of episodes in the data set."""
        return sum(self.recorded.values())

    def __str__(self) -> str:
        return (
            f"{self.n_episodes} episodes with {self.total_frames} frames at {self.fps} fps of "
            f"{describe_recording(self.evaluation, self.simulated)} LeRobot's format in {self.folder}"
        )
