"""Report of an evaluation: official metrics with confidence intervals, as text and JSON.

The text has a heading, the official table, outcomes by object, further metrics and notes.
"""

import functools
from dataclasses import asdict, dataclass
from typing import Any

from handover_marl.config import TIME_STEP
from handover_marl.datasets.registry import find_dataset_note, format_dataset_title
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import STATE
from handover_marl.evaluation.reports.episode_tables import (
    FLUENCY_NOTE,
    build_fluency_table,
    build_object_table,
    build_scene_table,
    count_status,
    estimate_fluency,
)
from handover_marl.evaluation.reports.published import SOURCES, PublishedResult, find_published_results
from handover_marl.evaluation.reports.statistics import MeanEstimate, compute_wilson_interval, estimate_mean
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    FLUENCY,
    NO_VALUE,
    RATES,
    REPORTED_STATUSES,
    TIMES,
    WAIT,
    ReportTable,
    TabularResult,
    format_csv,
    format_interval,
    format_percent_interval,
    format_seconds,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD, ResultMetadata
from handover_marl.geometry.panda import PANDA

# Fields of an evaluation with which each row of the CSV file of episodes starts.
_IDENTITY = ("receiver", "giver", "setup", "split", "dataset", "physics", "seed", "version")


@dataclass(frozen=True)
class Report(TabularResult):
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

    @functools.cached_property
    def official_means(self) -> dict[str, MeanEstimate]:
        """Means of average success over all episodes and of times (s) over successes, by key."""
        times = [(each.steps * TIME_STEP, each.plan_s) for each in self.episodes if each.success]
        values = [[exec_s for exec_s, _ in times], [plan_s for _, plan_s in times], [sum(pair) for pair in times]]
        return {
            AVERAGE_SUCCESS.key: estimate_mean([episode.speed_score for episode in self.episodes]),
            **{column.key: estimate_mean(part) for column, part in zip(TIMES, values, strict=True)},
        }

    @property
    def average_success(self) -> float:
        """Average success (AS): mean of 1 - t / 13 s for successes and 0 for failures (0..1).

        Success and speed in one number, as reported by GenH2R (Wang et al., CVPR 2024); t is the
        simulated time to success.
        """
        return self.official_means[AVERAGE_SUCCESS.key].mean or 0.0

    @property
    def time_exec(self) -> float | None:
        """Mean simulated time to success (s), over successes; None without successes."""
        return self.official_means["exec_s"].mean

    @property
    def time_plan(self) -> float | None:
        """Mean wall-clock time in the policy (s), over successes; None without successes."""
        return self.official_means["plan_s"].mean

    @property
    def time_total(self) -> float | None:
        """Mean sum of both times (s), over successes; None without successes."""
        return self.official_means["total_s"].mean

    @property
    def is_partial(self) -> bool:
        """Whether only a part of the split's scenes was evaluated."""
        return len(self.episodes) < self.n_split_scenes

    @property
    def machine_label(self) -> str:
        """Description of the machines on which the receiver's policy was timed."""
        machines = sorted({episode.machine or "an unknown machine" for episode in self.episodes})
        return " and ".join(machines)

    @property
    def data_label(self) -> str:
        """Description of the dataset: name, objects per scene, and substitutes for HandoverSim's models."""
        name = format_dataset_title(self.metadata.dataset)
        counts = sorted({episode.n_objects for episode in self.episodes if episode.n_objects is not None})
        models = sorted({episode.models for episode in self.episodes if episode.models})
        return ", ".join(filter(None, (name, _describe_object_count(counts), " or ".join(models))))

    def count(self, status: EpisodeStatus) -> int:
        """Count the episodes with a status flag."""
        return count_status(self.episodes, status)

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
            "AS (average success): mean over all scenes of 1 - exec / 13 s for successes, 0 for failures.",
            "wait s: time that the robot waits before it approaches.",
            f"plan s is wall clock, measured on {self.machine_label}.",
        ]
        if self.n_resumed:
            lines.append(f"{self.n_resumed} of the {len(self.episodes)} episodes come from an earlier run.")
        if self.metadata.world != OFFICIAL_WORLD:
            lines.append(f"World or rules are not the official ones ({self.metadata.world}).")
        if self.metadata.physics != "exact":
            lines.append("Official results use exact physics; compare the outcomes with handover-marl agreement.")
        if note := find_dataset_note(self.metadata.dataset):
            lines.append(note)
        comparable = find_published_results(self.metadata)
        if comparable:
            lines += [
                "Published, on DexYCB with all objects and MANO hands, times on the authors' machines:",
                "* The authors report no AS; it is derived from their success rate and mean time.",
                "GA-DDPG and handover-sim2real use the Panda with the camera (panda_camera), the others without.",
            ]
            lines += [f"{SOURCES[source]}." for source in dict.fromkeys(row.source for row in comparable)]
        return "\n".join(lines)

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of official metrics, outcomes by object class and fluency metrics."""
        return [self._build_official_table(), build_object_table(self.episodes), build_fluency_table(self.episodes)]

    def _build_official_table(self) -> ReportTable:
        """Build the table of official metrics with 95 % intervals, and of published results."""
        n, means = len(self.episodes), self.official_means
        score, times = means[AVERAGE_SUCCESS.key], [means[column.key] for column in TIMES]
        counts = [self.count(flag) for flag in REPORTED_STATUSES]
        rates = [f"{100 * count / n:.2f} ({count}/{n})" for count in counts]
        cells = [f"{100 * self.average_success:.2f}", self.wait_label, *(format_seconds(each.mean) for each in times)]
        rate_intervals = [format_percent_interval(count, n) for count in counts]
        # The interval of the total would not fit into the width.
        time_intervals = [*(format_interval(each.interval_95, ".3f", 1.0) for each in times[:-1]), NO_VALUE]
        rows: list[list[object]] = [
            [self.metadata.receiver, *rates, *cells],
            ["95 % interval", *rate_intervals, format_interval(score.interval_95), NO_VALUE, *time_intervals],
            ["n", *[n] * len(RATES), score.n, NO_VALUE, *(each.n for each in times)],
            *(_format_published_row(row) for row in find_published_results(self.metadata)),
        ]
        header = ["receiver", *(column.title for column in (*RATES, AVERAGE_SUCCESS, WAIT, *TIMES))]
        return ReportTable(header, rows, split_column=header.index(AVERAGE_SUCCESS.title))

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and notes."""
        official, objects, fluency = self.build_tables()
        note = FLUENCY_NOTE if fluency.rows else ""
        return [self.heading, official, objects, self.format_notes(), fluency, note]

    def to_markdown(self) -> str:
        """Return the report as a Markdown page, with a table that has one row per scene."""
        return f"# Handover benchmark\n\n{self}\n\n## Scenes\n\n{build_scene_table(self.episodes)}\n"

    def to_json(self) -> dict[str, Any]:
        """Return metrics and episodes as JSON types; rates 0..1, 95 % intervals, times in s."""
        n, means = len(self.episodes), self.official_means
        return {
            **self.metadata.to_dict(),
            "data": self.data_label,
            "machine": self.machine_label,
            "n_episodes": n,
            "n_resumed": self.n_resumed,
            "n_split_scenes": self.n_split_scenes,
            "rates": {
                flag.label: {
                    "rate": self.compute_rate(flag),
                    "interval_95": compute_wilson_interval(self.count(flag), n),
                    "n": n,
                }
                for flag in REPORTED_STATUSES
            },
            AVERAGE_SUCCESS.key: asdict(means[AVERAGE_SUCCESS.key]),
            "times": {column.key: asdict(means[column.key]) for column in TIMES},
            "fluency": {key: asdict(mean) for key, mean in estimate_fluency(self.episodes).items()},
            "episodes": [describe_episode(episode) for episode in self.episodes],
        }

    def format_episodes_csv(self) -> str:
        """Return CSV text with one row per episode, under the keys of `report.json`.

        Every row starts with the identity of the evaluation. Numbers have full precision, in the units
        of `report.json`; missing values are empty.
        """
        identity = {key: getattr(self.metadata, key) for key in _IDENTITY}
        rows: list[dict[str, Any]] = []
        for episode in self.episodes:
            values = describe_episode(episode)
            fluency = values.pop("fluency") or {column.key: None for column in FLUENCY}
            rows.append({**identity, **values, **fluency})
        return format_csv([list(rows[0]), *(list(row.values()) for row in rows)])


def describe_episode(episode: EpisodeResult) -> dict[str, Any]:
    """Return the values of an episode as JSON types, by key; metrics are in the dictionary `fluency`."""
    return {**asdict(episode), "status": int(episode.status), "outcome": episode.status.label}


def _format_published_row(row: PublishedResult) -> list[object]:
    rates = [f"{rate:.2f}" for rate in (row.success, row.contact, row.drop, row.timeout)]
    times = [format_seconds(value) for value in (row.time_exec, row.time_plan, row.time_total)]
    return [f"published: {row.method}", *rates, f"{row.average_success:.2f}*", f"{row.wait_s:g}", *times]


def _describe_object_count(counts: list[int]) -> str:
    if not counts:
        return ""
    ends = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
    return f"{ends} object{'' if counts == [1] else 's'} a scene"
