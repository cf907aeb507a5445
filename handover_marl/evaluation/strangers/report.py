"""Report of an evaluation with partners that the evaluated policies have not met, and its output folder.

In an output folder, `strangers.json` lists the pairs of policies, which have official result folders.
"""

import functools
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.crossplay import format_pair_folder
from handover_marl.evaluation.metadata import OFFICIAL_WORLD
from handover_marl.evaluation.reports.episode_tables import estimate_fluency
from handover_marl.evaluation.reports.report import Report, evaluate
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    FLUENCY,
    N_EPISODES,
    NO_VALUE,
    ReportTable,
    TabularResult,
    append_interval,
    format_percent_mean,
    format_percent_rate,
)
from handover_marl.evaluation.results import EpisodeResult
from handover_marl.evaluation.strangers.references import Condition, Reference
from handover_marl.evaluation.strangers.scores import (
    Estimate,
    Statistic,
    compute_largest,
    compute_mean,
    compute_proximity,
    compute_worst,
    compute_worst_proximity,
    estimate,
    estimate_rate,
)
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.populations import Partner

Array = npt.NDArray[np.float64]
ENTRY_FILE, TABLES_FILE = "strangers.json", "strangers.md"
_MAX_BYTES = 10_000_000
#: Agent of the partners, by the agent of the evaluated policies.
OTHER_AGENT = {"receiver": "giver", "giver": "receiver"}
_PARTNER_METRICS = ("max_robot_hand_force", "max_robot_object_force", "human_idle")
_METRIC_COLUMNS = tuple(column for column in FLUENCY if column.key in _PARTNER_METRICS)

NOTE = (
    "Success, contact and AS: means over partners, scenes and policies. 95 % intervals: jackknife over policies, "
    "families and scenes, in a single family over its partners; for the worst and the largest value over policies and "
    "scenes; those of rates are at least as wide as Wilson's. By partner: Wilson and bootstrap."
)
PROXIMITY_NOTE = (
    "BR-Prox: AS divided by the AS of the best policy known for the partner on these scenes, interquartile mean over "
    "partners and policies; without an interval for a method that is itself the best known with a partner."
)
NO_REFERENCES_NOTE = (
    "No BR-Prox: a partner has no reference for this version, physics, seed, scenes and data (hash, models, number of "
    "objects). Search best responses on these scenes (experiments/strangers/search_best_responses.py) and pass them to "
    "handover-marl strangers-references."
)


