"""Comparison of two evaluations of the same scenes."""

import functools
import os
from dataclasses import dataclass

from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.episode_tables import (
    EpisodePair,
    build_difference_table,
    build_fluency_difference_table,
    build_rate_table,
)
from handover_marl.evaluation.reports.report import Report, load_report
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult, estimate_rate

_NOTE = (
    "{n} scenes that both folders have, paired. 95 % intervals: Wilson; differences of rates Agresti and Min; AS and "
    "fluency metrics bootstrap."
)


@dataclass(frozen=True)
class Comparison(TabularResult):
    """Two evaluations on their common scenes. `str(comparison)` is tables in Markdown.

    Attributes:
        first: Report of evaluation A.
        second: Report of evaluation B.
    """

    first: Report
    second: Report

    @functools.cached_property
    def pairs(self) -> list[EpisodePair]:
        """Results of each common scene in `first` and in `second`, in the split's order."""
        by_index = {result.index: result for result in self.second.episodes}
        return [(result, by_index[result.index]) for result in self.first.episodes if result.index in by_index]

    @property
    def names(self) -> tuple[str, str]:
        """Names of the evaluations in tables: receivers if these differ, else givers, else physics, else A and B."""
        sides = [
            [report.metadata.receiver, report.metadata.giver, report.metadata.physics]
            for report in (self.first, self.second)
        ]
        return next((pair for pair in zip(*sides, strict=True) if pair[0] != pair[1]), ("A", "B"))

    def build_sections(self) -> list[str | ReportTable]:
        """Build headings, note and tables: rates, scenes with different outcomes, and fluency metrics."""
        names, changes = self.names, build_difference_table(self.pairs, self.names)
        n_same = len(self.pairs) - len(changes.rows)
        rate = estimate_rate(n_same, len(self.pairs))
        times = [report.metadata.inference_time or "0 (the person waits)" for report in (self.first, self.second)]
        return [
            f"{names[0]}: {self.first.heading}\n{names[1]}: {self.second.heading}",
            "" if times[0] == times[1] else f"Inference time differs: {times[0]} and {times[1]}.",
            _NOTE.format(n=len(self.pairs)),
            build_rate_table(self.pairs, names),
            f"{n_same} of {len(self.pairs)} scenes have the same outcome: {rate.format('.2f', '.1f')} %.",
            changes,
            build_fluency_difference_table(self.pairs, names),
        ]


def compare(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> Comparison:
    """Compare two evaluations scene by scene, given their result folders (also HandoverSim's) or episode files.

    Args:
        first: Result folder or episode file A.
        second: Result folder or episode file B, of the same setup, split and dataset.

    Raises:
        ResultsError: A folder or file is not readable, or the folders cannot be compared: other splits or
            datasets, no common scene, or different data (checked within one version).
    """
    report, other = load_report(first), load_report(second)
    for key in ("setup", "split", "dataset"):
        values = [getattr(each.metadata, key) for each in (report, other)]
        if values[0] != values[1]:
            raise ResultsError(f"{first} and {second} must have the same {key}, got {values[0]} and {values[1]}")
    comparison = Comparison(report, other)
    if not comparison.pairs:
        raise ResultsError(
            f"{first} and {second} must have at least one scene in common; compare folders of the same split"
        )
    # Versions may compute fingerprints of the same data differently; the heading shows both versions.
    is_same_version = report.metadata.version == other.metadata.version
    for one, two in comparison.pairs if is_same_version else ():
        if one.fingerprint and two.fingerprint and one.fingerprint != two.fingerprint:
            raise ResultsError(f"{first} and {second} were computed from different data (scene {one.scene_id})")
    return comparison
