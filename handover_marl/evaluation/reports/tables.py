"""Statistics with 95 % intervals, and tables of results as Markdown, CSV or LaTeX.

A quantity has one key in JSON and CSV files; its title in tables follows from the key, see `Column.title`.
"""

import csv
import io
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import scipy  # loads scipy.stats, which takes a second, at its first use

from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, check_name
from handover_marl.evaluation.results import EpisodeResult

NO_VALUE = "-"
#: Formats of printed tables.
TableFormat = Literal["markdown", "csv", "latex"]
TABLE_FORMATS: tuple[TableFormat, ...] = ("markdown", "csv", "latex")
_MAX_WIDTH = 100  # characters
_N_RESAMPLES = 2000
_LATEX_ESCAPES = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {
        "~": r"\textasciitilde{}",
        "^": r"\^{}",
        "\\": r"\textbackslash{}",
        "<": r"\ensuremath{<}",
        ">": r"\ensuremath{>}",
    }
)


@dataclass(frozen=True)
class Estimate:
    """Mean, rate or difference with its confidence interval.

    Attributes:
        mean: Value; None if no episode has one.
        interval_95: Lower and upper end of the 95 % interval, or None if there is no interval.
        n: Number of values.
    """

    mean: float | None
    interval_95: tuple[float, float] | None
    n: int

    def format_interval(self, spec: str = ".1f", scale: float = 100.0) -> str:
        """Return the interval as text, e.g. "54.4 to 70.0", its ends times `scale` in format `spec`; "-" if None."""
        return (
            NO_VALUE if self.interval_95 is None else " to ".join(f"{scale * end:{spec}}" for end in self.interval_95)
        )

    def format(self, spec: str = ".1f", interval_spec: str = "", scale: float = 100.0) -> str:
        """Return the value with its interval as text such as "62.5 (54.4 to 70.0)", by default in percent.

        Args:
            spec: Format specification of the value.
            interval_spec: Format specification of the interval's ends; default: `spec`.
            scale: Factor by which value and ends are multiplied.
        """
        if self.mean is None:
            return NO_VALUE
        text = f"{scale * self.mean:{spec}}"
        return f"{text} ({self.format_interval(interval_spec or spec, scale)})" if self.interval_95 else text


def estimate_mean(values: Sequence[float]) -> Estimate:
    """Estimate a mean with its bootstrap 95 % interval (percentiles of 2,000 resamples).

    The interval lies within the range of the values, so that no share exceeds one and no force is
    negative. The generator has a fixed seed: equal values have equal intervals. Fewer than two values have no interval.
    """
    n = len(values)
    if n < 2:
        return Estimate(float(values[0]) if n else None, None, n)
    data = np.asarray(values, dtype=np.float64)
    # scipy.stats.bootstrap draws the same resamples, but its percentiles are off by rounding errors.
    means = np.random.default_rng(0).choice(data, size=(_N_RESAMPLES, n)).mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Estimate(float(np.mean(data)), (float(low), float(high)), n)


