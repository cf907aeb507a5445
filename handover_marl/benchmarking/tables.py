"""A report in words and tables, readable in a terminal and as Markdown."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import tabulate

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.fluency_tables import (
    FLUENCY_NOTE,
    fluency_averages,
    fluency_header,
    fluency_row,
)
from handover_marl.benchmarking.published import PUBLISHED, SOURCES, PublishedRow
from handover_marl.benchmarking.report import FAILURES, Report
from handover_marl.benchmarking.settings import OFFICIAL_WORLD, RunSettings
from handover_marl.benchmarking.statistics import mean_interval, wilson_interval
from handover_marl.models.panda import PANDA
from handover_marl.protocol.status import EpisodeStatus

NO_VALUE = "-"
# Columns of a terminal.
_WIDTH = 100

# What tabulate adds to titles would push tables over the width.
tabulate.MIN_PADDING = 0

_METRICS = ["success %", "contact %", "drop %", "timeout %", "AS %", "wait s", "exec s", "plan s", "total s"]
#: Outcomes of which there are rates.
RATES = (EpisodeStatus.SUCCESS, *FAILURES)


@dataclass(frozen=True)
class Grid:
    """A table before it is written: titles and rows of cells. `str(grid)` is Markdown; empty without rows.

    Markdown is cut before the column `cut`, so that what belongs together stays together; 0 cuts where it must be.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    cut: int = 0

    def __str__(self) -> str:
        if not self.rows:
            return ""
        ends = [slice(1, self.cut), slice(self.cut, None)] if self.cut else [slice(1, None)]
        parts = [
            table([*self.header[:1], *self.header[end]], [[*row[:1], *row[end]] for row in self.rows]) for end in ends
        ]
        return "\n\n".join(parts)


def report_text(report: Report) -> str:
    """Heading, official table, per-object breakdown, metrics beyond the official ones."""
    fluency = fluency_table(report)
    parts = [heading(report), official_table(report), object_table(report), notes(report)]
    parts += [f"{fluency}\n\n{FLUENCY_NOTE}"] if fluency.rows else []
    return "\n\n".join(str(part) for part in parts if str(part))


def report_markdown(report: Report) -> str:
    """The report with every scene, as a Markdown file."""
    return f"# Handover benchmark\n\n{report_text(report)}\n\n## Scenes\n\n{scene_table(report.episodes)}\n"


def heading(report: Report) -> str:
    """What was run on what."""
    settings = report.settings
    without = f" without {settings.without}" if settings.without else ""
    return (
        f"{settings.setup} {settings.split}, {report_extent(report)}. Receiver {players(settings)}, {settings.physics} "
        f"physics{without}, data: {report.data_label()}. handover_marl {settings.version}{_code(settings)}."
    )


def players(settings: RunSettings) -> str:
    """The receiver, with what it sees and how long it waits, and the giver."""
    told = [f"wait {settings.wait} s" if settings.wait else "", settings.sight]
    told += [] if settings.robot == PANDA else [f"robot {settings.robot}"]
    said = ", ".join(part for part in told if part)
    return f"{settings.receiver}{f' ({said})' if said else ''}, giver {settings.giver}"


def _code(settings: RunSettings) -> str:
    codes = [settings.receiver_code, settings.giver_code]
    return f", code {' and '.join(code for code in codes if code)}" if any(codes) else ""


def report_extent(report: Report) -> str:
    """How much of the split was run."""
    n = len(report.episodes)
    shard = report.settings.shard.partition(" ")[0]
    if report.partial or shard:
        return f"{n} of {report.n_split} scenes (partial{f', shard {shard}' if shard else ''})"
    return f"all {n} scenes"


def official_table(report: Report) -> Grid:
    """The official metrics, their 95 % intervals, and the published rows where they are comparable."""
    n = len(report.episodes)
    rates = [f"{100 * report.count(flag) / n:.2f} ({report.count(flag)}/{n})" for flag in RATES]
    times = [_seconds(report.time_exec), _seconds(report.time_plan), _seconds(report.time_total)]
    intervals = [percent_interval(report.count(flag), n) for flag in RATES]
    time_intervals = [_seconds_interval(report.exec_times()), _seconds_interval(report.plan_times()), NO_VALUE]
    rows = [
        [report.settings.receiver, *rates, f"{100 * report.average_success:.2f}", wait_cell(report), *times],
        ["95 % interval", *intervals, _speed_interval(report), NO_VALUE, *time_intervals],
        *(_published_row(row) for row in _comparable(report)),
    ]
    return Grid(["", *_METRICS], rows, cut=1 + _METRICS.index("AS %"))


def object_table(report: Report) -> Grid:
    """Outcomes by object class."""
    names = sorted({episode.object_name for episode in report.episodes if episode.object_name})
    rows = []
    for name in names:
        episodes = [episode for episode in report.episodes if episode.object_name == name]
        counts = [sum(bool(episode.status & flag) for episode in episodes) for flag in RATES]
        interval = percent_interval(counts[0], len(episodes))
        rows.append([name, len(episodes), *counts, f"{100 * counts[0] / len(episodes):.1f}", interval])
    header = ["object", "scenes", "success", "contact", "drop", "timeout", "success %", "95 % interval"]
    return Grid(header, rows)


def fluency_table(report: Report) -> Grid:
    """Metrics beyond the official ones, a row each; no rows where none were recorded."""
    header = ["beyond the official metrics", "mean", "95 % interval"]
    if not fluency_averages(report.episodes):
        return Grid(header, [])
    cells = zip(fluency_header(), fluency_row(report.episodes), strict=True)
    rows = [[name, *(cell.removesuffix(")").split(" (") if "(" in cell else (cell, NO_VALUE))] for name, cell in cells]
    return Grid(header, rows)


