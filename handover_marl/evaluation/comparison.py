"""Comparison of two evaluations of the same scenes: of two result folders, or of two physics engines."""

import functools
import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.errors import ResultsError, check_name
from handover_marl.evaluation.benchmark import run_evaluations
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, ExecutionConfig, build_configs
from handover_marl.evaluation.reports.episode_tables import (
    EpisodePair,
    build_difference_table,
    build_fluency_difference_table,
    build_rate_table,
)
from handover_marl.evaluation.reports.report import Report, evaluate
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult, estimate_rate
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.engines import EXACT, FAST, PHYSICS, check_physics

AGREEMENT_FILE = "agreement.md"
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
        times = [report.metadata.inference_time or "0 (the person waits)" for report in (self.first, self.second)]
        return [
            f"{names[0]}: {self.first.heading}\n{names[1]}: {self.second.heading}",
            "" if times[0] == times[1] else f"Inference time differs: {times[0]} and {times[1]}.",
            _NOTE.format(n=len(self.pairs)),
            build_rate_table(self.pairs, names),
            changes,
            "" if changes.rows else "Every scene has the same outcome.",
            build_fluency_difference_table(self.pairs, names),
        ]


class Agreement(Comparison):
    """Comparison of the same policies in exact physics (`first`) and in another physics (`second`)."""

    def write(self, folder: Path) -> None:
        """Write the comparison of two physics engines to `agreement.md`.

        Raises:
            ResultsError: The folder cannot be written.
        """
        write_atomically(folder / AGREEMENT_FILE, f"# Exact and {self.second.metadata.physics} physics\n\n{self}\n")

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables of pairs of outcomes and of rates, numbers of steps, and scenes that differ."""
        metadata, n, name = self.first.metadata, len(self.pairs), self.second.metadata.physics
        counts = Counter((exact.status.label, other.status.label) for exact, other in self.pairs)
        labels = sorted({label for pair in counts for label in pair})
        rows = [[f"exact: {exact}", *(counts[exact, other] for other in labels)] for exact in labels]
        steps = [abs(other.steps - exact.steps) for exact, other in self.pairs if exact.status == other.status]
        sentence = ""
        if steps:
            median, percentile = np.percentile(steps, [50, 95])
            sentence = (
                f"Of the scenes with the same outcome, {steps.count(0) / len(steps):.0%} have the same number of "
                f"steps. The numbers of steps (ms) differ by {median:g} in the median, by {percentile:g} or less in "
                f"95 %, and by {max(steps)} at most."
            )
        return [
            f"{metadata.setup} {metadata.split}, {self.first.extent}. Receiver {self.first.policies_label}, "
            f"data: {self.first.data_label}.\n"
            f"Exact and {name} physics agree on the outcome of {len(steps)} of {n} "
            f"scenes: {100 * len(steps) / n:.2f} % (95 % interval {estimate_rate(len(steps), n).format_interval()}).",
            ReportTable(["n episodes", *(f"{name}: {label}" for label in labels)], rows),
            build_rate_table([(other, exact) for exact, other in self.pairs], (name, EXACT)),
            sentence,
            build_difference_table(self.pairs, (EXACT, name)),
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
    report, other = evaluate(first), evaluate(second)
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


@forward_signature(EvaluationConfig, ExecutionConfig)
def compare_physics(
    setup: str | EvaluationConfig | None = None,
    split: str = "val",
    receiver: PolicyLike = "yang2021",
    giver: PolicyLike = REPLAY,
    against: str = FAST,
    execution: ExecutionConfig | None = None,
    **options: Any,
) -> Agreement:
    """Compare outcomes of two physics engines on the same scenes.

    Args:
        setup: Official setup, "s0" to "s3", or one of other data; or a whole `handover_marl.EvaluationConfig`, whose
            physics is ignored.
        split: "train", "val" or "test".
        receiver: The robot's policy, as for `benchmark`.
        giver: The person's policy, as for `evaluate_pair`.
        against: The physics to compare with exact physics, "fast" or "mujoco".
        execution: Execution settings. The output folder gets the result folders `exact` and, for
            instance, `fast`, and `agreement.md`.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        UnknownNameError: Unknown physics.
        HandoverError: The same errors as `evaluate_pair`.
    """
    check_name("physics to compare with exact", against, [physics for physics in PHYSICS if physics != EXACT])
    check_physics(against)
    config, execution = build_configs(setup, options, execution, split=split, receiver=receiver, giver=giver)
    parts = [(physics, replace(config, physics=physics)) for physics in (EXACT, against)]
    result = Agreement(*run_evaluations(parts, execution))
    if execution.folder is not None:
        result.write(execution.folder)
    return result
