"""Cross-play: evaluation of every giver with every receiver on the same scenes."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from typing_extensions import Unpack

from handover_marl.datasets import Dataset
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.benchmark import Evaluation
from handover_marl.evaluation.config import EvaluationConfig, EvaluationOptions, ExecutionConfig, build_configs
from handover_marl.evaluation.reports.fluency_tables import (
    FLUENCY_NOTE,
    FLUENCY_UNITS,
    compute_fluency_means,
    format_fluency_header,
    format_fluency_row,
)
from handover_marl.evaluation.reports.report import REPORTED_STATUSES, Report, compute_rate_difference
from handover_marl.evaluation.reports.statistics import compute_mean_interval, compute_wilson_interval
from handover_marl.evaluation.reports.tables import (
    append_interval,
    format_percent_difference,
    format_percent_mean,
    format_percent_rate,
    format_seconds,
    format_table,
    join_sections,
)
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.options import forward_signature, require_modules
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike, PolicyReference, parse_policy

PolicyPair = tuple[str, str]
CROSSPLAY_CSV = "crossplay.csv"


@dataclass(frozen=True, eq=False)
class CrossPlay:
    """Reports of all pairs of giver and receiver on the same scenes. `str` returns Markdown tables.

    Attributes:
        givers: Labels of the givers, the rows of the matrix.
        receivers: Labels of the receivers, the columns of the matrix.
        reports: Report of every (giver, receiver).
    """

    givers: tuple[str, ...]
    receivers: tuple[str, ...]
    reports: dict[PolicyPair, Report]

    @property
    def title(self) -> str:
        """Title of two lines: evaluated scenes, number of episodes and physics."""
        report = self._first_report
        metadata, n = report.metadata, len(report.episodes)
        return (
            f"{metadata.setup} {metadata.split}, {n} episodes a cell\n{report.data_label}, {metadata.physics} physics"
        )

    @property
    def success_rates(self) -> list[list[float]]:
        """Success rates (0..1), one row per giver and one column per receiver."""
        return [[self.reports[giver, receiver].success_rate for receiver in self.receivers] for giver in self.givers]

    def compute_gain(
        self, pair: PolicyPair, baseline: PolicyPair, flag: EpisodeStatus = EpisodeStatus.SUCCESS
    ) -> tuple[float, float, float]:
        """Compute the difference of an outcome's rate between two pairs of policies.

        Args:
            pair: Labels of giver and receiver.
            baseline: Labels of the giver and the receiver whose rate is subtracted.
            flag: Outcome whose rate is compared, e.g. success.

        Returns:
            Difference, lower and upper end of its 95 % interval (-1..1).
        """
        return compute_rate_difference(self.reports[pair].episodes, self.reports[baseline].episodes, flag)

    def to_csv(self) -> str:
        """Return CSV text with one row per pair of policies.

        Rates and intervals are in 0..1, times in s, fluency metrics in the units of
        `FluencyMetrics`.
        """
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            ["giver", "receiver", "setup", "split", "dataset", "physics", "episodes"]
            + [f"{flag.label}{suffix}" for flag in REPORTED_STATUSES for suffix in ("", "_low", "_high")]
            + ["exec_s", "plan_s", "average_success", "wait_s", *FLUENCY_UNITS]
        )
        writer.writerows(_format_csv_row(pair, report) for pair, report in self.reports.items())
        return stream.getvalue()

    def write(self, folder: Path) -> None:
        """Write tables (Markdown, CSV) and heat map; requires the extra `plot`.

        Raises:
            ResultsError: The folder cannot be written.
        """
        from handover_marl.visualization.heat_map import draw_heat_map

        write_atomically(folder / "crossplay.md", f"# Cross-play\n\n{self}\n")
        write_atomically(folder / CROSSPLAY_CSV, self.to_csv())
        picture = draw_heat_map(self.success_rates, self.givers, self.receivers, self.title)
        write_atomically(folder / "crossplay.png", picture)

    def __str__(self) -> str:
        gains = self._format_giver_gains(), self._format_receiver_gains()
        return join_sections(
            self._format_heading(), self._format_matrix(), self._format_rates(), *gains, self._format_fluency()
        )

    @property
    def _first_report(self) -> Report:
        return next(iter(self.reports.values()))

    def _format_heading(self) -> str:
        report = self._first_report
        metadata = report.metadata
        return (
            f"Cross-play on {metadata.setup} {metadata.split}, {report.extent}, {metadata.physics} "
            f"physics, data: {report.data_label}. Success in percent with Wilson's 95 % interval."
        )

    def _format_matrix(self) -> str:
        rows = []
        for giver in self.givers:
            reports = [self.reports[giver, receiver] for receiver in self.receivers]
            cells = [format_percent_rate(each.count(EpisodeStatus.SUCCESS), len(each.episodes)) for each in reports]
            rows.append([giver, *cells])
        return format_table(["giver \\ receiver", *self.receivers], rows)

    def _format_rates(self) -> str:
        rows = []
        for (giver, receiver), report in self.reports.items():
            rates = [f"{100 * report.compute_rate(flag):.1f}" for flag in REPORTED_STATUSES]
            exec_s = append_interval(
                format_seconds(report.time_exec), compute_mean_interval(report.exec_times), ".3f", 1.0
            )
            rows.append([giver, receiver, *rates, exec_s, format_percent_mean(report.speed_scores), report.wait_label])
        header = [f"{flag.label} %" for flag in REPORTED_STATUSES]
        return format_table(["giver", "receiver", *header, "exec s", "AS %", "wait s"], rows)

    def _format_giver_gains(self) -> str:
        baseline = self.givers[0]
        pairs = [((giver, receiver), (baseline, receiver)) for giver in self.givers[1:] for receiver in self.receivers]
        rows = [[*pair, *self._format_gains(pair, other)] for pair, other in pairs]
        return format_table(["giver", "receiver", *_format_gain_header(baseline)], rows) if rows else ""

    def _format_receiver_gains(self) -> str:
        combinations = [(receiver, other) for n, receiver in enumerate(self.receivers) for other in self.receivers[:n]]
        rows = [
            [giver, receiver, other, *self._format_gains((giver, receiver), (giver, other))]
            for giver in self.givers
            for receiver, other in combinations
        ]
        return format_table(["giver", "receiver", "other", *_format_gain_header("the other")], rows) if rows else ""

    def _format_gains(self, pair: PolicyPair, baseline: PolicyPair) -> list[str]:
        statuses = (EpisodeStatus.SUCCESS, EpisodeStatus.HUMAN_CONTACT)
        return [format_percent_difference(self.compute_gain(pair, baseline, status)) for status in statuses]

    def _format_fluency(self) -> str:
        rows = [[*pair, *format_fluency_row(report.episodes)] for pair, report in self.reports.items()]
        table = format_table(["giver", "receiver", *format_fluency_header()], rows, n_keys=2)
        return f"{table}\n\n{FLUENCY_NOTE}"


@forward_signature(EvaluationConfig, ExecutionConfig, without=("giver", "receiver"))
def crossplay(
    givers: Sequence[PolicyLike] | PolicyLike,
    receivers: Sequence[PolicyLike] | PolicyLike,
    setup: str | EvaluationConfig = "s0",
    split: str = "val",
    execution: ExecutionConfig | None = None,
    **options: Unpack[EvaluationOptions],
) -> CrossPlay:
    """Evaluate every giver with every receiver.

    Args:
        givers: Givers, each as for `evaluate_pair`; gains are relative to the first one.
        receivers: Receivers, each as for `benchmark`.
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.EvaluationConfig`, whose
            policies are ignored.
        split: "train", "val" or "test".
        execution: Execution settings. The output folder gets a result folder for each pair and
            `crossplay.md`, `crossplay.csv` and `crossplay.png`.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        OptionError: No giver or no receiver is given, two different ones have the same label, or
            matplotlib is missing although an output folder is given.
        HandoverError: The same errors as `evaluate_pair`.
    """
    config, execution = build_configs(setup, options, execution, split=split)
    if execution.folder is not None:
        require_modules("the heat map", "plot", "matplotlib", advice="; or leave out `out`")
    dataset = config.open_dataset()
    # All names are resolved before the first scene, so that misspelled ones are reported at once.
    resolved_givers = _resolve_policies("giver", givers, dataset, config, execution.trust)
    resolved_receivers = _resolve_policies("receiver", receivers, dataset, config, execution.trust)
    # All folders are checked before the first scene, too.
    evaluations: dict[PolicyPair, Evaluation] = {}
    for giver in resolved_givers:
        for receiver in resolved_receivers:
            pair = giver.label, receiver.label
            pair_config = replace(config, giver=giver, receiver=receiver)
            evaluations[pair] = Evaluation(pair_config, execution.for_subfolder(format_pair_folder(pair)))
    result = CrossPlay(
        tuple(giver.label for giver in resolved_givers),
        tuple(receiver.label for receiver in resolved_receivers),
        {pair: evaluation.run() for pair, evaluation in evaluations.items()},
    )
    if execution.folder is not None:
        result.write(execution.folder)
    return result


def read_crossplay_pairs(folder: Path) -> list[PolicyPair]:
    """Read the labels (giver, receiver) of all pairs in a finished cross-play folder.

    Raises:
        ResultsError: `crossplay.csv` is missing or malformed.
    """
    path = folder / CROSSPLAY_CSV
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [(row["giver"], row["receiver"]) for row in csv.DictReader(file)]
    except FileNotFoundError as error:
        raise ResultsError(
            f"{path} does not exist: the cross-play is not finished; run the same command to resume"
        ) from error
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise ResultsError(f"{path}: not a cross-play table ({shorten_text(error)})") from error


def format_pair_folder(pair: PolicyPair) -> str:
    """Return the name of a pair's result folder, given its labels (giver, receiver)."""
    giver, receiver = pair
    return re.sub(r"[^\w.@=,+-]", "_", f"{giver}-{receiver}")


def _resolve_policies(
    agent: str, policies: Sequence[PolicyLike] | PolicyLike, dataset: Dataset, config: EvaluationConfig, trust: bool
) -> list[PolicyReference]:
    """Resolve the policies of one agent, without duplicates, in the given order."""
    requested = [policies] if isinstance(policies, (str, type, Policy, PolicyReference)) else policies
    if not isinstance(requested, Sequence) or not requested:
        raise OptionError(f"{agent}s must name at least one {agent}, got {policies!r}")
    references: dict[str, PolicyReference] = {}
    for policy in requested:
        reference = parse_policy(agent, policy, trust).resolve(dataset, config.world_config, config.setup)
        other = references.setdefault(reference.label, reference)
        if other.code_hash != reference.code_hash:
            raise OptionError(f"{agent}s must have different labels, got two with {reference.label!r}; rename one")
    return list(references.values())


def _format_csv_row(pair: PolicyPair, report: Report) -> list[object]:
    metadata, n = report.metadata, len(report.episodes)
    means = compute_fluency_means(report.episodes)
    rates = [
        f"{value:.6f}"
        for flag in REPORTED_STATUSES
        for value in (report.compute_rate(flag), *compute_wilson_interval(report.count(flag), n))
    ]
    times = [_format_csv_number(value) for value in (report.time_exec, report.time_plan, report.average_success)]
    fluency = [_format_csv_number(means[key].mean if means else None) for key in FLUENCY_UNITS]
    identity = [metadata.setup, metadata.split, report.data_label, metadata.physics]
    return [*pair, *identity, n, *rates, *times, metadata.wait_s, *fluency]


def _format_csv_number(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"


def _format_gain_header(baseline: str) -> list[str]:
    return [f"{name} over {baseline}, points (95 %, paired by scene)" for name in ("success", "contact")]
