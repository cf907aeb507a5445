"""Cross-play: evaluation of every giver with every receiver on the same scenes."""

import hashlib
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from handover_marl.datasets import Dataset
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError
from handover_marl.evaluation.benchmark import run_evaluations
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig, build_configs, format_inference_time
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    COUNTS,
    FLUENCY,
    N_EPISODES,
    NO_VALUE,
    RATES,
    REPORTED_STATUSES,
    TIMES,
    WAIT,
    Estimate,
    ReportTable,
    TabularResult,
    estimate_fluency,
    estimate_paired_difference,
    format_csv,
    format_percent_rate,
)
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import forward_signature, require_modules
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike, PolicyReference, parse_policy

PolicyPair = tuple[str, str]
SUCCESS = EpisodeStatus.SUCCESS
CROSSPLAY_CSV = "crossplay.csv"
_NOTE = f"Means of the fluency metrics are in {CROSSPLAY_CSV}, and in the report of each pair."
_CSV_IDENTITY = ("setup", "split", "dataset", "physics", "world", "seed", "inference_time")
_CSV_COLUMNS = (*RATES, AVERAGE_SUCCESS, *TIMES, *FLUENCY)
# Longer names of folders are cut, and a hash follows; file systems allow 255 bytes.
_MAX_NAME_BYTES = 200


