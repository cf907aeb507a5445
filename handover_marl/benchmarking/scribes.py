"""What is kept of episodes beside their results: who puts them into writing, and where that is kept."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.episode.watchers import Watcher
from handover_marl.policies.policy import Policy
from handover_marl.run import Run


class Scribe(Watcher, ABC):
    """Looks on and puts episodes into writing, in the process that plays them."""

    @abstractmethod
    def written(self, result: EpisodeResult) -> bytes:
        """What there is to keep of the episode that has just ended.

        Args:
            result: Its outcome.
        """


#: Makes a scribe for a run that was resolved and the receiver that plays it; it is sent to worker processes.
ScribeMaker: TypeAlias = Callable[[Run, Policy], Scribe]


class Shelf(ABC):
    """Where the one process that plays nothing, or everything, keeps what scribes write."""

    @property
    @abstractmethod
    def scribe(self) -> ScribeMaker:
        """Who writes."""

    @abstractmethod
    def described(self, run: Run) -> str:
        """What is kept, in words; episodes of which something else is kept never share a folder."""

    @abstractmethod
    def open(self, folder: Path, run: Run, fresh: bool) -> None:
        """Make ready in a result folder.

        Args:
            folder: The folder; it belongs to this run.
            run: What is run, resolved.
            fresh: Whether to remove what an earlier run left.

        Raises:
            ResultsError: What is there cannot be used.
        """

    @abstractmethod
    def has(self, result: EpisodeResult) -> bool:
        """Whether what is to be kept of a finished episode is there; if not, it is played again."""

    @abstractmethod
    def keep(self, result: EpisodeResult, written: bytes) -> None:
        """Keep what was written about an episode.

        Raises:
            ResultsError: It cannot be written.
        """
