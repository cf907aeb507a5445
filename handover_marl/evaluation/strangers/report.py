"""Report of an evaluation with unseen partners, and its output folder.

In an output folder, `strangers.json` lists the pairs of policies, which have official result folders.
"""

import functools
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.crossplay import format_pair_folder
from handover_marl.evaluation.metadata import OFFICIAL_WORLD
from handover_marl.evaluation.reports.episode_tables import estimate_fluency
from handover_marl.evaluation.reports.report import Report, load_report
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    FLUENCY,
    N_EPISODES,
    NO_VALUE,
    Estimate,
    ReportTable,
    TabularResult,
    estimate_average_success,
    format_percent_rate,
)
from handover_marl.evaluation.results import EpisodeResult
from handover_marl.evaluation.strangers.scores import (
    compute_max_over_partners,
    compute_mean,
    compute_min_over_partners,
    estimate,
    estimate_rate,
)
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.populations import Partner, Population

Array = npt.NDArray[np.float64]
ENTRY_FILE, TABLES_FILE = "strangers.json", "strangers.md"
_MAX_BYTES = 10_000_000
_CONDITION = ("dataset", "setup", "split", "physics", "seed", "version")
#: Agent of the partners, by the agent of the evaluated policies.
OTHER_AGENT = {"receiver": "giver", "giver": "receiver"}
_PARTNER_METRICS = ("max_robot_hand_force", "max_robot_object_force", "human_idle")
_METRIC_COLUMNS = tuple(column for column in FLUENCY if column.key in _PARTNER_METRICS)
#: Titles of the metrics of a method, by key.
COLUMNS = {
    "success": "success %",
    "contact": "contact %",
    AVERAGE_SUCCESS.key: AVERAGE_SUCCESS.title,
    "worst_partner_success": "worst success %",
    "largest_partner_contact": "largest contact %",
}

NOTE = (
    "Success, contact and AS: means over partners, scenes and policies. 95 % intervals: jackknife over policies, "
    "families and scenes, in a single family over its partners; for the worst and the largest value over policies and "
    "scenes; those of rates are at least as wide as Wilson's. By partner: Wilson and bootstrap."
)


