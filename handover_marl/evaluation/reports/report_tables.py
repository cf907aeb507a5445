"""Text of a report: heading, official table, outcomes by object, further metrics and notes."""

from collections.abc import Iterable, Sequence

from handover_marl.episode.spaces import STATE
from handover_marl.evaluation.reports.fluency_tables import (
    FLUENCY_NOTE,
    compute_fluency_means,
    format_fluency_header,
    format_fluency_row,
)
from handover_marl.evaluation.reports.metrics import REPORTED_STATUSES, OfficialMetrics
from handover_marl.evaluation.reports.published import PUBLISHED, SOURCES, PublishedResult
from handover_marl.evaluation.reports.statistics import compute_mean_interval
from handover_marl.evaluation.reports.tables import (
    NO_VALUE,
    ReportTable,
    format_percent_interval,
    format_seconds,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD, ResultMetadata
from handover_marl.geometry.panda import PANDA

_COLUMNS = ["success %", "contact %", "drop %", "timeout %", "AS %", "wait s", "exec s", "plan s", "total s"]


def format_report(report: OfficialMetrics) -> str:
    """Format heading, official table, outcomes by object class and fluency metrics of a report."""
    fluency = build_fluency_table(report)
    parts = [format_heading(report), build_official_table(report), build_object_table(report), format_notes(report)]
    parts += [f"{fluency}\n\n{FLUENCY_NOTE}"] if fluency.rows else []
    return "\n\n".join(str(part) for part in parts if str(part))


def format_report_markdown(report: OfficialMetrics) -> str:
    """Format a report as a Markdown page, with a table that has one row per scene."""
    scenes = build_scene_table(report.episodes)
    return f"# Handover benchmark\n\n{format_report(report)}\n\n## Scenes\n\n{scenes}\n"


def format_heading(report: OfficialMetrics) -> str:
    """Describe the evaluated scenes, policies, physics, data and code versions of a report."""
    metadata = report.metadata
    without = f" without {metadata.missing_package}" if metadata.missing_package else ""
    hashes = " and ".join(filter(None, (metadata.receiver_hash, metadata.giver_hash)))
    code = f", code {hashes}" if hashes else ""
    return (
        f"{metadata.setup} {metadata.split}, {format_extent(report)}. Receiver {format_policies(metadata)}, "
        f"{metadata.physics} physics{without}, data: {report.data_label}. handover_marl {metadata.version}{code}."
    )


def format_policies(metadata: ResultMetadata) -> str:
    """Describe the receiver (wait, observation mode, robot) and the giver of an evaluation."""
    details = [f"wait {metadata.wait_s} s" if metadata.wait_s else ""]
    details += [] if metadata.obs_mode == STATE else [f"obs_mode {metadata.obs_mode}", metadata.camera]
    details += [] if metadata.robot == PANDA else [f"robot {metadata.robot}"]
    text = ", ".join(filter(None, details))
    return f"{metadata.receiver}{f' ({text})' if text else ''}, giver {metadata.giver}"


def format_extent(report: OfficialMetrics) -> str:
    """Describe the share of the split that was evaluated."""
    n = len(report.episodes)
    shard = report.metadata.shard.partition(" ")[0]
    if report.is_partial or shard:
        return f"{n} of {report.n_split_scenes} scenes (partial{f', shard {shard}' if shard else ''})"
    return f"all {n} scenes"


def format_wait(report: OfficialMetrics) -> str:
    """Format the time that the receiver waits (s), or a dash if it is unknown."""
    return report.metadata.wait_s or NO_VALUE


def format_notes(report: OfficialMetrics) -> str:
    """List the definitions and restrictions needed to read a report's tables, one per line."""
    lines = [
        "Rates over all scenes, times over successes. Intervals: Wilson for rates, bootstrap for means.",
        "AS: mean over all scenes of 1 - exec / 13 s for successes, 0 for failures.",
        "wait s: time that the robot waits before it approaches.",
        f"plan s is wall clock, measured on {report.machine_label}.",
    ]
    if report.n_resumed:
        lines.append(f"{report.n_resumed} of the {len(report.episodes)} episodes come from an earlier run.")
    if report.metadata.world != OFFICIAL_WORLD:
        lines.append(f"World or rules are not the official ones ({report.metadata.world}).")
    if report.metadata.physics != "exact":
        lines.append("Official results use exact physics; compare the outcomes with handover-marl agreement.")
    if report.metadata.dataset == "synthetic":
        lines.append("Synthetic scenes are generated: not comparable with published results, which are on DexYCB.")
    comparable = _find_comparable_rows(report.metadata)
    if comparable:
        lines.append("Published, on DexYCB with all objects and MANO hands, times on the authors' machines:")
        lines.append("GA-DDPG and handover-sim2real use the Panda with the camera (panda_camera), the others without.")
        lines += [f"{SOURCES[source]}." for source in dict.fromkeys(row.source for row in comparable)]
    return "\n".join(lines)


def build_official_table(report: OfficialMetrics) -> ReportTable:
    """Build the table of official metrics with 95 % intervals, and of published results."""
    n = len(report.episodes)
    rates = [f"{100 * report.count(flag) / n:.2f} ({report.count(flag)}/{n})" for flag in REPORTED_STATUSES]
    times = [format_seconds(value) for value in (report.time_exec, report.time_plan, report.time_total)]
    intervals = [format_percent_interval(report.count(flag), n) for flag in REPORTED_STATUSES]
    time_intervals = [
        _format_seconds_interval(report.exec_times),
        _format_seconds_interval(report.plan_times),
        NO_VALUE,
    ]
    rows = [
        [report.metadata.receiver, *rates, f"{100 * report.average_success:.2f}", format_wait(report), *times],
        ["95 % interval", *intervals, _format_score_interval(report), NO_VALUE, *time_intervals],
        *(_format_published_row(row) for row in _find_comparable_rows(report.metadata)),
    ]
    return ReportTable(["", *_COLUMNS], rows, split_column=1 + _COLUMNS.index("AS %"))


def build_object_table(report: OfficialMetrics) -> ReportTable:
    """Build the table of outcomes by object class."""
    names = sorted({episode.object_name for episode in report.episodes if episode.object_name})
    rows = []
    for name in names:
        episodes = [episode for episode in report.episodes if episode.object_name == name]
        counts = [sum(bool(episode.status & flag) for episode in episodes) for flag in REPORTED_STATUSES]
        interval = format_percent_interval(counts[0], len(episodes))
        rows.append([name, len(episodes), *counts, f"{100 * counts[0] / len(episodes):.1f}", interval])
    header = ["object", "scenes", "success", "contact", "drop", "timeout", "success %", "95 % interval"]
    return ReportTable(header, rows)


def build_fluency_table(report: OfficialMetrics) -> ReportTable:
    """Build the table of fluency metrics; without rows if no episode has fluency metrics."""
    header = ["beyond the official metrics", "mean", "95 % interval"]
    if not compute_fluency_means(report.episodes):
        return ReportTable(header, [])
    cells = zip(format_fluency_header(), format_fluency_row(report.episodes), strict=True)
    rows = [[name, *(cell.removesuffix(")").split(" (") if "(" in cell else (cell, NO_VALUE))] for name, cell in cells]
    return ReportTable(header, rows)


def build_scene_table(episodes: Iterable[EpisodeResult]) -> ReportTable:
    """Build the table of outcomes with one row per scene."""
    header = ["scene", "object", "subject", "hand", "outcome", "steps", "release step", "plan s"]
    return ReportTable(header, [_format_scene_cells(episode) for episode in episodes])


def build_difference_table(pairs: Iterable[tuple[EpisodeResult, EpisodeResult]], names: tuple[str, str]) -> ReportTable:
    """Build the table of scenes with different outcomes.

    Args:
        pairs: Results of the same scenes in two evaluations.
        names: Column titles of the two outcomes.
    """
    rows = []
    for pair in pairs:
        if pair[0].status != pair[1].status:
            scene, name, *_ = _format_scene_cells(pair[0])
            outcomes = [cell for result in pair for cell in _format_scene_cells(result)[4:7]]
            rows.append([scene, name, *outcomes])
    header = ["scene", "object", *(title for name in names for title in (name, "steps", "release"))]
    return ReportTable(header, rows)


def _format_scene_cells(episode: EpisodeResult) -> list[str]:
    known = (episode.scene_id, episode.object_name, episode.subject, episode.side, episode.status.label)
    release_step = NO_VALUE if episode.release_step is None else str(episode.release_step)
    texts = [NO_VALUE if cell is None else str(cell) for cell in known]
    return [*texts, str(episode.steps), release_step, f"{episode.plan_time_s:.3f}"]


def _find_comparable_rows(metadata: ResultMetadata) -> tuple[PublishedResult, ...]:
    identity = (metadata.split, metadata.dataset, metadata.physics, metadata.world)
    return PUBLISHED[metadata.setup] if identity == ("test", "dexycb", "exact", OFFICIAL_WORLD) else ()


def _format_published_row(row: PublishedResult) -> list[str]:
    rates = [f"{rate:.2f}" for rate in (row.success, row.contact, row.drop, row.timeout)]
    times = [format_seconds(value) for value in (row.time_exec, row.time_plan, row.time_total)]
    return [f"published: {row.method}", *rates, f"{row.average_success:.2f}", f"{row.wait_s:g}", *times]


def _format_score_interval(report: OfficialMetrics) -> str:
    interval = compute_mean_interval(report.speed_scores)
    return NO_VALUE if interval is None else f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"


def _format_seconds_interval(values: Sequence[float]) -> str:
    interval = compute_mean_interval(values)
    return NO_VALUE if interval is None else f"{interval[0]:.3f} to {interval[1]:.3f}"