def compute_wilson_interval(count: int, n: int) -> tuple[float, float]:
    """Compute Wilson's 95 % interval of a rate (0..1), given the number `count` of occurrences in n trials."""
    interval = scipy.stats.binomtest(count, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def estimate_rate(count: int, n: int) -> Estimate:
    """Estimate a rate (0..1) with Wilson's 95 % interval from its number of occurrences in n trials."""
    return Estimate(count / n, compute_wilson_interval(count, n), n)


def estimate_average_success(scores: Sequence[float]) -> Estimate:
    """Estimate average success from the scores of episodes (0..1), with its bootstrap 95 % interval.

    Without a success the bootstrap has no width; the interval is then that of the success rate, which is at least AS.
    """
    found = estimate_mean(scores)
    return found if any(scores) or not scores else replace(found, interval_95=compute_wilson_interval(0, found.n))


def estimate_paired_difference(first: Sequence[bool], second: Sequence[bool]) -> Estimate:
    """Estimate the difference of two rates on the same scenes, first minus second (-1..1).

    Both arguments say for every scene whether its episode had the outcome. The 95 % interval follows Agresti and Min
    (Statistics in Medicine 24, 2005): half an episode is added to each of the four kinds of pairs, so that the interval
    has a width even if few scenes, or none, differ.
    """
    differences = np.array(first, dtype=float) - np.array(second, dtype=float)
    n = len(differences) + 2.0
    center = differences.sum() / n
    half = scipy.stats.norm.ppf(0.975) * np.sqrt((np.abs(differences).sum() + 1.0) / n - center**2) / np.sqrt(n)
    interval = float(max(-1.0, center - half)), float(min(1.0, center + half))
    return Estimate(float(differences.mean()), interval, len(differences))


@dataclass(frozen=True)
class Column:
    """Numeric column of tables.

    Attributes:
        key: Key in JSON and CSV.
        unit: Unit in tables.
        scale: Factor from the unit in JSON and CSV to the unit in tables.
    """

    key: str
    unit: str = ""
    scale: float = 1.0

    @property
    def title(self) -> str:
        """Title in tables: the key's words and the unit."""
        words = self.key.replace("_", " ")
        return words if not self.unit or words.endswith(f" {self.unit}") else f"{words} {self.unit}"


#: Statuses whose rates are reported.
REPORTED_STATUSES = (
    EpisodeStatus.SUCCESS,
    EpisodeStatus.HUMAN_CONTACT,
    EpisodeStatus.OBJECT_DROP,
    EpisodeStatus.TIMEOUT,
)
N_EPISODES = Column("n_episodes")
#: Rates of the reported statuses, and the numbers of episodes with them.
RATES = tuple(Column(status.label, "%", 100.0) for status in REPORTED_STATUSES)
COUNTS = tuple(Column(f"n_{status.label}") for status in REPORTED_STATUSES)
AVERAGE_SUCCESS, WAIT = Column("AS", "%", 100.0), Column("wait_s", "s")
#: Means over successes: simulated time, wall-clock time of the policy, and their sum.
TIMES = (Column("exec_s", "s"), Column("plan_s", "s"), Column("total_s", "s"))
#: Time that passed during decisions, and early grabs; of evaluations with inference time.
LATE, EARLY_GRAB = Column("late_s", "s"), Column("early_grab", "%", 100.0)
#: The metrics of `FluencyMetrics`, in its order.
FLUENCY = tuple(Column(part.name, **part.metadata) for part in fields(FluencyMetrics))


@dataclass(frozen=True)
class ReportTable:
    """Table of a report. `str(table)` is Markdown.

    Attributes:
        header: Column titles.
        rows: Cells, one sequence per row.
        split_column: Column before which the Markdown table is split in two, so that related
            columns stay together; 0 splits only tables that are too wide.
        n_keys: Number of first columns that identify a row; every part of a split table has them.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    split_column: int = 0
    n_keys: int = 1

    def __str__(self) -> str:
        return self.format()

    def select(self, columns: Sequence[str]) -> "ReportTable":
        """Return a table of the given columns, or of all if none are given; it has no rows if a column is missing."""
        if not columns:
            return self
        if not set(columns) <= set(self.header):
            return ReportTable(columns, [])
        places = [list(self.header).index(title) for title in columns]
        return ReportTable(columns, [[row[place] for place in places] for row in self.rows])

    def format(self, style: TableFormat = "markdown") -> str:
        """Return the table as text; empty if there are no rows. Only Markdown splits wide tables.

        Args:
            style: "markdown", "csv" or "latex" (booktabs, special characters escaped).
        """
        if not self.rows:
            return ""
        if style == "csv":
            return format_csv([self.header, *self.rows]).rstrip("\n")
        if style == "latex":
            head, *body = (
                f" {' & '.join(str(cell).translate(_LATEX_ESCAPES) for cell in row)} \\\\"
                for row in (self.header, *self.rows)
            )
            alignment = "l" * self.n_keys + "r" * (len(self.header) - self.n_keys)
            lines = [f"\\begin{{tabular}}{{{alignment}}}", r"\toprule", head, r"\midrule", *body]
            return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])
        return self._format_markdown()

    def _format_markdown(self) -> str:
        """Return the table as Markdown; as several tables with the same key columns if it is wide."""
        cells = [[str(cell).replace("|", "\\|") for cell in row] for row in (self.header, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        parts: list[list[int]] = [[]]
        for column in range(self.n_keys, len(self.header)):
            width = 1 + sum(widths[other] + 3 for other in (*range(self.n_keys), *parts[-1], column))
            if parts[-1] and (width > _MAX_WIDTH or column == self.split_column):
                parts.append([])
            parts[-1].append(column)
        tables = []
        for part in parts:
            columns = [*range(min(self.n_keys, len(self.header))), *part]
            lines = ["| " + " | ".join(row[column].ljust(widths[column]) for column in columns) + " |" for row in cells]
            rule = "|".join("-" * (widths[column] + 2) for column in columns)
            tables.append("\n".join([lines[0], f"|{rule}|", *lines[1:]]))
        return "\n\n".join(tables)


class TabularResult(ABC):
    """Base class of results that are printed as texts and tables. `str(result)` is Markdown."""

    @abstractmethod
    def build_sections(self) -> Sequence[str | ReportTable]:
        """Build the texts and tables of the result, in order; empty ones are not printed."""

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of the result, in order."""
        return [section for section in self.build_sections() if isinstance(section, ReportTable)]

    def __str__(self) -> str:
        return self.format()

    def format(self, style: TableFormat = "markdown", columns: Sequence[str] = ()) -> str:
        """Return the result as text, with an empty line between two parts.

        Args:
            style: "markdown"; "csv" for only the tables; or "latex", in which texts are comments.
            columns: Titles of columns: only tables with all of them are included, with only these columns.

        Raises:
            UnknownNameError: Unknown style, or a column that no table has.
            OptionError: No table has all columns.
        """
        check_name("table format", style, TABLE_FORMATS)
        if isinstance(columns, str):
            raise OptionError(f"columns must be a list of titles, got {columns!r}; pass [{columns!r}]")
        sections = self.build_sections()
        headers = [section.header for section in sections if isinstance(section, ReportTable)]
        for column in columns:
            check_name("column", column, dict.fromkeys(title for header in headers for title in header))
        if not any(set(columns) <= set(header) for header in headers):
            raise OptionError(f"columns must be of one table, got {', '.join(columns)}; print one table at a time")
        parts = []
        for section in sections:
            if isinstance(section, ReportTable):
                parts.append(section.select(columns).format(style))
            elif style == "latex":
                parts.append("\n".join(f"% {line}" for line in section.splitlines()))
            elif style == "markdown":
                parts.append(section)
        return "\n\n".join(filter(None, parts))


def format_csv(rows: Sequence[Sequence[object]]) -> str:
    """Return rows as CSV text; missing values (None) are empty cells."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()


def format_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table with these column titles and rows; a wide table is split, see `ReportTable`."""
    return str(ReportTable(header, rows))


def format_percent_rate(count: int, n: int, digits: int = 1) -> str:
    """Return `count` of `n` trials in percent, with `digits` decimals and Wilson's 95 % interval, as text."""
    return estimate_rate(count, n).format(f".{digits}f", ".1f")


#: Titles of the cells of an episode: its keys in `report.json`.
SCENE_HEADER = ("scene id", "object name", "subject", "side", "outcome", "steps", "release step", "plan s")
# Further cells in evaluations with inference time.
_INFERENCE_HEADER = ("late s", "early grab")
FLUENCY_NOTE = (
    "Means over the n episodes that have a value. Human idle, robot idle, concurrent activity and functional delay are "
    "shares of the episode (Hoffman 2019); forces are sums of normal forces in one step of 1 ms; SPARC is spectral arc "
    "length; jerk is a root mean square. Definitions: docs/reference/metrics.md."
)


def count_status(episodes: Iterable[EpisodeResult], status: EpisodeStatus) -> int:
    """Count the episodes with a status flag."""
    return sum(bool(episode.status & status) for episode in episodes)


def get_scene_header(episodes: Iterable[EpisodeResult]) -> tuple[str, ...]:
    """Return the column titles of a table of episodes; with inference time also "late s" and "early grab"."""
    return SCENE_HEADER + (_INFERENCE_HEADER if any(episode.late_s is not None for episode in episodes) else ())


def format_scene_cells(episode: EpisodeResult) -> list[str]:
    """Return the cells of an episode as texts, in the order of `get_scene_header`; "-" for unknown values."""
    cells = (episode.scene_id, episode.object_name, episode.subject, episode.side, episode.status.label, episode.steps)
    texts = [NO_VALUE if cell is None else str(cell) for cell in (*cells, episode.release_step)]
    texts.append(f"{episode.plan_s:.3f}")
    if episode.late_s is not None:
        grab = {True: "yes", False: "no", None: NO_VALUE}[episode.early_grab]
        texts += [f"{episode.late_s:.3f}", grab]
    return texts


def build_scene_table(episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of outcomes with one row per scene."""
    return ReportTable(get_scene_header(episodes), [format_scene_cells(episode) for episode in episodes])


def build_object_table(episodes: Sequence[EpisodeResult]) -> ReportTable:
    """Build the table of success rates and numbers of failures by object class."""
    rows = []
    for name in sorted({episode.object_name for episode in episodes if episode.object_name}):
        chosen = [episode for episode in episodes if episode.object_name == name]
        counts = [count_status(chosen, flag) for flag in REPORTED_STATUSES]
        rows.append([name, len(chosen), format_percent_rate(counts[0], len(chosen)), *counts[1:]])
    return ReportTable(["object name", *(column.title for column in (N_EPISODES, RATES[0], *COUNTS[1:]))], rows)


def estimate_fluency(episodes: Iterable[EpisodeResult]) -> dict[str, Estimate]:
    """Estimate the mean of every metric in `FluencyMetrics`, by key; without keys if no episode has these metrics.

    With inference time, there are also the keys `late_s` (mean) and `early_grab` (rate), see `EpisodeResult`.
    """
    episodes = tuple(episodes)
    known = [episode.fluency for episode in episodes if episode.fluency is not None]
    means = {
        column.key: estimate_mean([float(value) for each in known if (value := getattr(each, column.key)) is not None])
        for column in (FLUENCY if known else ())
    }
    late = [episode.late_s for episode in episodes if episode.late_s is not None]
    grabs = [episode.early_grab for episode in episodes if episode.early_grab is not None]
    if late:
        means[LATE.key] = estimate_mean(late)
        means[EARLY_GRAB.key] = estimate_rate(sum(grabs), len(grabs)) if grabs else estimate_mean([])
    return means


def build_fluency_table(means: Mapping[str, Estimate], title: str = "mean") -> ReportTable:
    """Build a table with a row for each of the estimates `means` (by key); `title` heads the column of their values."""
    rows: list[list[object]] = []
    for column in (column for column in (*FLUENCY, LATE, EARLY_GRAB) if column.key in means):
        found = means[column.key]
        # Three digits, without exponents.
        sizes = [column.scale * abs(value) for value in (found.mean or 0.0, *(found.interval_95 or ()))]
        spec = ".0f" if max(sizes) >= 999.5 else ".4f" if any(0.0 < size < 1e-4 for size in sizes) else ".3g"
        cell = NO_VALUE if found.mean is None else f"{column.scale * found.mean:{spec}}"
        rows.append([column.title, cell, found.format_interval(spec, column.scale), found.n])
    return ReportTable(["metric", title, "95 % interval", "n"], rows)
