"""Two result folders side by side, paired by scene, without playing anything."""

import os
from dataclasses import dataclass

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.evaluation import evaluate
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.statistics import paired_difference
from handover_marl.benchmarking.tables import (
    NO_VALUE,
    RATES,
    Grid,
    heading,
    percent_gain,
    percent_mean,
    percent_rate,
    table,
)
from handover_marl.errors import ResultsError
from handover_marl.protocol.status import EpisodeStatus


@dataclass(frozen=True)
class Comparison:
    """Reports on scenes that both have. `str(comparison)` is the tables.

    Attributes:
        first: What is compared.
        second: With what.
        pairs: The results of each scene that both have, in the split's order.
    """

    first: Report
    second: Report
    pairs: tuple[tuple[EpisodeResult, EpisodeResult], ...]

    def difference(self, flag: EpisodeStatus = EpisodeStatus.SUCCESS) -> tuple[float, float, float]:
        """How much more often the first ends so than the second: mean and 95 % interval (-1..1)."""
        return paired_difference(
            *([bool(result.status & flag) for result in side] for side in zip(*self.pairs, strict=True))
        )

    def __str__(self) -> str:
        parts = [
            f"A: {heading(self.first)}\nB: {heading(self.second)}",
            self.note(),
            str(self.rates()),
            self._changes(),
        ]
        return "\n\n".join(part for part in parts if part)

    def note(self) -> str:
        """How many scenes are compared, and which intervals are told."""
        return (
            f"{len(self.pairs)} scenes that both have, paired. 95 % intervals: Wilson; differences Agresti and "
            "Min; AS bootstrap."
        )

    def changes(self) -> list[tuple[EpisodeResult, EpisodeResult]]:
        """The pairs that ended differently."""
        return [(first, second) for first, second in self.pairs if first.status != second.status]

    def rates(self) -> Grid:
        """How often each ended how, and the differences."""
        n, rows = len(self.pairs), []
        for flag in RATES:
            counts = [sum(bool(pair[side].status & flag) for pair in self.pairs) for side in (0, 1)]
            cells = [percent_rate(count, n, digits=2) for count in counts]
            rows.append([flag.label, *cells, percent_gain(self.difference(flag), digits=2)])
        scores = [[result.speed_score for result in side] for side in zip(*self.pairs, strict=True)]
        gains = [first - second for first, second in zip(*scores, strict=True)]
        rows.append(["AS", *map(percent_mean, scores), percent_mean(gains, signed=True)])
        return Grid(["%", "A", "B", "A less B, points"], rows)

    def _changes(self) -> str:
        rows = [
            [
                NO_VALUE if first.scene_id is None else first.scene_id,
                first.object_name or NO_VALUE,
                first.status.label,
                first.steps,
                second.status.label,
                second.steps,
            ]
            for first, second in self.changes()
        ]
        return table(["scene", "object", "A", "steps", "B", "steps"], rows) if rows else "Every scene ended alike."


def compare(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> Comparison:
    """Compare two official result folders, ours or the original authors', scene by scene.

    Args:
        first: A result folder.
        second: Another one, of the same setup, split and data.

    Raises:
        ResultsError: One is no result folder, or they cannot be compared: other splits or datasets, no scene in common,
            or, as far as results of one version tell, other data.
    """
    one, other = evaluate(first), evaluate(second)
    for key in ("setup", "split", "dataset"):
        values = [getattr(report.settings, key) for report in (one, other)]
        if values[0] != values[1]:
            raise ResultsError(f"{first} and {second} are of different {key}s ({values[0]}, {values[1]})")
    there = {result.index: result for result in other.episodes}
    pairs = tuple((result, there[result.index]) for result in one.episodes if result.index in there)
    if not pairs:
        raise ResultsError(f"{first} and {second} have no scene in common")
    # Versions may take the fingerprint of the same data otherwise; the heading tells both.
    same_version = one.settings.version == other.settings.version
    for mine, theirs in pairs if same_version else ():
        if mine.fingerprint and theirs.fingerprint and mine.fingerprint != theirs.fingerprint:
            raise ResultsError(f"{first} and {second} were made from different data (scene {mine.scene_id})")
    return Comparison(one, other, pairs)