@dataclass(frozen=True, eq=False)
class CrossPlay(TabularResult):
    """Reports of all pairs of giver and receiver on the same scenes. `str` returns Markdown tables.

    Attributes:
        reports: Report of every (giver, receiver), by their labels.
    """

    reports: dict[PolicyPair, Report]

    @property
    def givers(self) -> tuple[str, ...]:
        """Labels of the givers, the rows of the table of success rates."""
        return tuple(dict.fromkeys(giver for giver, _ in self.reports))

    @property
    def receivers(self) -> tuple[str, ...]:
        """Labels of the receivers, the columns of the table of success rates."""
        return tuple(dict.fromkeys(receiver for _, receiver in self.reports))

    def to_csv(self) -> str:
        """Return CSV text with one row per pair of policies.

        Rates are in 0..1, times in s, fluency metrics in the units of `FluencyMetrics`. KEY_low and
        KEY_high are the ends of a 95 % interval, KEY_n is the number of episodes of a mean.
        """
        rows = []
        for (giver, receiver), report in self.reports.items():
            row: dict[str, Any] = {"giver": giver, "receiver": receiver}
            known = report.metadata.to_dict()
            row |= {key: known[key] for key in _CSV_IDENTITY if key in known}
            row |= {"data": report.data_label, N_EPISODES.key: len(report.episodes), WAIT.key: report.metadata.wait_s}
            found = report.rates | report.official_means | estimate_fluency(report.episodes)
            for key in dict.fromkeys((*(column.key for column in _CSV_COLUMNS), *found)):
                estimate = found.get(key, Estimate(None, None, 0))
                low, high = estimate.interval_95 or (None, None)
                row |= {key: estimate.mean, f"{key}_low": low, f"{key}_high": high, f"{key}_n": estimate.n}
            rows.append({key: f"{value:.6f}" if isinstance(value, float) else value for key, value in row.items()})
        return format_csv([list(rows[0]), *(list(row.values()) for row in rows)])

    def write(self, folder: Path) -> None:
        """Write tables (Markdown, CSV) and a heat map of success rates (PNG) to a folder; requires the extra `plot`.

        Raises:
            ResultsError: The folder cannot be written.
        """
        from handover_marl.visualization.pictures import draw_heat_map

        write_atomically(folder / "crossplay.md", f"# Cross-play\n\n{self}\n")
        write_atomically(folder / CROSSPLAY_CSV, self.to_csv())
        rates = [[self.reports[giver, receiver].success_rate for receiver in self.receivers] for giver in self.givers]
        report = self._first_report
        metadata, n = report.metadata, len(report.episodes)
        title = f"{metadata.setup} {metadata.split}, {n} episodes a cell\n{report.data_label}, {self._simulation_label}"
        write_atomically(folder / "crossplay.png", draw_heat_map(rates, self.givers, self.receivers, title))

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables (success rates as a matrix, all rates, differences between policies) and note."""
        report = self._first_report
        metadata, baseline = report.metadata, self.givers[0]
        titles = [N_EPISODES.title, "success gain, points", "contact gain, points"]
        matrix_titles, n = [f"{name}: {RATES[0].title}" for name in self.receivers], len(report.episodes)
        matrix = [
            [giver, *(format_percent_rate(self.reports[giver, name].count(SUCCESS), n) for name in self.receivers), n]
            for giver in self.givers
        ]
        giver_gains = [
            [giver, baseline, receiver, *self._format_rate_differences((giver, receiver), (baseline, receiver))]
            for giver in self.givers[1:]
            for receiver in self.receivers
        ]
        receiver_gains = [
            [receiver, other, giver, *self._format_rate_differences((giver, receiver), (giver, other))]
            for giver in self.givers
            for other, receiver in itertools.combinations(self.receivers, 2)
        ]
        return [
            f"Cross-play on {metadata.setup} {metadata.split}, {report.extent}, "
            f"{self._simulation_label}, data: {report.data_label}.\n"
            "95 % intervals: Wilson for rates, bootstrap for means, Agresti and Min for differences, paired by scene.",
            ReportTable(["giver", *matrix_titles, N_EPISODES.title], matrix),
            self._build_rate_table(),
            ReportTable(["giver", "other giver", "receiver", *titles], giver_gains, n_keys=3),
            ReportTable(["receiver", "other receiver", "giver", *titles], receiver_gains, n_keys=3),
            _NOTE,
        ]

    @property
    def _first_report(self) -> Report:
        return next(iter(self.reports.values()))

    @property
    def _simulation_label(self) -> str:
        metadata = self._first_report.metadata
        return ", ".join(filter(None, (metadata.simulation_label, format_inference_time(metadata.inference_time))))

    def _build_rate_table(self) -> ReportTable:
        rows = []
        for pair, report in self.reports.items():
            rates = [f"{100 * report.compute_rate(flag):.1f}" for flag in REPORTED_STATUSES]
            score, exec_s = (report.official_means[column.key] for column in (AVERAGE_SUCCESS, TIMES[0]))
            means = [score.format(".2f", ".1f"), exec_s.format(".3f", scale=1.0), exec_s.n]
            rows.append([*pair, len(report.episodes), *rates, report.metadata.wait_s or NO_VALUE, *means])
        columns = [N_EPISODES, *RATES, WAIT, AVERAGE_SUCCESS, TIMES[0], COUNTS[0]]
        return ReportTable(["giver", "receiver", *(column.title for column in columns)], rows, n_keys=2)

    def _format_rate_differences(self, pair: PolicyPair, baseline: PolicyPair) -> list[object]:
        """Return table cells: number of scenes, and gains of `pair` over `baseline` in success and contact (points)."""
        sides = [self.reports[each].episodes for each in (pair, baseline)]
        differences = [
            estimate_paired_difference(*([bool(each.status & status) for each in side] for side in sides))
            for status in (SUCCESS, EpisodeStatus.HUMAN_CONTACT)
        ]
        return [len(sides[0]), *(difference.format("+.1f") for difference in differences)]


@forward_signature(
    EvaluationConfig, ExecutionConfig, without={"giver": "name it in givers", "receiver": "name it in receivers"}
)
def crossplay(
    givers: Sequence[PolicyLike] | PolicyLike,
    receivers: Sequence[PolicyLike] | PolicyLike,
    setup: str | None = None,
    split: str = "val",
    **options: Any,
) -> CrossPlay:
    """Evaluate every giver with every receiver.

    Args:
        givers: Givers, each as for `evaluate_pair`; the rates of the others are compared to those of the first one.
        receivers: Receivers, each as for `benchmark`.
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: "train", "val" or "test".
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`. The folder `out` gets a
            result folder for each pair and `crossplay.md`, `crossplay.csv` and `crossplay.png`.

    Raises:
        OptionError: No giver or receiver is given, different ones have one label, or matplotlib is missing for `out`.
        HandoverError: The same errors as `evaluate_pair`.
    """
    config, execution = build_configs(options, setup=setup, split=split)
    if execution.folder is not None:
        require_modules("the heat map", "plot", "matplotlib", advice="; or leave out `out`")
    dataset = config.open_dataset()
    # All names are resolved before the first scene, so that misspelled ones are reported at once.
    resolved_givers = resolve_policies("giver", givers, dataset, config, execution.trust)
    resolved_receivers = resolve_policies("receiver", receivers, dataset, config, execution.trust)
    configs = {
        (giver.label, receiver.label): replace(config, giver=giver, receiver=receiver)
        for giver in resolved_givers
        for receiver in resolved_receivers
    }
    folders = list(map(format_pair_folder, configs))
    if twice := [folder for folder in folders if folders.count(folder) > 1]:
        raise OptionError(f"each giver and receiver must have a folder of its own, got {twice[0]} twice; rename one")
    reports = run_evaluations(list(zip(folders, configs.values(), strict=True)), execution)
    result = CrossPlay(dict(zip(configs, reports, strict=True)))
    if execution.folder is not None:
        result.write(execution.folder)
    return result


def resolve_policies(
    agent: str, policies: Sequence[PolicyLike] | PolicyLike, dataset: Dataset, config: EvaluationConfig, trust: bool
) -> list[PolicyReference]:
    """Return references to the policies of an agent ("giver", "receiver"), in the given order, without duplicates.

    `policies` is one policy or a sequence; a tuple (policy, dict of options) is one policy. With `trust`, modules that
    policy files name may be imported. Different policies with the same label raise `OptionError`.
    """
    is_pair = isinstance(policies, tuple) and any(isinstance(part, Mapping) for part in policies)
    is_one = is_pair or isinstance(policies, (str, type, Policy, PolicyReference))
    requested: Any = [policies] if is_one else policies
    if not isinstance(requested, Sequence) or not requested:
        raise OptionError(f"{agent}s must name at least one {agent}, got {policies!r}")
    references: dict[str, PolicyReference] = {}
    for policy in requested:
        reference = parse_policy(agent, policy, trust).resolve(dataset, config.world_config, config.setup)
        other = references.setdefault(reference.label, reference)
        if other.code_hash != reference.code_hash:
            raise OptionError(f"{agent}s must have different labels, got two with {reference.label!r}; rename one")
    return list(references.values())


def format_pair_folder(pair: PolicyPair) -> str:
    """Return the name of a pair's result folder, given its labels (giver, receiver).

    A name that is too long for file systems ends in a hash of the labels.
    """
    giver, receiver = pair
    name = re.sub(r"[^\w.@=,+-]", "_", f"{giver}-{receiver}")
    if len(name.encode()) <= _MAX_NAME_BYTES:
        return name
    start = name.encode()[:_MAX_NAME_BYTES].decode(errors="ignore")
    return f"{start}-{hashlib.sha256(repr(pair).encode()).hexdigest()[:12]}"
