"""Report of an evaluation: official metrics with confidence intervals, as text and JSON.

The text has a heading, the official table, outcomes by object, further metrics and notes.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

from handover_marl.config import TIME_STEP
from handover_marl.datasets import DATASET_TITLES
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import STATE
from handover_marl.evaluation.reports.fluency_tables import (
    FLUENCY_NOTE,
    compute_fluency_means,
    format_fluency_header,
    format_fluency_row,
)
from handover_marl.evaluation.reports.published import PUBLISHED, SOURCES, PublishedResult
from handover_marl.evaluation.reports.statistics import (
    compute_mean_interval,
    compute_paired_difference,
    compute_wilson_interval,
)
from handover_marl.evaluation.reports.tables import (
    NO_VALUE,
    ReportTable,
    format_interval,
    format_percent_interval,
    format_seconds,
    join_sections,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD, ResultMetadata
from handover_marl.geometry.panda import PANDA

#: Statuses whose rates are reported.
REPORTED_STATUSES = (
    EpisodeStatus.SUCCESS,
    EpisodeStatus.HUMAN_CONTACT,
    EpisodeStatus.OBJECT_DROP,
    EpisodeStatus.TIMEOUT,
)
_COLUMNS = ["success %", "contact %", "drop %", "timeout %", "AS %", "wait s", "exec s", "plan s", "total s"]


@dataclass(frozen=True)
class Report:
    """Report of an evaluation, with all its metrics. `str(report)` is tables in Markdown.

    Attributes:
        metadata: Identity of the evaluation: policies, scenes, physics and versions.
        episodes: One result per scene, in the split's order.
        n_split_scenes: Number of scenes in the whole split; fewer episodes make the report partial.
        n_resumed: Number of episodes that come from an earlier run in the same folder.
    """

    metadata: ResultMetadata
    episodes: tuple[EpisodeResult, ...]
    n_split_scenes: int
    n_resumed: int = 0

    @property
    def success_rate(self) -> float:
        """Share of episodes with success and no failure (0..1)."""
        return self.compute_rate(EpisodeStatus.SUCCESS)

    @property
    def contact_rate(self) -> float:
        """Share of episodes in which the robot touched the person (0..1)."""
        return self.compute_rate(EpisodeStatus.HUMAN_CONTACT)

    @property
    def drop_rate(self) -> float:
        """Share of episodes in which the object fell (0..1)."""
        return self.compute_rate(EpisodeStatus.OBJECT_DROP)

    @property
    def timeout_rate(self) -> float:
        """Share of episodes that took 13 s without success (0..1)."""
        return self.compute_rate(EpisodeStatus.TIMEOUT)

    @property
    def average_success(self) -> float:
        """Average success (AS): mean of 1 - t / 13 s for successes and 0 for failures (0..1).

        Success and speed in one number, as reported by GenH2R (Wang et al., CVPR 2024); t is the
        simulated time to success.
        """
        return float(np.mean(self.speed_scores))

    @property
    def time_exec(self) -> float | None:
        """Mean simulated time to success (s), over successes; None without successes."""
        return _mean(self.exec_times)

    @property
    def time_plan(self) -> float | None:
        """Mean wall-clock time in the policy (s), over successes; None without successes."""
        return _mean(self.plan_times)

    @property
    def time_total(self) -> float | None:
        """Sum of `time_exec` and `time_plan` (s); None without successes."""
        if self.time_exec is None or self.time_plan is None:
            return None
        return self.time_exec + self.time_plan

    @property
    def is_partial(self) -> bool:
        """Whether only a part of the split's scenes was evaluated."""
        return len(self.episodes) < self.n_split_scenes

    @property
    def exec_times(self) -> list[float]:
        """Simulated time of every success (s)."""
        return [episode.steps * TIME_STEP for episode in self.episodes if episode.success]

    @property
    def plan_times(self) -> list[float]:
        """Wall-clock time in the receiver's policy of every success (s)."""
        return [episode.plan_time_s for episode in self.episodes if episode.success]

    @property
    def speed_scores(self) -> list[float]:
        """Terms of the metric average success, one per scene (0..1)."""
        return [episode.speed_score for episode in self.episodes]

    @property
    def machine_label(self) -> str:
        """Description of the machines on which the receiver's policy was timed."""
        machines = sorted({episode.machine or "an unknown machine" for episode in self.episodes})
        return " and ".join(machines)

    @property
    def data_label(self) -> str:
        """Description of the dataset: name, objects per scene, and substitutes for HandoverSim's models."""
        name = DATASET_TITLES.get(self.metadata.dataset, self.metadata.dataset)
        counts = sorted({episode.n_objects for episode in self.episodes if episode.n_objects is not None})
        models = sorted({episode.models for episode in self.episodes if episode.models})
        return ", ".join(filter(None, (name, _describe_object_count(counts), " or ".join(models))))

    def count(self, status: EpisodeStatus) -> int:
        """Count the episodes with a status flag."""
        return sum(bool(episode.status & status) for episode in self.episodes)

    def compute_rate(self, status: EpisodeStatus) -> float:
        """Compute the share of episodes with a status flag (0..1)."""
        return self.count(status) / len(self.episodes)

    @property
    def heading(self) -> str:
        """Evaluated scenes, policies, physics, data and code versions of the report."""
        metadata = self.metadata
        without = f" without {metadata.missing_package}" if metadata.missing_package else ""
        hashes = " and ".join(filter(None, (metadata.receiver_hash, metadata.giver_hash)))
        code = f", code {hashes}" if hashes else ""
        return (
            f"{metadata.setup} {metadata.split}, {self.extent}. Receiver {self.policies_label}, "
            f"{metadata.physics} physics{without}, data: {self.data_label}. handover_marl {metadata.version}{code}."
        )

    @property
    def policies_label(self) -> str:
        """Description of the receiver (wait, observation mode, robot) and the giver."""
        metadata = self.metadata
        details = [f"wait {metadata.wait_s} s" if metadata.wait_s else ""]
        details += [] if metadata.obs_mode == STATE else [f"obs_mode {metadata.obs_mode}", metadata.camera]
        details += [] if metadata.robot == PANDA else [f"robot {metadata.robot}"]
        text = ", ".join(filter(None, details))
        return f"{metadata.receiver}{f' ({text})' if text else ''}, giver {metadata.giver}"

    @property
    def extent(self) -> str:
        """Description of the share of the split that was evaluated."""
        n = len(self.episodes)
        shard = self.metadata.shard.partition(" ")[0]
        if self.is_partial or shard:
            return f"{n} of {self.n_split_scenes} scenes (partial{f', shard {shard}' if shard else ''})"
        return f"all {n} scenes"

    @property
    def wait_label(self) -> str:
        """Time that the receiver waits (s), or a dash if it is unknown."""
        return self.metadata.wait_s or NO_VALUE

    def format_notes(self) -> str:
        """List the definitions and restrictions needed to read the tables, one per line."""
        lines = [
            "Rates over all scenes, times over successes. Intervals: Wilson for rates, bootstrap for means.",
            "AS: mean over all scenes of 1 - exec / 13 s for successes, 0 for failures.",
            "wait s: time that the robot waits before it approaches.",
            f"plan s is wall clock, measured on {self.machine_label}.",
        ]
        if self.n_resumed:
            lines.append(f"{self.n_resumed} of the {len(self.episodes)} episodes come from an earlier run.")
        if self.metadata.world != OFFICIAL_WORLD:
            lines.append(f"World or rules are not the official ones ({self.metadata.world}).")
        if self.metadata.physics != "exact":
            lines.append("Official results use exact physics; compare the outcomes with handover-marl agreement.")
        if self.metadata.dataset == "synthetic":
            lines.append("Synthetic scenes are generated: not comparable with published results, which are on DexYCB.")
        comparable = _find_comparable_rows(self.metadata)
        if comparable:
            lines += [
                "Published, on DexYCB with all objects and MANO hands, times on the authors' machines:",
                "GA-DDPG and handover-sim2real use the Panda with the camera (panda_camera), the others without.",
            ]
            lines += [f"{SOURCES[source]}." for source in dict.fromkeys(row.source for row in comparable)]
        return "\n".join(lines)

    def build_official_table(self) -> ReportTable:
        """Build the table of official metrics with 95 % intervals, and of published results."""
        n = len(self.episodes)
        rates = [f"{100 * self.count(flag) / n:.2f} ({self.count(flag)}/{n})" for flag in REPORTED_STATUSES]
        times = [format_seconds(value) for value in (self.time_exec, self.time_plan, self.time_total)]
        intervals = [format_percent_interval(self.count(flag), n) for flag in REPORTED_STATUSES]
        score_interval = format_interval(compute_mean_interval(self.speed_scores))
        time_intervals = [
            format_interval(compute_mean_interval(values), ".3f", 1.0) for values in (self.exec_times, self.plan_times)
        ]
        rows = [
            [self.metadata.receiver, *rates, f"{100 * self.average_success:.2f}", self.wait_label, *times],
            ["95 % interval", *intervals, score_interval, NO_VALUE, *time_intervals, NO_VALUE],
            *(_format_published_row(row) for row in _find_comparable_rows(self.metadata)),
        ]
        return ReportTable(["", *_COLUMNS], rows, split_column=1 + _COLUMNS.index("AS %"))

    def build_object_table(self) -> ReportTable:
        """Build the table of outcomes by object class."""
        names = sorted({episode.object_name for episode in self.episodes if episode.object_name})
        rows = []
        for name in names:
            episodes = [episode for episode in self.episodes if episode.object_name == name]
            counts = [sum(bool(episode.status & flag) for episode in episodes) for flag in REPORTED_STATUSES]
            interval = format_percent_interval(counts[0], len(episodes))
            rows.append([name, len(episodes), *counts, f"{100 * counts[0] / len(episodes):.1f}", interval])
        header = ["object", "scenes", "success", "contact", "drop", "timeout", "success %", "95 % interval"]
        return ReportTable(header, rows)

    def build_fluency_table(self) -> ReportTable:
        """Build the table of fluency metrics; without rows if no episode has fluency metrics."""
        header = ["beyond the official metrics", "mean", "95 % interval"]
        if not compute_fluency_means(self.episodes):
            return ReportTable(header, [])
        cells = [cell.removesuffix(")").split(" (") for cell in format_fluency_row(self.episodes)]
        rows = [[name, *cell, NO_VALUE][:3] for name, cell in zip(format_fluency_header(), cells, strict=True)]
        return ReportTable(header, rows)

    def __str__(self) -> str:
        """Format heading, official table, outcomes by object class and fluency metrics."""
        fluency = self.build_fluency_table()
        tables = self.build_official_table(), self.build_object_table()
        further = (fluency, FLUENCY_NOTE) if fluency.rows else ()
        return join_sections(self.heading, *tables, self.format_notes(), *further)

    def to_markdown(self) -> str:
        """Return the report as a Markdown page, with a table that has one row per scene."""
        return f"# Handover benchmark\n\n{self}\n\n## Scenes\n\n{build_scene_table(self.episodes)}\n"

    def to_json(self) -> dict[str, object]:
        """Return metrics and episodes as JSON types; rates 0..1, 95 % intervals, times in s."""
        n = len(self.episodes)
        return {
            **asdict(self.metadata),
            "data": self.data_label,
            "machine": self.machine_label,
            "n_episodes": n,
            "n_resumed": self.n_resumed,
            "n_split_scenes": self.n_split_scenes,
            "rates": {
                flag.label: {
                    "rate": self.compute_rate(flag),
                    "interval_95": compute_wilson_interval(self.count(flag), n),
                }
                for flag in REPORTED_STATUSES
            },
            "average_success": {
                "mean": self.average_success,
                "interval_95": compute_mean_interval(self.speed_scores),
            },
            "times": {
                "exec": {"mean": self.time_exec, "interval_95": compute_mean_interval(self.exec_times)},
                "plan": {"mean": self.time_plan, "interval_95": compute_mean_interval(self.plan_times)},
                "total": {"mean": self.time_total},
            },
            "fluency": {key: asdict(value) for key, value in compute_fluency_means(self.episodes).items()},
            "episodes": [
                {**asdict(episode), "status": int(episode.status), "outcome": episode.status.label}
                for episode in self.episodes
            ],
        }


