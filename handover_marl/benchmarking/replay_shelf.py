"""Replays in a result folder: pages that play single episodes in three dimensions, `episodes/209.html`."""

import html
from dataclasses import dataclass
from pathlib import Path

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.results import replay_path
from handover_marl.benchmarking.scribes import Scribe, ScribeMaker, Shelf
from handover_marl.errors import OptionError, ResultsError, UnknownNameError
from handover_marl.files import remove_abandoned, write_atomically
from handover_marl.pictures.replay_page import episode_mark, replay_facts, replay_page
from handover_marl.pictures.replay_recorder import ReplayRecorder
from handover_marl.pictures.replay_stage import check_replay
from handover_marl.policies.policy import Policy
from handover_marl.run import EVERY, NO_REPLAYS, REPLAYS, Execution, Run

_HEAD = 1000  # bytes of a page within which it says which episode it shows


def replay_shelves(execution: Execution) -> list[Shelf]:
    """Where the replays that are wanted go; nothing if none are.

    Raises:
        UnknownNameError: There is no such choice of episodes.
        OptionError: There is no folder for them, or the extra `replay` is not installed.
    """
    if execution.replays not in REPLAYS:
        raise UnknownNameError("replays", execution.replays, REPLAYS)
    if execution.replays == NO_REPLAYS:
        return []
    if execution.folder is None:
        raise OptionError("replays need a folder: give one as out= (--out DIR)")
    check_replay()
    return [ReplayShelf(_Wanted(execution.replays == EVERY))]


@dataclass(frozen=True)
class _Wanted:
    """Which episodes there are replays of: all, or failed ones."""

    every: bool

    def __call__(self, run: Run, receiver: Policy) -> "ReplayScribe":
        """Who makes them."""
        return ReplayScribe(self, run, receiver)

    def of(self, result: EpisodeResult) -> bool:
        """Whether there is to be one of this episode."""
        return self.every or not result.success


class ReplayScribe(ReplayRecorder, Scribe):
    """Makes the page of an episode.

    Args:
        wanted: Of which.
        run: What is played, resolved.
        receiver: The robot's policy.
    """

    def __init__(self, wanted: _Wanted, run: Run, receiver: Policy) -> None:
        super().__init__(receiver)
        self._wanted, self._run = wanted, run

    def written(self, result: EpisodeResult) -> bytes:
        """The page; empty if there is to be none."""
        if not self._wanted.of(result):
            return b""
        return replay_page(self.log, replay_facts(self._run, result.models or "")).encode()


class ReplayShelf(Shelf):
    """Keeps replays.

    Args:
        wanted: Of which episodes.
    """

    def __init__(self, wanted: _Wanted) -> None:
        self._wanted = wanted

    @property
    def scribe(self) -> ScribeMaker:
        """Who makes them."""
        return self._wanted

    def described(self, run: Run) -> str:
        """Nothing: results with and without replays are the same."""
        return ""

    def open(self, folder: Path, run: Run, fresh: bool) -> None:
        """As `Shelf.open`; replays of an earlier run are cleared with its results."""
        self._folder = folder
        try:
            replay_path(folder, 0).parent.mkdir(exist_ok=True)
            remove_abandoned(replay_path(folder, 0).parent)
        except OSError as error:
            raise ResultsError(f"cannot use {folder} for replays: {error.strerror or error}") from error

    def has(self, result: EpisodeResult) -> bool:
        """Whether the replay of this very episode is there, or none is wanted."""
        if not self._wanted.of(result):
            return True
        if result.scene_id is None:
            return False
        mark = html.escape(episode_mark(result.scene_id, result.status, result.steps))
        try:
            with replay_path(self._folder, result.scene_id).open("rb") as file:
                return mark.encode() in file.read(_HEAD)
        except OSError:
            return False

    def keep(self, result: EpisodeResult, written: bytes) -> None:
        """Write the page of an episode.

        Raises:
            ResultsError: It cannot be written.
        """
        if written and result.scene_id is not None:
            write_atomically(replay_path(self._folder, result.scene_id), written)
