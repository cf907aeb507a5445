"""Reports of evaluations: official metrics with 95 % intervals, as text, JSON and web pages, and as files.

The text has a heading, the official table, outcomes by object, further metrics and notes.
"""

import functools
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP
from handover_marl.datasets.registry import find_dataset_note, format_dataset_title
from handover_marl.datasets.splits import SETUPS, list_split_scenes
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import STATE
from handover_marl.errors import ResultsError
from handover_marl.evaluation.config import format_inference_time
from handover_marl.evaluation.metadata import OFFICIAL_WORLD, ResultMetadata, read_result_metadata
from handover_marl.evaluation.reports.published import SOURCES, PublishedResult, find_published_results
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    FLUENCY,
    FLUENCY_NOTE,
    N_EPISODES,
    NO_VALUE,
    RATES,
    REPORTED_STATUSES,
    SCENE_HEADER,
    TIMES,
    WAIT,
    Estimate,
    ReportTable,
    TabularResult,
    build_fluency_table,
    build_object_table,
    build_scene_table,
    count_status,
    estimate_average_success,
    estimate_fluency,
    estimate_mean,
    estimate_rate,
    format_csv,
    format_scene_cells,
    get_scene_header,
)
from handover_marl.evaluation.results import (
    REPLAYS,
    REPORT_FILES,
    EpisodeResult,
    describe_episode,
    find_numbered,
    read_episode_file,
    read_results,
)
from handover_marl.execution.files import render_template, write_atomically
from handover_marl.execution.options import check_path
from handover_marl.geometry.panda import PANDA
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS
from handover_marl.version import __version__

# Data sets with the scene numbers of DexYCB.
_OFFICIAL_SCENES = ("dexycb", "synthetic")
# Fields of an evaluation with which each row of the CSV file of episodes starts.
_IDENTITY = ("receiver", "giver", "setup", "split", "dataset", "physics", "seed", "version", "inference_time")