def compute_rate_difference(
    first: Iterable[EpisodeResult], second: Iterable[EpisodeResult], flag: EpisodeStatus
) -> tuple[float, float, float]:
    """Compute the difference of an outcome's rates in two evaluations of the same scenes.

    Args:
        first: Results whose rate is the minuend.
        second: Results of the same scenes, whose rate is subtracted.
        flag: Outcome whose rates are compared, e.g. success.

    Returns:
        Difference, lower and upper end of its 95 % interval (-1..1).
    """
    flags = ([bool(episode.status & flag) for episode in episodes] for episodes in (first, second))
    return compute_paired_difference(*flags)


def build_scene_table(episodes: Iterable[EpisodeResult]) -> ReportTable:
    """Build the table of outcomes with one row per scene."""
    header = ["scene", "object", "subject", "hand", "outcome", "steps", "release step", "plan s"]
    return ReportTable(header, [format_scene_cells(episode) for episode in episodes])


def build_difference_table(pairs: Iterable[tuple[EpisodeResult, EpisodeResult]], names: tuple[str, str]) -> ReportTable:
    """Build the table of scenes with different outcomes.

    Args:
        pairs: Results of the same scenes in two evaluations.
        names: Column titles of the two outcomes.
    """
    rows = []
    for pair in pairs:
        if pair[0].status != pair[1].status:
            scene, name, *_ = format_scene_cells(pair[0])
            outcomes = [cell for result in pair for cell in format_scene_cells(result)[4:7]]
            rows.append([scene, name, *outcomes])
    header = ["scene", "object", *(title for name in names for title in (name, "steps", "release"))]
    return ReportTable(header, rows)


def format_scene_cells(episode: EpisodeResult) -> list[str]:
    """Format scene, object, subject, hand, outcome, steps, release step and planning time of an episode."""
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


def _describe_object_count(counts: list[int]) -> str:
    if not counts:
        return ""
    if counts == [1]:
        return "1 object a scene"
    return f"{counts[0]} to {counts[-1]} objects a scene" if len(counts) > 1 else f"{counts[0]} objects a scene"


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
