"""Interface for additional output of an evaluation: one file for each episode."""

from abc import ABC, abstractmethod

from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.policies.policy import Policy


class EpisodeRecorder(EpisodeCallback, ABC):
    """Callback that records an episode while it is simulated and encodes it as one file."""

    @abstractmethod
    def encode(self, result: EpisodeResult) -> bytes:
        """Return the recording of the last episode as bytes; empty if no file is needed.

        Args:
            result: Outcome of that episode.
        """


class EpisodeWriter(ABC):
    """Writer of one file for each episode.

    The main process writes; worker processes hold a pickled copy, which only creates recorders.
    """

    @abstractmethod
    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create the recorder of episodes in one worker process.

        Args:
            config: Resolved configuration of the evaluation.
            receiver: The robot's policy in this process.
        """

    @abstractmethod
    def contains(self, result: EpisodeResult) -> bool:
        """Return whether the file of an episode exists already or is not needed.

        Episodes without their file are simulated again.
        """

    @abstractmethod
    def write(self, result: EpisodeResult, content: bytes) -> None:
        """Write the file of an episode.

        Args:
            result: Outcome of the episode.
            content: Return value of `EpisodeRecorder.encode`.

        Raises:
            ResultsError: The file cannot be written.
        """
