"""Every giver with every receiver: who gets on with whom."""

import csv
import importlib.util
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from typing_extensions import Unpack

from handover_marl.benchmarking.fluency_tables import (
    FLUENCY_NOTE,
    METRICS,
    fluency_averages,
    fluency_header,
    fluency_row,
)
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.benchmarking.statistics import mean_interval, paired_difference, wilson_interval
from handover_marl.benchmarking.tables import (
    NO_VALUE,
    RATES,
    percent_gain,
    percent_mean,
    percent_rate,
    report_extent,
    table,
    wait_cell,
)
from handover_marl.datasets import Dataset
from handover_marl.errors import OptionError, ResultsError
from handover_marl.files import brief, write_atomically
from handover_marl.options import shows
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike, PolicyReference, policy_reference
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.run import Execution, Run, RunOptions, describe

Pair = tuple[str, str]
CSV_FILE = "crossplay.csv"


@dataclass(frozen=True, eq=False)
class CrossPlay:
    """Reports of all pairs on the same scenes. `str(crossplay)` is the tables.

    Attributes:
        givers: Names of the givers, the rows.
        receivers: Names of the receivers, the columns.
        reports: Report of every (giver, receiver).
    """

    givers: tuple[str, ...]
    receivers: tuple[str, ...]
    reports: dict[Pair, Report]

    def title(self) -> str:
        """What was played, in two lines."""
        report = next(iter(self.reports.values()))
        settings, n = report.settings, len(report.episodes)
        return (
            f"{settings.setup} {settings.split}, {n} episodes a cell\n{report.data_label()}, {settings.physics} physics"
        )

    def success_rates(self) -> list[list[float]]:
        """Success (0..1), a row for each giver, a column for each receiver."""
        return [[self.reports[giver, receiver].success_rate for receiver in self.receivers] for giver in self.givers]

    def gain(self, pair: Pair, over: Pair, flag: EpisodeStatus = EpisodeStatus.SUCCESS) -> tuple[float, float, float]:
        """How much more often one (giver, receiver) ends so than another: mean and 95 % interval (-1..1).

        Paired by scene, so that easy and hard scenes do not blur it.
        """
        first, second = (
            [bool(episode.status & flag) for episode in self.reports[played].episodes] for played in (pair, over)
        )
        return paired_difference(first, second)

    def __str__(self) -> str:
        gains = [self._giver_gains(), self._receiver_gains()]
        parts = [self._heading(), self._matrix(), self._rates(), *gains, self._fluency()]
        return "\n\n".join(part for part in parts if part)

    def to_csv(self) -> str:
        """A row for every pair: rates and intervals 0..1, times in s, fluency in the units of `Fluency`."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        names = [flag.label for flag in RATES]
        writer.writerow(
            ["giver", "receiver", "setup", "split", "dataset", "physics", "episodes"]
            + [f"{name}{suffix}" for name in names for suffix in ("", "_low", "_high")]
            + ["exec_s", "plan_s", "average_success", "wait_s", *(metric.key for metric in METRICS)]
        )
        for (giver, receiver), report in self.reports.items():
            settings, n = report.settings, len(report.episodes)
            averages = fluency_averages(report.episodes)
            rates = [
                value for flag in RATES for value in (report.count(flag) / n, *wilson_interval(report.count(flag), n))
            ]
            writer.writerow(
                [giver, receiver, settings.setup, settings.split, report.data_label(), settings.physics, n]
                + [f"{rate:.6f}" for rate in rates]
                + [_number(value) for value in (report.time_exec, report.time_plan, report.average_success)]
                + [settings.wait]
                + [_number(averages[metric.key].mean if averages else None) for metric in METRICS]
            )
        return stream.getvalue()

    def _heading(self) -> str:
        report = next(iter(self.reports.values()))
        settings = report.settings
        return (
            f"Cross-play on {settings.setup} {settings.split}, {report_extent(report)}, {settings.physics} "
            f"physics, data: {report.data_label()}. Success in percent with Wilson's 95 % interval."
        )

    def _matrix(self) -> str:
        rows = []
        for giver in self.givers:
            cells = []
            for receiver in self.receivers:
                report = self.reports[giver, receiver]
                n, count = len(report.episodes), report.count(EpisodeStatus.SUCCESS)
                cells.append(percent_rate(count, n))
            rows.append([giver, *cells])
        return table(["giver \\ receiver", *self.receivers], rows)

    def _rates(self) -> str:
        rows = []
        for (giver, receiver), report in self.reports.items():
            n = len(report.episodes)
            rates = [f"{100 * report.count(flag) / n:.1f}" for flag in RATES]
            interval = mean_interval(report.exec_times())
            mean = NO_VALUE if report.time_exec is None else f"{report.time_exec:.3f}"
            spread = "" if interval is None else f" ({interval[0]:.3f} to {interval[1]:.3f})"
            speed = percent_mean(report.speed_scores())
            rows.append([giver, receiver, *rates, mean + spread, speed, wait_cell(report)])
        return table(["giver", "receiver", *(f"{flag.label} %" for flag in RATES), "exec s", "AS %", "wait s"], rows)

    def _giver_gains(self) -> str:
        first = self.givers[0]
        rows = [
            [giver, receiver, *self._gain_cells((giver, receiver), (first, receiver))]
            for giver in self.givers[1:]
            for receiver in self.receivers
        ]
        return table(["giver", "receiver", *_gain_header(first)], rows) if rows else ""

    def _receiver_gains(self) -> str:
        rows = [
            [giver, receiver, other, *self._gain_cells((giver, receiver), (giver, other))]
            for giver in self.givers
            for number, receiver in enumerate(self.receivers)
            for other in self.receivers[:number]
        ]
        return table(["giver", "receiver", "other", *_gain_header("the other")], rows) if rows else ""

    def _gain_cells(self, pair: Pair, over: Pair) -> list[str]:
        gains = (self.gain(pair, over, flag) for flag in (EpisodeStatus.SUCCESS, EpisodeStatus.HUMAN_CONTACT))
        return [percent_gain(gain) for gain in gains]

    def _fluency(self) -> str:
        rows = [[*pair, *fluency_row(report.episodes)] for pair, report in self.reports.items()]
        return table(["giver", "receiver", *fluency_header()], rows, keys=2) + f"\n\n{FLUENCY_NOTE}"


def _gain_header(over: str) -> list[str]:
    return [f"{name} over {over}, points (95 %, paired by scene)" for name in ("success", "contact")]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"


@shows(Run, Execution, without=("giver", "receiver"))
def crossplay(
    givers: Sequence[PolicyLike] | PolicyLike,
    receivers: Sequence[PolicyLike] | PolicyLike,
    setup: str | Run = "s0",
    split: str = "val",
    execution: Execution | None = None,
    **options: Unpack[RunOptions],
) -> CrossPlay:
    """Play every giver with every receiver.

    Args:
        givers: As `giver` in `evaluate_pair`, several of them; gains are told over the first one.
        receivers: As `receiver` in `benchmark`, several of them.
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.Run`, whose policies do not count.
        split: "train", "val" or "test".
        execution: How to run. Its folder gets a result folder a pair and `crossplay.md`, `crossplay.csv` and
            `crossplay.png`.
        options: The fields of `handover_marl.Run` and `handover_marl.Execution`.

    Raises:
        OptionError: No giver or no receiver is named, two have one label, or there is a folder and no matplotlib.
        HandoverError: As `evaluate_pair` does.
    """
    run, how = describe(setup, options, execution, split=split)
    if how.folder is not None and importlib.util.find_spec("matplotlib") is None:
        raise OptionError("the heat map needs matplotlib: pip install 'handover-marl[plot]'; or leave out `out`")
    data = run.open_dataset()
    # Misspelled names come to light before the first scene.
    rows = _resolved("giver", givers, data, run, how.trust)
    columns = _resolved("receiver", receivers, data, run, how.trust)
    reports = {
        (giver.label, receiver.label): evaluate_run(
            replace(run, giver=giver, receiver=receiver), how.inside(pair_folder((giver.label, receiver.label)))
        )
        for giver in rows
        for receiver in columns
    }
    result = CrossPlay(tuple(row.label for row in rows), tuple(column.label for column in columns), reports)
    if how.folder is not None:
        write_crossplay(how.folder, result)
    return result


def write_crossplay(folder: Path, result: CrossPlay) -> None:
    """Write tables and picture; needs the extra `plot`.

    Raises:
        ResultsError: The folder cannot be written.
    """
    from handover_marl.pictures.heat_map import heat_map

    write_atomically(folder / "crossplay.md", f"# Cross-play\n\n{result}\n")
    write_atomically(folder / CSV_FILE, result.to_csv())
    picture = heat_map(result.success_rates(), result.givers, result.receivers, result.title())
    write_atomically(folder / "crossplay.png", picture)


def read_pairs(folder: Path) -> list[Pair]:
    """The pairs of a folder that `write_crossplay` wrote, in their order.

    Raises:
        ResultsError: There is no such file, or it is no such table.
    """
    path = folder / CSV_FILE
    try:
        with path.open(newline="") as file:
            return [(row["giver"], row["receiver"]) for row in csv.DictReader(file)]
    except FileNotFoundError as error:
        raise ResultsError(f"{path} is not there: the run is not finished; the same command goes on with it") from error
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise ResultsError(f"{path}: no table of cross-play ({brief(error)})") from error


def _resolved(
    agent: str, policies: Sequence[PolicyLike] | PolicyLike, data: Dataset, run: Run, trust: bool
) -> list[PolicyReference]:
    """Policies of one agent, each once, in the order given."""
    several = [policies] if isinstance(policies, (str, type, Policy, PolicyReference)) else list(policies)
    if not several:
        raise OptionError("cross-play needs at least one giver and one receiver")
    references: dict[str, PolicyReference] = {}
    for policy in several:
        reference = policy_reference(agent, policy, trust).resolved(data, run.config, run.setup)
        other = references.setdefault(reference.label, reference)
        if other.source != reference.source:
            raise OptionError(
                f"two {agent}s are called {reference.label!r} and are not the same; give one another name"
            )
    return list(references.values())


def pair_folder(pair: Pair) -> str:
    """What the result folder of a pair is called."""
    giver, receiver = pair
    return re.sub(r"[^\w.@=,+-]", "_", f"{giver}-{receiver}")