@dataclass(frozen=True, eq=False)
class StrangersReport(TabularResult):
    """Results of the policies of one method with a population of partners. `str` returns Markdown tables.

    Attributes:
        population: Name, version and hash of the population.
        partner_split: Split of the population, "train", "test" or "all".
        agent: Agent of the evaluated policies, "receiver" or "giver".
        policies: Labels of the evaluated policies, several trainings of one method.
        partners: Partners.
        reports: Report of every (label of the policy, name of the partner).
        references: Best policy known for each partner on these scenes, or None if a partner has none.
    """

    population: str
    partner_split: str
    agent: str
    policies: tuple[str, ...]
    partners: tuple[Partner, ...]
    reports: dict[tuple[str, str], Report]
    references: tuple[Reference, ...] | None = None

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the partners, in their order."""
        return tuple(dict.fromkeys(partner.family for partner in self.partners))

    @property
    def partner_families(self) -> list[str]:
        """Family of every partner."""
        return [partner.family for partner in self.partners]

    @property
    def best_scores(self) -> Array | None:
        """Scores (partners, scenes) of the references, or None if a partner has none."""
        return None if self.references is None else np.array([reference.scores for reference in self.references])

    @property
    def is_reference(self) -> bool:
        """Whether an evaluated policy is itself the reference of a partner, which defines its proximity as 1."""
        return any(reference.policy in self.policies for reference in self.references or ())

    @property
    def condition(self) -> Condition:
        """Scenes and simulation."""
        return Condition.from_report(self.agent, next(iter(self.reports.values())))

    @functools.cached_property
    def scores(self) -> Array:
        """Scores of average success (policies, partners, scenes)."""
        return self._collect(lambda episode: episode.speed_score)

    @functools.cached_property
    def successes(self) -> Array:
        """Successes (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(episode.success))

    @functools.cached_property
    def contacts(self) -> Array:
        """Contacts between robot and person (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(bool(episode.status & EpisodeStatus.HUMAN_CONTACT)))

    def estimate_all(self) -> dict[str, Estimate]:
        """Estimate the metrics of the summary, by key; rates and shares 0..1, BR-Prox without references left out."""
        families = self.partner_families
        found = {
            "success": estimate_rate(compute_mean, self.successes, families),
            "contact": estimate_rate(compute_mean, self.contacts, families),
            AVERAGE_SUCCESS.key: estimate(compute_mean, self.scores, families),
            "worst_partner_success": estimate_rate(compute_worst, self.successes, None),
            "largest_partner_contact": estimate_rate(compute_largest, self.contacts, None),
        }
        if self.best_scores is not None:
            found["br_prox"] = self._estimate_proximity(compute_proximity, families, self.best_scores)
            found["worst_br_prox"] = self._estimate_proximity(compute_worst_proximity, None, self.best_scores)
        return found

    def _estimate_proximity(self, statistic: Statistic, families: Sequence[str] | None, references: Array) -> Estimate:
        found = estimate(statistic, self.scores, families, references)
        return replace(found, interval_95=None) if self.is_reference else found

    def find_worst_partner(self) -> Partner:
        """Return the partner with the smallest success rate; of several the one with the smallest AS."""
        rates = zip(self.successes.mean(axis=(0, 2)), self.scores.mean(axis=(0, 2)), strict=True)
        return self.partners[min(enumerate(rates), key=lambda pair: pair[1])[0]]

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of the summary, of families and of partners."""
        return [self._build_summary(), self._build_family_table(), self._build_partner_table()]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and notes."""
        summary, families, partners = self.build_tables()
        notes = f"{NOTE} {NO_REFERENCES_NOTE if self.references is None else PROXIMITY_NOTE}"
        return [self._format_heading(), summary, families, partners, notes]

    def write(self, folder: Path) -> None:
        """Write `strangers.json`, with the folders that `crossplay` gave to the pairs, and `strangers.md`."""
        folders: dict[str, dict[str, str]] = {policy: {} for policy in self.policies}
        for (policy, partner), pair in self.reports.items():
            folders[policy][partner] = format_pair_folder((pair.metadata.giver, pair.metadata.receiver))
        content = {
            "population": self.population,
            "partner_split": self.partner_split,
            "agent": self.agent,
            "policies": self.policies,
            "partners": [asdict(partner) for partner in self.partners],
            "folders": folders,
        }
        write_atomically(folder / ENTRY_FILE, json.dumps(content, indent=1, allow_nan=False) + "\n")
        write_atomically(folder / TABLES_FILE, f"# Strangers\n\n{self}\n")

    def _collect(self, measure: Callable[[EpisodeResult], float]) -> Array:
        return np.array(
            [[[measure(each) for each in self.reports[policy, partner.name].episodes] for partner in self.partners]
             for policy in self.policies]
        )  # fmt: skip

    def _format_heading(self) -> str:
        report = next(iter(self.reports.values()))
        metadata = report.metadata
        kind = "givers" if self.agent == "receiver" else "receivers"
        return (
            f"{self.agent.capitalize()} {', '.join(self.policies)} with {len(self.partners)} {kind} of "
            f"{self.population}, families of {self.partner_split}.\n{metadata.setup} {metadata.split}, {report.extent} "
            f"for each, {metadata.physics} physics, seed {metadata.seed}, data: {report.data_label}. handover_marl "
            f"{metadata.version}."
        )

    def _build_summary(self) -> ReportTable:
        titles = {
            "success": "success %",
            "contact": "contact %",
            AVERAGE_SUCCESS.key: AVERAGE_SUCCESS.title,
            "br_prox": "BR-Prox %",
            "worst_partner_success": f"success % with the worst partner ({self.find_worst_partner().name})",
            "worst_br_prox": "BR-Prox % with the worst partner",
            "largest_partner_contact": "contact % with the partner with most contacts",
        }
        found = self.estimate_all()
        rows = [[title, format_estimate(found[key])] for key, title in titles.items() if key in found]
        return ReportTable(["metric", "value (95 % interval)"], rows)

    def _build_family_table(self) -> ReportTable:
        rows = []
        for family in self.families:
            chosen = [number for number, partner in enumerate(self.partners) if partner.family == family]
            names = [family] * len(chosen)
            cells = [
                format_estimate(estimate_rate(compute_mean, self.successes[:, chosen], names)),
                format_estimate(estimate_rate(compute_mean, self.contacts[:, chosen], names)),
                format_estimate(estimate(compute_mean, self.scores[:, chosen], names)),
            ]
            rows.append([family, *cells, self.scores[:, chosen].size])
        return ReportTable(["family", "success %", "contact %", "AS %", N_EPISODES.title], rows)

    def _build_partner_table(self) -> ReportTable:
        rows = []
        for number, partner in enumerate(self.partners):
            episodes = [each for policy in self.policies for each in self.reports[policy, partner.name].episodes]
            n, means = len(episodes), estimate_fluency(episodes)
            counts = [int(flags[:, number].sum()) for flags in (self.successes, self.contacts)]
            cells = [
                *(format_percent_rate(count, n) for count in counts),
                format_percent_mean([each.speed_score for each in episodes]),
            ]
            if self.references is not None:
                best = np.array([self.references[number].mean])
                cells.append(f"{100 * compute_proximity(self.scores[:, [number]].mean(axis=-1), best):.0f}")
            forces = [
                NO_VALUE if column.key not in means or (mean := means[column.key].mean) is None
                else f"{column.scale * mean:.3g}"
                for column in _METRIC_COLUMNS
            ]  # fmt: skip
            rows.append([partner.name, partner.family, *cells, *forces, n])
        titles = [column.title for column in _METRIC_COLUMNS]
        header = ["partner", "family", "success %", "contact %", "AS %"]
        header += [] if self.references is None else ["BR-Prox %"]
        return ReportTable([*header, *titles, N_EPISODES.title], rows, n_keys=2)


def format_estimate(found: Estimate, spec: str = ".1f") -> str:
    """Format an estimate of a share with its interval in percent."""
    return append_interval(f"{100.0 * found.value:{spec}}", found.interval_95, spec)


def read_entry(folder: Path) -> dict[str, Any]:
    """Read the content of `strangers.json`, which identifies an evaluation.

    Returns:
        Texts `population`, `partner_split` and `agent`, labels of `policies`, `partners` of the class `Partner`, and
        `folders`, names of result folders by policy and partner.

    Raises:
        ResultsError: The file is missing or malformed.
    """
    path = folder / ENTRY_FILE
    try:
        content = json.loads(read_plain_file(path, _MAX_BYTES))
        partners = tuple(Partner(**partner) for partner in content["partners"])
        entry = {key: content[key] for key in ("population", "partner_split", "agent", "policies", "folders")}
        names = [entry["folders"][policy][partner.name] for policy in entry["policies"] for partner in partners]
        if not names or entry["agent"] not in OTHER_AGENT:
            raise ValueError("it must have an agent, policies and partners")
        if any(Path(name).name != name for name in names):
            raise ValueError("folders must be names of folders beside strangers.json")
        return {**entry, "policies": tuple(entry["policies"]), "partners": partners}
    except FileNotFoundError as error:
        raise ResultsError(
            f"{path} does not exist: the evaluation is not finished; run the same command to resume"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ResultsError(f"{path}: not a readable evaluation with strangers ({shorten_text(error)})") from error


def read_report(folder: Path) -> StrangersReport:
    """Compute the report of a folder from its result folders, without references.

    Every value is computed from the results of the episodes; `strangers.json` only lists them.

    Raises:
        ResultsError: A result folder is missing or malformed, or does not fit to the others.
    """
    entry = read_entry(folder)
    agent, policies, partners = entry["agent"], entry["policies"], entry["partners"]
    reports: dict[tuple[str, str], Report] = {}
    for policy in policies:
        for partner in partners:
            path = folder / entry["folders"][policy][partner.name]
            report = reports[policy, partner.name] = evaluate(path)
            first, metadata = next(iter(reports.values())), report.metadata
            if getattr(metadata, agent) != policy:
                raise ResultsError(f"{path} must have results of {policy!r}, got {getattr(metadata, agent)!r}")
            if metadata.world != OFFICIAL_WORLD:
                raise ResultsError(f"{path} must have the official world and rules, got world {metadata.world!r}")
            differences = Condition.from_report(agent, report).list_differences(Condition.from_report(agent, first))
            differences += ["robot"] if metadata.robot != first.metadata.robot else []
            if differences:
                raise ResultsError(
                    f"{path} must have the {' and '.join(differences)} of the other pairs; run the same command to "
                    "resume"
                )
    codes = check_code(folder, reports.values())
    if len({codes[agent, policy] for policy in policies}) < len(policies):
        raise ResultsError(f"{folder} must have different policies, got two with the same code and weights")
    return StrangersReport(entry["population"], entry["partner_split"], agent, policies, partners, reports)


def check_code(where: object, reports: Iterable[Report]) -> dict[tuple[str, str], str]:
    """Return the hashes of code and weights by agent and label, checked so that each label has one.

    Raises:
        ResultsError: Two reports have different policies of the same label.
    """
    found: dict[tuple[str, str], str] = {}
    for report in reports:
        for agent in OTHER_AGENT:
            label, code = getattr(report.metadata, agent), getattr(report.metadata, f"{agent}_hash")
            if found.setdefault((agent, label), code) != code:
                raise ResultsError(
                    f"{where} must have results of one version of {label!r}, got {found[agent, label]} and {code}; "
                    "evaluate again in a new folder"
                )
    return found
