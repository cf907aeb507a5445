"""Curve of the reward terms of a training: their means over episodes, as a table."""

import csv
import io
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from handover_marl.envs.wrappers.episode_returns import RETURN_PREFIX
from handover_marl.errors import ResultsError
from handover_marl.execution.files import write_atomically
from handover_marl.execution.reading import read_plain_file


@dataclass(frozen=True)
class TermPoint:
    """Mean of a reward term over the training episodes that ended since the previous point.

    Attributes:
        steps: Number of decisions of the learning agent so far.
        agent: Agent that the term rewards, "giver" or "receiver".
        term: Name of the term.
        mean: Mean over episodes of the term's undiscounted sum over an episode, weights included.
        episodes: Number of episodes.
    """

    steps: int
    agent: str
    term: str
    mean: float
    episodes: int


class RewardCurve:
    """Means of the reward terms over training episodes, in the file `reward_terms.csv`.

    Args:
        path: File to write.
        resume: Whether to continue the points of the file.

    Attributes:
        points: Points so far.

    Raises:
        ResultsError: The file to continue is not such a table.
    """

    def __init__(self, path: Path, resume: bool = False) -> None:
        self.path = path
        self.points: list[TermPoint] = _read_points(path) if resume and path.exists() else []
        self._sums: dict[tuple[str, str], list[float]] = defaultdict(list)

    def add_episode(self, agent: str, info: Mapping[str, Any]) -> None:
        """Add an episode that has ended.

        Args:
            agent: Agent that learns.
            info: Last info of this agent, with the sums that `EpisodeReturns` adds (`return/NAME`).
        """
        for key, value in info.items():
            if key.startswith(RETURN_PREFIX):
                self._sums[agent, key[len(RETURN_PREFIX) :]].append(float(value))

    def add_batch(self, agent: str, infos: Mapping[Any, Any], ended: Any) -> None:
        """Add the episodes that have ended in a batch of transitions.

        Args:
            agent: Agent that learns.
            infos: Tensors of infos after each transition by name, with n numbers each.
            ended: (n,) tensor, whether an episode ended with a transition.
        """
        names = [key for key in infos.keys() if key.startswith(RETURN_PREFIX)]  # noqa: SIM118, a TensorDict iterates over rows
        columns = [infos[name].flatten()[ended].tolist() for name in names]
        for values in zip(*columns, strict=True):
            self.add_episode(agent, dict(zip(names, values, strict=True)))

    def write_point(self, decisions: int) -> dict[str, float]:
        """Write the means over the episodes since the last call; return them by `agent/NAME`.

        Args:
            decisions: Number of decisions of the learning agent so far.
        """
        new = [
            TermPoint(decisions, agent, term, sum(values) / len(values), len(values))
            for (agent, term), values in self._sums.items()
        ]
        self._sums.clear()
        if new:
            self.points += new
            stream = io.StringIO()
            writer = csv.DictWriter(stream, [part.name for part in fields(TermPoint)], lineterminator="\n")
            writer.writeheader()
            writer.writerows(asdict(point) for point in self.points)
            write_atomically(self.path, stream.getvalue())
        return {f"{point.agent}/{point.term}": point.mean for point in new}

    def discard_points_after(self, decisions: int) -> None:
        """Discard points after a number of decisions; a resumed run repeats them."""
        self.points = [point for point in self.points if point.steps <= decisions]


def _read_points(path: Path) -> list[TermPoint]:
    try:
        rows = csv.DictReader(io.StringIO(read_plain_file(path).decode(), newline=""))
        return [
            TermPoint(int(row["steps"]), row["agent"], row["term"], float(row["mean"]), int(row["episodes"]))
            for row in rows
        ]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise ResultsError(
            f"{path}: not a table of reward terms ({type(error).__name__}: {error}); remove it to resume without it"
        ) from error
