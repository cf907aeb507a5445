"""Agreement of two physics engines: outcomes of the same policies on the same scenes."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from typing_extensions import Unpack

from handover_marl.errors import check_name
from handover_marl.evaluation.benchmark import Evaluation
from handover_marl.evaluation.config import REPLAY, EvaluationConfig, EvaluationOptions, ExecutionConfig, build_configs
from handover_marl.evaluation.reports.pair_tables import build_difference_table, build_rate_table
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult, format_percent_interval
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.engines import EXACT, FAST, PHYSICS, check_physics

AGREEMENT_FILE = "agreement.md"


@dataclass(frozen=True)
class Agreement(TabularResult):
    """Outcomes of the same policies in two physics engines. `str(agreement)` is tables in Markdown.

    Attributes:
        exact: Report in exact physics.
        other: Report of the same scenes in another physics.
    """

    exact: Report
    other: Report

    @property
    def other_physics(self) -> str:
        """Name of the physics that is compared with exact physics."""
        return self.other.metadata.physics

    @property
    def n_same_outcome(self) -> int:
        """Number of scenes with the same outcome in both physics engines."""
        return sum(exact.status == other.status for exact, other in self._pairs)

    @property
    def rate(self) -> float:
        """Share of scenes with the same outcome in both physics engines (0..1)."""
        return self.n_same_outcome / len(self.exact.episodes)

    @property
    def step_differences(self) -> list[int]:
        """Numbers of steps in the other physics minus those in exact physics, for the scenes with equal outcomes."""
        return [other.steps - exact.steps for exact, other in self._pairs if exact.status == other.status]

    @property
    def confusion(self) -> Counter[tuple[str, str]]:
        """Number of scenes for each pair of outcomes (exact physics, other physics)."""
        return Counter((exact.status.label, other.status.label) for exact, other in self._pairs)

    def write(self, folder: Path) -> None:
        """Write the comparison of two physics engines to `agreement.md`.

        Raises:
            ResultsError: The folder cannot be written.
        """
        write_atomically(folder / AGREEMENT_FILE, f"# Exact and {self.other_physics} physics\n\n{self}\n")

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and the sentence on numbers of steps."""
        confusion, rates, differences = self.build_tables()
        return [self._format_heading(), confusion, rates, self._format_step_differences(), differences]

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of pairs of outcomes, of rates, and of scenes with different outcomes."""
        pairs, names = self._pairs, (self.other_physics, EXACT)
        swapped = [(other, exact) for exact, other in pairs]
        return [
            self._build_confusion_table(),
            build_rate_table(swapped, names),
            build_difference_table(pairs, (EXACT, self.other_physics)),
        ]

    @property
    def _pairs(self) -> list[tuple[EpisodeResult, EpisodeResult]]:
        return list(zip(self.exact.episodes, self.other.episodes, strict=True))

    def _format_heading(self) -> str:
        metadata, n = self.exact.metadata, len(self.exact.episodes)
        return (
            f"{metadata.setup} {metadata.split}, {self.exact.extent}. Receiver {self.exact.policies_label}, "
            f"data: {self.exact.data_label}.\n"
            f"Exact and {self.other_physics} physics agree on the outcome of {self.n_same_outcome} of {n} scenes: "
            f"{100 * self.rate:.2f} % (95 % interval {format_percent_interval(self.n_same_outcome, n)})."
        )

    def _build_confusion_table(self) -> ReportTable:
        counts = self.confusion
        labels = sorted({label for pair in counts for label in pair})
        rows = [[f"exact: {exact}", *(counts[exact, other] for other in labels)] for exact in labels]
        return ReportTable(["n episodes", *(f"{self.other_physics}: {label}" for label in labels)], rows)

    def _format_step_differences(self) -> str:
        differences = np.abs(self.step_differences)
        if not len(differences):
            return ""
        median, percentile = np.percentile(differences, [50, 95])
        return (
            f"Of the scenes with the same outcome, {np.mean(differences == 0):.0%} have the same number of steps. The "
            f"numbers of steps (ms) differ by {median:g} in the median, by {percentile:g} or less in 95 %, and by "
            f"{differences.max()} at most."
        )


@forward_signature(EvaluationConfig, ExecutionConfig)
def compare_physics(
    setup: str | EvaluationConfig | None = None,
    split: str = "val",
    receiver: PolicyLike = "yang2021",
    giver: PolicyLike = REPLAY,
    against: str = FAST,
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
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
    others = [physics for physics in PHYSICS if physics != EXACT]
    check_name("physics to compare with exact", against, others)
    check_physics(against)
    config, execution = build_configs(setup, options, execution, split=split, receiver=receiver, giver=giver)
    exact, other = (
        Evaluation(replace(config, physics=physics), execution.for_subfolder(physics)).run()
        for physics in (EXACT, against)
    )
    result = Agreement(exact, other)
    if execution.folder is not None:
        result.write(execution.folder)
    return result
