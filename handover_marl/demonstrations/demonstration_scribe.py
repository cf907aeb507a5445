"""Recording an episode while it is played."""

from dataclasses import dataclass

import numpy as np

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.scribes import Scribe
from handover_marl.demonstrations.demonstration import Demonstration, EpisodeFacts
from handover_marl.demonstrations.episode_groups import episode_file
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import ALL, Observation, as_receiver
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.episode.watchers import Decision
from handover_marl.policies.policy import Policy
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.run import Run


@dataclass(frozen=True)
class Shown:
    """What a data set shows of every moment, whatever the receiver that is recorded looks at.

    Attributes:
        sight: "points", "clouds", "images" or None; see `handover_marl.episode.sight.sight_space`.
        observe: "all", or "sight": proprioception and sight alone.
        successes: Whether only successes are kept.
    """

    sight: str | None = None
    observe: str = ALL
    successes: bool = False

    def __call__(self, run: Run, receiver: Policy) -> "DemonstrationScribe":
        """Who records a run so."""
        return DemonstrationScribe(self, run)


class DemonstrationScribe(Scribe):
    """Keeps what is seen and done at every decision.

    Args:
        shown: What to show.
        run: What is played, resolved.
    """

    def __init__(self, shown: Shown, run: Run) -> None:
        self._shown, self._run = shown, run
        self._clear()

    def started(self, episode: Episode) -> None:
        """Forget the last episode."""
        self._clear()

    def decided(self, episode: Episode, decision: Decision) -> None:
        """Note who was asked, what there was to see, and what they do."""
        if decision.robot_asked:
            self._see(episode)
            self._actions.append(decision.robot.copy())
        if decision.giver_asked:
            self._giver_steps.append(episode.steps)
            self._giver_actions.append(decision.giver.copy())

    def ended(self, episode: Episode) -> None:
        """Note what there is to see at the end."""
        if self._wanted(episode.status):
            self._see(episode)

    def written(self, result: EpisodeResult) -> bytes:
        """The file of the episode; empty if it is not to be kept."""
        return episode_file(self._demonstration(result)) if self._wanted(result.status) else b""

    def _wanted(self, status: EpisodeStatus) -> bool:
        return status == EpisodeStatus.SUCCESS or not self._shown.successes

    def _see(self, episode: Episode) -> None:
        seen = {name: value.copy() for name, value in episode.observe().items()}
        self._seen.append(as_receiver(seen, episode.observe_sight(self._shown.sight), self._shown.observe))
        self._steps.append(episode.steps)

    def _demonstration(self, result: EpisodeResult) -> Demonstration:
        last = np.arange(len(self._actions)) == len(self._actions) - 1
        ended = bool(result.status & ~EpisodeStatus.TIMEOUT)
        return Demonstration(
            observations={name: np.stack([seen[name] for seen in self._seen]) for name in self._seen[0]},
            actions=np.stack(self._actions),
            rewards=(last & result.success).astype(np.float64),
            terminations=last & ended,
            # As environments tell it: an end by contact or drop in the last moment is one of these, too.
            truncations=last & bool(result.status & EpisodeStatus.TIMEOUT),
            steps=np.array(self._steps, dtype=np.int64),
            giver_steps=np.array(self._giver_steps, dtype=np.int64),
            giver_actions=np.array(self._giver_actions, dtype=np.float32).reshape(-1, GIVER_ACTION_SIZE),
            facts=EpisodeFacts.of(result, self._run),
        )

    def _clear(self) -> None:
        self._seen: list[Observation] = []
        self._steps: list[int] = []
        self._actions: list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]] = []
        self._giver_steps: list[int] = []
        self._giver_actions: list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]] = []
