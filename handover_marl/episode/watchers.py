"""What looks on while an episode is played: results, metrics and films are made by watchers, which one may omit."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF

if TYPE_CHECKING:
    from handover_marl.episode.episode import Episode


@dataclass(frozen=True, eq=False)
class Decision:
    """What the policies were asked before some physics steps.

    Attributes:
        robot: (9,) the receiver's action.
        giver: (8,) the giver's action.
        seconds: Wall-clock time that the receiver took (s); 0 where its last action stood.
        robot_asked: Whether the receiver was asked just now, rather than its last action standing.
        giver_asked: Likewise; a giver that only replays is never asked.
        drawing: Wall-clock time that it took to draw what the receiver was shown (s), which `seconds` leaves out.
    """

    robot: npt.NDArray[np.float32]
    giver: npt.NDArray[np.float32]
    seconds: float
    robot_asked: bool
    giver_asked: bool
    drawing: float


class Watcher:
    """Looks on and changes nothing. Override what is of interest."""

    def started(self, episode: "Episode") -> None:
        """The episode is at the start of its scene."""

    def decided(self, episode: "Episode", decision: Decision) -> None:
        """The policies have been asked, and are about to act."""

    def stepped(self, episode: "Episode") -> None:
        """A physics step has been simulated and judged."""

    def ended(self, episode: "Episode") -> None:
        """No more is played."""


class ActionLog(Watcher):
    """Keeps what official result files hold: the receiver's action and time for every physics step.

    Attributes:
        actions: (T, 9) float32, once the episode has ended.
        times: (T,) wall-clock time of the receiver (s), zero at steps where it was not asked; likewise.
    """

    actions: npt.NDArray[np.float32]
    times: npt.NDArray[np.float64]

    def started(self, episode: "Episode") -> None:
        """Forget the last episode."""
        self._decisions: list[tuple[int, Decision]] = []

    def decided(self, episode: "Episode", decision: Decision) -> None:
        """Note when what was decided."""
        self._decisions.append((episode.steps, decision))

    def ended(self, episode: "Episode") -> None:
        """Spread decisions over the steps that they stood for."""
        self.actions = np.zeros((episode.steps, PANDA_DOF), dtype=np.float32)
        self.times = np.zeros(episode.steps)
        ends = [step for step, _ in self._decisions[1:]] + [episode.steps]
        for (step, decision), end in zip(self._decisions, ends, strict=True):
            self.actions[step:end] = decision.robot
            self.times[step] = decision.seconds