@dataclass(frozen=True, eq=False)
class StrangersReport(TabularResult):
    """Results of the policies of one method with a population of partners. `str` returns Markdown tables.

    Attributes:
        population: Name, version and hash of the population.
        partner_split: Split of the population, "train", "test" or "all".
        agent: Agent of the evaluated policies, "receiver" or "giver".
        policies: Labels of the evaluated policies, several trainings of one method.
        partners: Partners with whom every policy was evaluated.
        reports: Report of every (label of the policy, name of the partner).
    """

    population: str
    partner_split: str
    agent: str
    policies: tuple[str, ...]
    partners: tuple[Partner, ...]
    reports: dict[tuple[str, str], Report]

    @property
    def first_report(self) -> Report:
        """Report of the first policy with the first partner."""
        return next(iter(self.reports.values()))

    @property
    def partner_families(self) -> list[str]:
        """Family of every partner, in the order of `partners`."""
        return [partner.family for partner in self.partners]

    @property
    def families(self) -> dict[str, list[int]]:
        """Indices in `partners` of the members of each family, by family."""
        names = self.partner_families
        return {family: [number for number, name in enumerate(names) if name == family] for family in names}

    @property
    def condition(self) -> dict[str, object]:
        """Condition of the evaluation by name: `describe_condition` of all reports, evaluated agent and partners."""
        key = f"{OTHER_AGENT[self.agent]}_hash"
        codes = {partner: getattr(report.metadata, key) for (_, partner), report in self.reports.items()}
        return {**describe_condition(self.first_report), "agent": self.agent, "partners": codes}

    @functools.cached_property
    def scores(self) -> Array:
        """Scores of episodes (policies, partners, scenes), 0 to 1, whose mean is the average success (AS)."""
        return self._collect(lambda episode: episode.speed_score)

    @functools.cached_property
    def successes(self) -> Array:
        """Successes (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(episode.success))

    @functools.cached_property
    def contacts(self) -> Array:
        """Contacts between robot and person (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(bool(episode.status & EpisodeStatus.HUMAN_CONTACT)))

    def _collect(self, measure: Callable[[EpisodeResult], float]) -> Array:
        rows = itertools.product(self.policies, self.partners)
        values = [[measure(each) for each in self.reports[policy, partner.name].episodes] for policy, partner in rows]
        return np.array(values).reshape(len(self.policies), len(self.partners), -1)

    def estimate_all(self) -> dict[str, Estimate]:
        """Return estimates (0..1) of success, contact, AS and worst partner, by key."""
        return self._estimate_means(range(len(self.partners))) | {
            "worst_partner_success": estimate_rate(compute_min_over_partners, self.successes, None),
            "largest_partner_contact": estimate_rate(compute_max_over_partners, self.contacts, None),
        }

    def _estimate_means(self, chosen: Sequence[int]) -> dict[str, Estimate]:
        """Return estimates of success, contact and AS over the partners with the indices `chosen`, by key."""
        families = [self.partners[number].family for number in chosen]
        success = estimate_rate(compute_mean, self.successes[:, chosen], families)
        score = estimate(compute_mean, self.scores[:, chosen], families)
        return {
            "success": success,
            "contact": estimate_rate(compute_mean, self.contacts[:, chosen], families),
            # Without a success the jackknife has no width, as in `estimate_average_success`.
            AVERAGE_SUCCESS.key: score if score.mean else replace(score, interval_95=success.interval_95),
        }

    def find_worst_partner(self) -> Partner:
        """Return the partner with the smallest success rate; of several the one with the smallest AS."""
        rates = zip(self.successes.mean(axis=(0, 2)), self.scores.mean(axis=(0, 2)), strict=True)
        return self.partners[min(enumerate(rates), key=lambda pair: pair[1])[0]]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables (summary, families, partners) and notes."""
        report, metadata, found = self.first_report, self.first_report.metadata, self.estimate_all()
        titles = COLUMNS | {
            "worst_partner_success": f"success % with the worst partner ({self.find_worst_partner().name})",
            "largest_partner_contact": "contact % with the partner with most contacts",
        }
        summary = [[title, found[key].format()] for key, title in titles.items()]
        families = [
            [family, *(mean.format() for mean in self._estimate_means(chosen).values()), self.scores[:, chosen].size]
            for family, chosen in self.families.items()
        ]
        return [
            f"{self.agent.capitalize()} {', '.join(self.policies)} with {len(self.partners)} "
            f"{OTHER_AGENT[self.agent]}s of {self.population}, families of {self.partner_split}.\n{metadata.setup} "
            f"{metadata.split}, {report.extent} for each, {metadata.physics} physics, seed {metadata.seed}, data: "
            f"{report.data_label}. handover_marl {metadata.version}.",
            ReportTable(["metric", "value (95 % interval)"], summary),
            ReportTable(["family", "success %", "contact %", "AS %", N_EPISODES.title], families),
            self._build_partner_table(),
            NOTE,
        ]

    def _build_partner_table(self) -> ReportTable:
        rows = []
        for number, partner in enumerate(self.partners):
            episodes = [each for policy in self.policies for each in self.reports[policy, partner.name].episodes]
            n, means = len(episodes), estimate_fluency(episodes)
            counts = [int(flags[:, number].sum()) for flags in (self.successes, self.contacts)]
            cells = [format_percent_rate(count, n) for count in counts]
            cells.append(estimate_average_success([each.speed_score for each in episodes]).format(".2f", ".1f"))
            metrics = [(column.scale, means[column.key].mean if means else None) for column in _METRIC_COLUMNS]
            forces = [NO_VALUE if mean is None else f"{scale * mean:.3g}" for scale, mean in metrics]
            rows.append([partner.name, partner.family, *cells, *forces, n])
        header = ["partner", "family", "success %", "contact %", "AS %"]
        return ReportTable([*header, *(column.title for column in _METRIC_COLUMNS), N_EPISODES.title], rows, n_keys=2)

    def write(self, folder: Path) -> None:
        """Write `strangers.json`, which names each pair's result folder, and the tables `strangers.md` to a folder."""
        folders: dict[str, dict[str, str]] = {policy: {} for policy in self.policies}
        for (policy, partner), pair in self.reports.items():
            folders[policy][partner] = format_pair_folder((pair.metadata.giver, pair.metadata.receiver))
        names = ("population", "partner_split", "agent")
        content = {**{name: getattr(self, name) for name in names}, "folders": folders}
        write_atomically(folder / ENTRY_FILE, json.dumps(content, indent=1) + "\n")
        write_atomically(folder / TABLES_FILE, f"# Strangers\n\n{self}\n")