def scene_table(episodes: Iterable[EpisodeResult]) -> Grid:
    """One row a scene."""
    header = ["scene", "object", "subject", "hand", "outcome", "steps", "release step", "plan s"]
    return Grid(header, [_scene_cells(episode) for episode in episodes])


def _scene_cells(episode: EpisodeResult) -> list[str]:
    """A scene's row: scene, object, subject, hand, outcome, steps, release step, plan time."""
    cells = (episode.scene_id, episode.object_name, episode.subject, episode.side, episode.status.label)
    release = NO_VALUE if episode.release_step is None else str(episode.release_step)
    texts = [NO_VALUE if cell is None else str(cell) for cell in cells]
    return [*texts, str(episode.steps), release, f"{episode.plan_time:.3f}"]


def _comparable(report: Report) -> tuple[PublishedRow, ...]:
    settings = report.settings
    if (settings.split, settings.dataset, settings.physics, settings.world) != (
        "test",
        "dexycb",
        "exact",
        "official",
    ):
        return ()
    return PUBLISHED[settings.setup]


def _published_row(row: PublishedRow) -> list[str]:
    rates = [f"{rate:.2f}" for rate in (row.success, row.contact, row.drop, row.timeout)]
    times = [_seconds(value) for value in (row.time_exec, row.time_plan, row.time_total)]
    return [f"published: {row.method}", *rates, f"{row.average_success:.2f}", f"{row.wait:g}", *times]


def notes(report: Report) -> str:
    """What has to be known to read the tables, a line each."""
    lines = [
        "Rates over all scenes, times over successes. Intervals: Wilson for rates, bootstrap for means.",
        "AS: mean over all scenes of 1 - exec / 13 s for successes, 0 for failures.",
        "wait s: how long the robot stays away.",
        f"plan s is wall clock, measured on {report.machine_label()}.",
    ]
    if report.n_earlier:
        lines.append(f"{report.n_earlier} of the {len(report.episodes)} episodes come from an earlier run.")
    if report.settings.world != OFFICIAL_WORLD:
        lines.append(f"World or rules are not the official ones ({report.settings.world}).")
    if report.settings.physics != "exact":
        lines.append("Official results are in exact physics; how far these agree: handover-marl agreement.")
    if report.settings.dataset == "synthetic":
        lines.append("Synthetic scenes are generated: not comparable with published results, which are on DexYCB.")
    if _comparable(report):
        lines.append("Published, on DexYCB with all objects and MANO hands, times on the authors' machines:")
        lines.append(
            "GA-DDPG and handover-sim2real have the Panda with the camera (panda_camera), the others the plain one."
        )
        sources = {row.source: None for row in _comparable(report)}
        lines += [f"{SOURCES[source]}." for source in sources]
    return "\n".join(lines)


def wait_cell(report: Report) -> str:
    """How long the receiver waits (s), or a dash if nobody says."""
    return report.settings.wait or NO_VALUE


def percent_mean(values: Sequence[float], signed: bool = False) -> str:
    """A mean in percent with its bootstrap 95 % interval, as far as there is one."""
    sign, interval = "+" if signed else "", mean_interval(values)
    mean = f"{100 * sum(values) / len(values):{sign}.2f}"
    return mean if interval is None else f"{mean} ({' to '.join(f'{100 * end:{sign}.1f}' for end in interval)})"


def _speed_interval(report: Report) -> str:
    interval = mean_interval(report.speed_scores())
    return NO_VALUE if interval is None else f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"


def _seconds(value: float | None) -> str:
    return NO_VALUE if value is None else f"{value:.3f}"


def _seconds_interval(values: Sequence[float]) -> str:
    interval = mean_interval(values)
    return NO_VALUE if interval is None else f"{interval[0]:.3f} to {interval[1]:.3f}"


def percent_interval(count: int, n: int) -> str:
    """Wilson's 95 % interval of a rate, in percent."""
    low, high = wilson_interval(count, n)
    return f"{100 * low:.1f} to {100 * high:.1f}"


def percent_rate(count: int, n: int, digits: int = 1) -> str:
    """A rate in percent with Wilson's 95 % interval."""
    return f"{100 * count / n:.{digits}f} ({percent_interval(count, n)})"


def percent_gain(difference: tuple[float, float, float], digits: int = 1) -> str:
    """A difference of rates in points with its interval, as of `statistics.paired_difference`."""
    mean, *ends = (f"{100 * value:+.{digits}f}" for value in difference)
    return f"{mean} ({' to '.join(ends)})"


def table(header: Sequence[str], rows: Sequence[Sequence[object]], keys: int = 1, width: int = _WIDTH) -> str:
    """A Markdown table; one too wide to be read is cut into several, which all begin with the same columns.

    Args:
        header: Titles.
        rows: Cells.
        keys: Columns that tell which row it is.
        width: Characters that fit (a column alone may be wider).
    """
    cells = [[str(cell) for cell in row] for row in (header, *rows)]
    sizes = [max(len(row[column]) for row in cells) + 3 for column in range(len(header))]
    first = sum(sizes[:keys]) + 1
    parts: list[list[int]] = [[]]
    for column in range(keys, len(header)):
        taken = first + sum(sizes[other] for other in parts[-1])
        if parts[-1] and taken + sizes[column] > width:
            parts.append([])
        parts[-1].append(column)
    return "\n\n".join(_part(cells, [*range(min(keys, len(header))), *part]) for part in parts)


def _part(cells: Sequence[Sequence[str]], columns: Sequence[int]) -> str:
    chosen = [[row[column] for column in columns] for row in cells]
    return str(tabulate.tabulate(chosen[1:], headers=chosen[0], tablefmt="github", disable_numparse=True))