@dataclass(frozen=True)
class Report(TabularResult):
    """Report of an evaluation, with all its metrics. `str(report)` is tables in Markdown.

    Attributes:
        metadata: Identity of the evaluation: policies, scenes, physics and versions.
        episodes: One result per scene, in the split's order.
        n_resumed: Number of episodes that come from an earlier run in the same folder.
    """

    metadata: ResultMetadata
    episodes: tuple[EpisodeResult, ...]
    n_resumed: int = 0

    @property
    def success_rate(self) -> float:
        """Share of episodes with success and no failure (0..1)."""
        return self.compute_rate(EpisodeStatus.SUCCESS)

    @functools.cached_property
    def rates(self) -> dict[str, Estimate]:
        """Rates (0..1) of success, contact, drop and timeout, by these words."""
        return {flag.label: estimate_rate(self.count(flag), len(self.episodes)) for flag in REPORTED_STATUSES}

    @functools.cached_property
    def official_means(self) -> dict[str, Estimate]:
        """Estimates by key: average success `AS` (0..1); mean times of successes `exec_s`, `plan_s`, `total_s` (s)."""
        times = [(each.steps * TIME_STEP, each.plan_s) for each in self.episodes if each.success]
        values = [[exec_s for exec_s, _ in times], [plan_s for _, plan_s in times], [sum(pair) for pair in times]]
        return {
            AVERAGE_SUCCESS.key: estimate_average_success([episode.speed_score for episode in self.episodes]),
            **{column.key: estimate_mean(part) for column, part in zip(TIMES, values, strict=True)},
        }

    @property
    def average_success(self) -> float:
        """Average success (AS): mean of 1 - t / 13 s for successes and 0 for failures (0..1).

        GenH2R (Wang et al., CVPR 2024) reports this score; t is the simulated time to success (s).
        """
        return self.official_means[AVERAGE_SUCCESS.key].mean or 0.0

    @property
    def is_partial(self) -> bool:
        """Whether only a part of the split's scenes was evaluated."""
        return len(self.episodes) < self.metadata.split_size

    @property
    def machine_label(self) -> str:
        """Description of the machines on which the planning times `plan_s` were measured."""
        machines = sorted({episode.machine or "an unknown machine" for episode in self.episodes})
        return " and ".join(machines)

    @property
    def data_label(self) -> str:
        """Description of the dataset: name, objects per scene, and substitutes for HandoverSim's models."""
        name = format_dataset_title(self.metadata.dataset)
        counts = sorted({episode.n_objects for episode in self.episodes if episode.n_objects is not None})
        models = sorted({episode.models for episode in self.episodes if episode.models})
        ends = " to ".join(str(count) for count in dict.fromkeys((*counts[:1], *counts[-1:])))
        objects = f"{ends} object{'' if counts == [1] else 's'} a scene" if counts else ""
        return ", ".join(filter(None, (name, objects, " or ".join(models))))

    def count(self, status: EpisodeStatus) -> int:
        """Count the episodes with a status flag."""
        return count_status(self.episodes, status)

    def compute_rate(self, status: EpisodeStatus) -> float:
        """Compute the share of episodes with a status flag (0..1)."""
        return self.count(status) / len(self.episodes)

    @property
    def heading(self) -> str:
        """Description of the evaluated scenes, policies, physics, data and code versions, as text."""
        metadata = self.metadata
        details = [
            f"wait {metadata.wait_s} s" if metadata.wait_s else "",
            *([] if metadata.obs_mode == STATE else [f"obs_mode {metadata.obs_mode}", metadata.camera]),
            "" if metadata.robot == PANDA else f"robot {metadata.robot}",
            format_inference_time(metadata.inference_time),
        ]
        text = ", ".join(filter(None, details))
        receiver = f"{metadata.receiver} ({text})" if text else metadata.receiver
        hashes = " and ".join(filter(None, (metadata.receiver_hash, metadata.giver_hash)))
        code = f", code {hashes}" if hashes else ""
        return (
            f"{metadata.setup} {metadata.split}, {self.extent}. Receiver {receiver}, giver {metadata.giver}, "
            f"{metadata.simulation_label}, data: {self.data_label}. handover_marl {metadata.version}{code}."
        )

    @property
    def extent(self) -> str:
        """Number of evaluated scenes as text: "all 144 scenes", or "9 of 144 scenes (partial)"."""
        n = len(self.episodes)
        return f"{n} of {self.metadata.split_size} scenes (partial)" if self.is_partial else f"all {n} scenes"

    def format_notes(self) -> str:
        """Return notes on the definitions and restrictions that a reader of the tables needs, one per line."""
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
        if label := format_inference_time(self.metadata.inference_time):
            lines.append(f"Not comparable with official results: the person does not wait for the policy ({label}).")
        if self.metadata.physics != "exact":
            lines.append("Official results use exact physics; compare the outcomes with handover-marl compare.")
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

    def _build_official_table(self) -> ReportTable:
        """Build the table of official metrics, all but the total time with 95 % intervals, and of published results."""
        n, (score, *times), rates = len(self.episodes), self.official_means.values(), list(self.rates.values())
        counts = [f"{100 * self.compute_rate(flag):.2f} ({self.count(flag)}/{n})" for flag in REPORTED_STATUSES]
        wait = self.metadata.wait_s or NO_VALUE
        means = [NO_VALUE if each.mean is None else f"{each.mean:.3f}" for each in times]
        cells = [f"{100 * self.average_success:.2f}", wait, *means]
        intervals = [*(each.format_interval() for each in (*rates, score)), NO_VALUE]
        # The interval of the total would not fit into the width.
        intervals += [*(each.format_interval(".3f", 1.0) for each in times[:-1]), NO_VALUE]
        rows: list[list[object]] = [
            [self.metadata.receiver, *counts, *cells],
            ["95 % interval", *intervals],
            ["n", *(each.n for each in (*rates, score)), NO_VALUE, *(each.n for each in times)],
            *(_format_published_row(row) for row in find_published_results(self.metadata)),
        ]
        header = ["receiver", *(column.title for column in (*RATES, AVERAGE_SUCCESS, WAIT, *TIMES))]
        return ReportTable(header, rows, split_column=header.index(AVERAGE_SUCCESS.title))

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and notes."""
        fluency = build_fluency_table(estimate_fluency(self.episodes))
        tables = [self._build_official_table(), build_object_table(self.episodes)]
        return [self.heading, *tables, self.format_notes(), fluency, FLUENCY_NOTE if fluency.rows else ""]

    def to_json(self) -> dict[str, Any]:
        """Return metrics with 95 % intervals, and episodes, as JSON types; rates 0..1, times in s."""
        n, means = len(self.episodes), self.official_means
        return {
            **self.metadata.to_dict(),
            "data": self.data_label,
            "machine": self.machine_label,
            "n_episodes": n,
            "n_resumed": self.n_resumed,
            "n_split_scenes": self.metadata.split_size,
            "rates": {
                key: {"rate": rate.mean, "interval_95": rate.interval_95, "n": n} for key, rate in self.rates.items()
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
        known = self.metadata.to_dict()
        identity = {key: known[key] for key in _IDENTITY if key in known}
        rows: list[dict[str, Any]] = []
        for episode in self.episodes:
            values = describe_episode(episode)
            fluency = values.pop("fluency") or {column.key: None for column in FLUENCY}
            rows.append({**identity, **values, **fluency})
        return format_csv([[*rows[0]], *([*row.values()] for row in rows)])


@dataclass(frozen=True)
class ReportList(TabularResult):
    """Reports of several evaluations. `str(reports)` is a table in Markdown with a row for each.

    Attributes:
        reports: Reports of the evaluations, which may have different conditions.
    """

    reports: tuple[Report, ...]

    def build_sections(self) -> list[str | ReportTable]:
        """Build the table of conditions, rates, AS and time of the evaluations, and a note."""
        rows = []
        for report in self.reports:
            metadata, means = report.metadata, report.official_means
            scenes, version = f"{metadata.setup} {metadata.split}", metadata.version
            condition = [scenes, report.data_label, metadata.simulation_label, version, metadata.wait_s or NO_VALUE]
            rates = [estimate.format() for estimate in (*report.rates.values(), means[AVERAGE_SUCCESS.key])]
            time = means[TIMES[0].key].format(".3f", scale=1.0)
            rows.append([metadata.receiver, metadata.giver, *condition, *rates, time, len(report.episodes)])
        titles = [column.title for column in (WAIT, *RATES, AVERAGE_SUCCESS, TIMES[0], N_EPISODES)]
        table = ReportTable(["receiver", "giver", "scenes", "data", "simulation", "version", *titles], rows, n_keys=2)
        return [table, "95 % intervals: Wilson for rates, bootstrap for AS and times. Times over successes."]


def _format_published_row(row: PublishedResult) -> list[object]:
    rates = [f"{rate:.2f}" for rate in (row.success, row.contact, row.drop, row.timeout)]
    times = [f"{value:.3f}" for value in (row.time_exec, row.time_plan, row.time_total)]
    return [f"published: {row.method}", *rates, f"{row.average_success:.2f}*", f"{row.wait_s:g}", *times]


def load_report(folder: str | os.PathLike[str]) -> Report:
    """Compute the report of a result folder, written by this library or by HandoverSim, or of a file of outcomes.

    Args:
        folder: Result folder, or a file of outcomes from `docs/results/data/episodes`; nothing is changed.

    Raises:
        ResultsError: The path does not exist, or a file is not an official result.
    """
    path = check_path("folder", folder)
    # Unlike `Path.is_file`, this is False if the path may not be read.
    is_file = os.path.isfile(path)  # noqa: PTH113
    metadata, results = read_episode_file(path) if is_file else (read_result_metadata(path), read_results(path))
    size = metadata.split_size
    if results[-1].index >= size:
        raise ResultsError(
            f"{path}: {results[-1].index:03d}.npz exceeds {metadata.setup} {metadata.split}, which has {size} scenes"
        )
    # HandoverSim's code may count the step in which the time is up.
    longest = OFFICIAL_CONFIG.protocol.horizon_steps + 1
    for result in results if metadata.world == OFFICIAL_WORLD else ():
        if result.steps > longest:
            raise ResultsError(
                f"{path}: {result.index:03d}.npz must have at most {longest} steps by the official rules, got "
                f"{result.steps}; delete it and run the scene again"
            )
    return Report(metadata, tuple(_add_scene_info(path, metadata, results)))


def format_report_files(folder: Path, report: Report) -> dict[str, str]:
    """Return the contents of a report's files by name: JSON, Markdown, web page and CSV.

    The page links to replay pages in the result folder `folder`.
    """
    contents = (
        json.dumps(report.to_json(), indent=2, allow_nan=False) + "\n",
        f"# Handover benchmark\n\n{report}\n\n## Scenes\n\n{build_scene_table(report.episodes)}\n",
        render_report_page(report, find_replay_links(folder, folder)),
        report.format_episodes_csv(),
    )
    return dict(zip(REPORT_FILES, contents, strict=True))


def write_report(folder: Path, report: Report) -> None:
    """Write `report.json`, `report.md`, `report.html` and `episodes.csv` into a result folder."""
    for name, content in format_report_files(folder, report).items():
        write_atomically(folder / name, content)


def _add_scene_info(path: Path, metadata: ResultMetadata, results: Iterable[EpisodeResult]) -> Iterator[EpisodeResult]:
    """Yield the results; add scene number, object and subject to HandoverSim's results if the index determines them.

    A result whose scene number contradicts its index in the split raises `ResultsError`.
    """
    # In s2 the index of a scene depends on the hand that gives; of other data, only the data set knows the scenes.
    if metadata.setup not in SETUPS or metadata.setup == "s2" or metadata.dataset not in _OFFICIAL_SCENES:
        yield from results
        return
    scenes = list_split_scenes(metadata.setup, metadata.split, lambda _: "")
    for result in results:
        scene_id = scenes[result.index]
        if result.scene_id is None:
            name, subject = CLASS_NAMES[SCENE_CLASSES[scene_id // 5 % 20]], SUBJECTS[scene_id // 100]
            yield replace(result, scene_id=scene_id, object_name=name, subject=subject)
        elif result.scene_id == scene_id:
            yield result
        else:
            raise ResultsError(
                f"{path}: {result.index:03d}.npz must be of scene {scene_id}, got scene {result.scene_id}; delete it, "
                "or give it its name back"
            )


def render_report_page(report: Report, replays: Mapping[int, str] | None = None) -> str:
    """Render a report as a self-contained HTML page with links to `replays`, URLs of replay pages by scene number."""
    links, metadata = dict(replays or {}), report.metadata
    official, objects, fluency = report.build_tables()
    settings = {key.replace("_", " "): value for key, value in asdict(metadata).items() if value}
    settings |= {"data": report.data_label, "n episodes": report.extent, "machine": report.machine_label}
    return render_template(
        "handover_marl.visualization",
        "report.html",
        version=__version__,
        title=f"{metadata.receiver} on {metadata.setup} {metadata.split}",
        report=report,
        kinds=[_group_episodes(report, flag) for flag in REPORTED_STATUSES],
        n_replays=sum(episode.scene_id in links for episode in report.episodes),
        official=official,
        settings=settings.items(),
        objects=objects,
        fluency=fluency,
        fluency_note=FLUENCY_NOTE,
        scene_header=get_scene_header(report.episodes),
        outcome_column=SCENE_HEADER.index("outcome"),
        replays=links,
    )


def find_replay_links(results: Path, page_folder: Path) -> dict[int, str]:
    """Return the URLs of a result folder's replay pages, relative to a page in `page_folder`, by scene number."""
    relative = os.path.relpath(results.resolve(), page_folder.resolve())
    replays = find_numbered(results / REPLAYS, ".html").items()
    return {scene: Path(relative, path.relative_to(results)).as_posix() for scene, path in replays}


def _group_episodes(report: Report, flag: EpisodeStatus) -> dict[str, Any]:
    """Return variables of the page's template for a status flag: count, rate (%) and the episodes with the flag."""
    rate = report.rates[flag.label]
    low, high = (100 * end for end in rate.interval_95 or (0.0, 1.0))
    return {
        "label": flag.label,
        "count": report.count(flag),
        "percent": rate.format(".1f").partition(" ")[0],
        "interval": rate.format_interval(),
        "low": f"{low:.2f}",
        "width": f"{high - low:.2f}",
        "episodes": [(each, format_scene_cells(each)) for each in report.episodes if each.status & flag],
    }