def describe_condition(report: Report) -> dict[str, object]:
    """Return the condition of an evaluation by name: simulation, scene numbers and data of each scene.

    Scores are comparable only under the same condition.
    """
    return {
        **{name: getattr(report.metadata, name) for name in _CONDITION},
        "scenes": [episode.scene_id for episode in report.episodes],
        "data": [(each.fingerprint, each.n_objects, each.models) for each in report.episodes],
    }


def list_differences(first: Mapping[str, object], second: Mapping[str, object]) -> list[str]:
    """Return the names of the values in which two conditions differ."""
    return [name for name, value in first.items() if value != second[name]]


def read_entry(folder: Path) -> dict[str, Any]:
    """Return the content of a folder's `strangers.json`: texts `population`, `partner_split`, `agent`, and `folders`.

    `folders[policy][partner]` is the name of the result folder of a pair.
    """
    path = folder / ENTRY_FILE
    try:
        entry: dict[str, Any] = json.loads(read_plain_file(path, _MAX_BYTES))
        names = [str(name) for partners in entry["folders"].values() for name in partners.values()]
        if not names or {"population", "partner_split", "agent"} - entry.keys() or entry["agent"] not in OTHER_AGENT:
            raise ValueError("it must have a population, an agent and folders")
        if any(Path(name).name != name for name in names):
            raise ValueError("folders must be names of folders beside strangers.json")
    except FileNotFoundError as error:
        raise ResultsError(
            f"{path} does not exist: the evaluation is not finished; run the same command to resume"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ResultsError(f"{path}: not a readable evaluation with strangers ({shorten_text(error)})") from error
    return entry


def read_report(folder: Path, population: Population) -> StrangersReport:
    """Compute the report of an output folder of `strangers` from the stored results of its episodes."""
    entry = read_entry(folder)
    agent, split = entry["agent"], entry["partner_split"]
    if entry["population"] != population.label:
        raise OptionError(
            f"{folder} must be of population {population.label}, got {entry['population']}; pass the population's file"
        )
    partners = population.select(OTHER_AGENT[agent], split)
    reports: dict[tuple[str, str], Report] = {}
    for policy, folders in entry["folders"].items():
        if [*folders] != [partner.name for partner in partners]:
            raise ResultsError(f"{folder} must have the partners of {split!r}, got others; evaluate again")
        for partner, name in folders.items():
            report = reports[policy, partner] = load_report(folder / name)
            first, metadata = next(iter(reports.values())), report.metadata
            differences = list_differences(describe_condition(report), describe_condition(first))
            differences += [] if getattr(metadata, agent) == policy else [f"label {policy!r}"]
            differences += [] if metadata.world == OFFICIAL_WORLD else ["official rules"]
            if differences:
                raise ResultsError(
                    f"{folder / name} must have the {' and '.join(differences)} of the other pairs; run the same "
                    "command to resume"
                )
    return StrangersReport(entry["population"], split, agent, tuple(entry["folders"]), partners, reports)
