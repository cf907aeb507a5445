"""Comparison of two evaluations of the same scenes."""

import functools
import os
from dataclasses import dataclass, replace

from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.report import Report, load_report
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    EARLY_GRAB,
    FLUENCY,
    LATE,
    REPORTED_STATUSES,
    SCENE_HEADER,
    ReportTable,
    TabularResult,
    build_fluency_table,
    count_status,
    estimate_average_success,
    estimate_mean,
    estimate_paired_difference,
    estimate_rate,
    format_percent_rate,
    format_scene_cells,
)
from handover_marl.evaluation.results import EpisodeResult

# Cells of a scene that identify it, and its outcome and steps.
_SCENE, _OUTCOME = slice(0, 2), slice(4, 6)
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
    def pairs(self) -> list[tuple[EpisodeResult, EpisodeResult]]:
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
        names, changes = self.names, self._build_difference_table()
        n_same = len(self.pairs) - len(changes.rows)
        rate = estimate_rate(n_same, len(self.pairs))
        times = [report.metadata.inference_time or "0 (the person waits)" for report in (self.first, self.second)]
        return [
            f"{names[0]}: {self.first.heading}\n{names[1]}: {self.second.heading}",
            "" if times[0] == times[1] else f"Inference time differs: {times[0]} and {times[1]}.",
            _NOTE.format(n=len(self.pairs)),
            self._build_rate_table(),
            f"{n_same} of {len(self.pairs)} scenes have the same outcome: {rate.format('.2f', '.1f')} %.",
            changes,
            self._build_fluency_table(),
        ]

    def _build_rate_table(self) -> ReportTable:
        """Build the table of outcome rates and AS of both evaluations, and of their differences, first minus second."""
        (first, second), n, sides = self.names, len(self.pairs), list(zip(*self.pairs, strict=True))
        rows: list[list[object]] = []
        for flag in REPORTED_STATUSES:
            cells = [format_percent_rate(count_status(side, flag), n, digits=2) for side in sides]
            difference = estimate_paired_difference(*([bool(each.status & flag) for each in side] for side in sides))
            rows.append([flag.label, *cells, difference.format("+.2f")])
        scores = [[result.speed_score for result in side] for side in sides]
        gain = estimate_mean([one - other for one, other in zip(*scores, strict=True)])
        if scores[0] == scores[1]:
            # The bootstrap has no width; the interval is then that of the difference of the success rates.
            successes = ([result.success for result in side] for side in sides)
            gain = replace(gain, interval_95=estimate_paired_difference(*successes).interval_95)
        means = [estimate_average_success(side).format(".2f", ".1f") for side in scores]
        rows.append([AVERAGE_SUCCESS.key, *means, gain.format("+.2f", "+.1f")])
        titles = [f"{first} %", f"{second} %", f"{first} minus {second}, points"]
        return ReportTable(["metric", *titles], rows)

    def _build_difference_table(self) -> ReportTable:
        """Build the table of scenes with different outcomes."""
        rows = []
        for first, second in self.pairs:
            if first.status != second.status:
                cells, others = format_scene_cells(first), format_scene_cells(second)
                outcomes = zip(cells[_OUTCOME], others[_OUTCOME], strict=True)
                rows.append([*cells[_SCENE], *(cell for pair in outcomes for cell in pair)])
        titles = [f"{name} {title}" for title in SCENE_HEADER[_OUTCOME] for name in self.names]
        return ReportTable([*SCENE_HEADER[_SCENE], *titles], rows, n_keys=2)

    def _build_fluency_table(self) -> ReportTable:
        """Build the table of mean differences of fluency metrics, each on the scenes where both evaluations have it."""
        known = [(one.fluency, other.fluency) for one, other in self.pairs if one.fluency and other.fluency]
        means = {}
        for column in FLUENCY if known else ():
            values = [(getattr(one, column.key), getattr(other, column.key)) for one, other in known]
            means[column.key] = estimate_mean([float(one - two) for one, two in values if None not in (one, two)])
        times = [(one.late_s, two.late_s) for one, two in self.pairs]
        if late := [one - two for one, two in times if one is not None and two is not None]:
            means[LATE.key] = estimate_mean(late)
        grabs = [(one.early_grab, two.early_grab) for one, two in self.pairs]
        if known_grabs := [(one, two) for one, two in grabs if one is not None and two is not None]:
            means[EARLY_GRAB.key] = estimate_paired_difference(*map(list, zip(*known_grabs, strict=True)))
        return build_fluency_table(means, " minus ".join(self.names))


def compare(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> Comparison:
    """Compare two evaluations scene by scene, on the scenes that both have.

    Args:
        first: Evaluation A: a result folder, also HandoverSim's, or a file of outcomes (`docs/results/data/episodes`).
        second: Evaluation B, of the same setup, split and dataset, in one of the same forms.

    Raises:
        ResultsError: A folder or file is not readable, or the two cannot be compared: different setups, splits or
            datasets, no common scene, or different data (checked if both have the same version).
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
    for one, two in comparison.pairs:
        if None not in (one.scene_id, two.scene_id) and one.scene_id != two.scene_id:
            raise ResultsError(
                f"{first} and {second} must have the same scenes, got scenes {one.scene_id} and {two.scene_id} as "
                f"number {one.index}"
            )
    # Versions may compute fingerprints of the same data differently; the heading shows both versions.
    is_same_version = report.metadata.version == other.metadata.version
    for one, two in comparison.pairs if is_same_version else ():
        if one.fingerprint and two.fingerprint and one.fingerprint != two.fingerprint:
            raise ResultsError(f"{first} and {second} were computed from different data (scene {one.scene_id})")
    return comparison
