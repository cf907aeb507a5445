"""Comparison of two evaluations, paired by scene."""

import os
from collections.abc import Mapping
from dataclasses import dataclass

from handover_marl import __version__
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.fluency_tables import build_fluency_difference_table
from handover_marl.evaluation.reports.pair_tables import (
    build_difference_table,
    build_rate_table,
    compute_rate_difference,
)
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.visualization.web_page import render_page

_NOTE = (
    "{n} scenes that both folders have, paired. 95 % intervals: Wilson; differences of rates Agresti and Min; AS and "
    "fluency metrics bootstrap."
)


@dataclass(frozen=True)
class Comparison(TabularResult):
    """Two evaluations, A and B, on their common scenes. `str(comparison)` is tables in Markdown.

    Attributes:
        first: Report of evaluation A.
        second: Report of evaluation B.
        pairs: Results (A, B) of each common scene, in the split's order.
    """

    first: Report
    second: Report
    pairs: tuple[tuple[EpisodeResult, EpisodeResult], ...]

    @property
    def note(self) -> str:
        """Sentences on the number of compared scenes and the kinds of confidence intervals."""
        return _NOTE.format(n=len(self.pairs))

    @property
    def changes(self) -> list[tuple[EpisodeResult, EpisodeResult]]:
        """Pairs of results (A, B) of the scenes with different outcomes."""
        return [(first, second) for first, second in self.pairs if first.status != second.status]

    def compute_difference(self, flag: EpisodeStatus = EpisodeStatus.SUCCESS) -> tuple[float, float, float]:
        """Compute the difference of an outcome's rates, A minus B, with its 95 % interval (-1..1).

        Args:
            flag: Outcome whose rates are compared.
        """
        first, second = zip(*self.pairs, strict=True)
        return compute_rate_difference(first, second, flag)

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of rates in A and B, of scenes with different outcomes, and of fluency metrics."""
        names = ("A", "B")
        builders = (build_rate_table, build_difference_table, build_fluency_difference_table)
        return [build(self.pairs, names) for build in builders]

    def build_sections(self) -> list[str | ReportTable]:
        """Build headings, note and tables."""
        headings = f"A: {self.first.heading}\nB: {self.second.heading}"
        rates, differences, fluency = self.build_tables()
        changes = differences if differences.rows else "Every scene has the same outcome."
        return [headings, self.note, rates, changes, fluency]


def compare(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> Comparison:
    """Compare two official result folders, of this library or of HandoverSim, or episode files, scene by scene.

    Args:
        first: Result folder or episode file A.
        second: Result folder or episode file B, of the same setup, split and dataset.

    Raises:
        ResultsError: A folder or file is not readable, or the folders cannot be compared: other splits or
            datasets, no common scene, or different data (checked within one version).
    """
    report, other = evaluate(first), evaluate(second)
    for key in ("setup", "split", "dataset"):
        values = [getattr(each.metadata, key) for each in (report, other)]
        if values[0] != values[1]:
            raise ResultsError(f"{first} and {second} must have the same {key}, got {values[0]} and {values[1]}")
    by_index = {result.index: result for result in other.episodes}
    pairs = tuple((result, by_index[result.index]) for result in report.episodes if result.index in by_index)
    if not pairs:
        raise ResultsError(
            f"{first} and {second} must have at least one scene in common; compare folders of the same split"
        )
    # Versions may compute fingerprints of the same data differently; the heading shows both versions.
    is_same_version = report.metadata.version == other.metadata.version
    for one, two in pairs if is_same_version else ():
        if one.fingerprint and two.fingerprint and one.fingerprint != two.fingerprint:
            raise ResultsError(f"{first} and {second} were computed from different data (scene {one.scene_id})")
    return Comparison(report, other, pairs)


def render_comparison_page(
    comparison: Comparison, replays: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {})
) -> str:
    """Render a comparison as a self-contained web page.

    Args:
        comparison: The comparison.
        replays: Links to replay pages of A and of B by scene number, relative to the page.
    """
    names = [report.metadata.receiver for report in (comparison.first, comparison.second)]
    return render_page(
        "comparison.html",
        version=__version__,
        title=f"{names[0]} (A) and {names[1]} (B)",
        sides=[("A", comparison.first.heading), ("B", comparison.second.heading)],
        rates=comparison.build_tables()[0],
        note=comparison.note,
        changes=comparison.changes,
        replays=replays,
    )
