"""Leaderboard: table of several evaluations with the same partners and scenes, made from their folders."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.reports.columns import AVERAGE_SUCCESS, N_EPISODES
from handover_marl.evaluation.reports.tables import NO_VALUE, ReportTable, TabularResult
from handover_marl.evaluation.strangers.entry import read_report
from handover_marl.evaluation.strangers.labels import find_wrong_labels, list_labels
from handover_marl.evaluation.strangers.references import load_population_references
from handover_marl.evaluation.strangers.report import NOTE, StrangersReport, format_estimate
from handover_marl.evaluation.strangers.scores import (
    Statistic,
    compute_mean,
    compute_unclipped_proximity,
    estimate_difference,
)
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path, require_modules
from handover_marl.policies.populations import DEFAULT_POPULATION, Population, load_population

_COLUMNS = {
    "success": "success %",
    "contact": "contact %",
    AVERAGE_SUCCESS.key: AVERAGE_SUCCESS.title,
    "br_prox_clipped": "BR-Prox %, clipped",
    "br_prox": "BR-Prox %",
    "worst_partner_success": "worst success %",
    "largest_partner_contact": "largest contact %",
}


@dataclass(frozen=True, eq=False)
class Leaderboard(TabularResult):
    """Evaluations of several methods with the same partners and scenes. `str` returns Markdown tables.

    Attributes:
        reports: Reports with the same references, the largest BR-Prox first.
        names: Name of the method of every report.
        has_stored_references: Whether every partner has a stored reference for these scenes; otherwise the best of
            the evaluations is the reference.
    """

    reports: tuple[StrangersReport, ...]
    names: tuple[str, ...]
    has_stored_references: bool

    def write_heat_map(self, path: Path) -> None:
        """Write a heat map of the success rates by partner and method as PNG; requires the extra `plot`.

        Raises:
            OptionError: matplotlib is missing.
            ResultsError: The file cannot be written.
        """
        require_modules("the heat map", "plot", "matplotlib")
        from handover_marl.visualization.heat_map import draw_heat_map

        first = self.reports[0]
        rates = np.stack([report.successes.mean(axis=(0, 2)) for report in self.reports], axis=1).tolist()
        partners = [f"{partner.name} ({partner.family})" for partner in first.partners]
        other = "giver" if first.agent == "receiver" else "receiver"
        title = f"{first.population}\n{self._describe_condition()}"
        picture = draw_heat_map(rates, partners, list(self.names), title, (other, first.agent))
        try:
            write_atomically(path, picture)
        except OSError as error:
            raise ResultsError(f"{path} cannot be written ({error})") from error

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of scores, of differences to the first method, and of success by family."""
        return [self._build_scores(), self._build_differences(), self._build_families()]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and notes."""
        first = self.reports[0]
        heading = (
            f"{len(first.partners)} partners of {first.population}, families of {first.partner_split}; "
            f"{self._describe_condition()}."
        )
        source = "stored references" if self.has_stored_references else "the best of these methods"
        return [
            heading,
            *self.build_tables(),
            f"{NOTE} BR-Prox is relative to {source}. Differences are paired by partner and scene.",
        ]

    def _describe_condition(self) -> str:
        condition = self.reports[0].condition
        return (
            f"{condition.dataset} {condition.setup} {condition.split}, {len(condition.scenes)} scenes each, "
            f"{condition.physics} physics"
        )

    def _build_scores(self) -> ReportTable:
        rows = []
        for name, report in zip(self.names, self.reports, strict=True):
            found, metadata = report.estimate_all(), next(iter(report.reports.values())).metadata
            cells = [format_estimate(found[key]) if key in found else NO_VALUE for key in _COLUMNS]
            origin = [len(report.policies), metadata.robot, metadata.version]
            rows.append([name, *origin, *cells, report.scores.size])
        header = ["method", "trainings", "robot", "version", *_COLUMNS.values(), N_EPISODES.title]
        return ReportTable(header, rows)

    def _build_differences(self) -> ReportTable:
        best, rows = self.reports[0], []
        for name, report in zip(self.names[1:], self.reports[1:], strict=True):
            cells = [
                _format_difference(compute_mean, best.successes, report.successes),
                _format_difference(compute_mean, best.contacts, report.contacts),
                _format_difference(compute_mean, best.scores, report.scores),
                _format_difference(compute_unclipped_proximity, best.scores, report.scores, best.references),
            ]
            rows.append([self.names[0], name, *cells])
        titles = ["success, points", "contact, points", "AS, points", "BR-Prox, points"]
        return ReportTable(["method", "minus", *titles], rows, n_keys=2)

    def _build_families(self) -> ReportTable:
        first = self.reports[0]
        rows = []
        for family in first.families:
            chosen = [number for number, partner in enumerate(first.partners) if partner.family == family]
            rows.append([family, *(f"{100 * each.successes[:, chosen].mean():.1f}" for each in self.reports)])
        return ReportTable(["family", *(f"{name}: success %" for name in self.names)], rows)


def make_leaderboard(
    folders: Sequence[str | os.PathLike[str]] | Mapping[str, str | os.PathLike[str]],
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    references: str | os.PathLike[str] | None = None,
    trust: bool = False,
) -> Leaderboard:
    """Make the leaderboard of folders that `strangers` wrote, one for each method.

    Every value is computed from the result folders of the pairs.

    Args:
        folders: Output folders of `strangers` with the same partners, scenes and simulation; or such folders by the
            name of the method. The default name is the label of the policy.
        population: Population of the evaluations.
        references: File of references; default: that of the population.
        trust: Whether modules that the population names may be imported, and code in policy files may run.

    Raises:
        OptionError: There is no folder, or the evaluations differ in population, partners or scenes.
        ResultsError: A folder is not a finished evaluation.
        DataNotFoundError: The file of references does not exist.
    """
    if not folders:
        raise OptionError("folders must name at least one folder of handover-marl strangers, got none")
    paths = [check_path("folder", folder) for folder in (folders.values() if isinstance(folders, Mapping) else folders)]
    reports = [read_report(path) for path in paths]
    names = [*folders] if isinstance(folders, Mapping) else [", ".join(report.policies) for report in reports]
    found = load_population(population, trust)
    for path, report in zip(paths, reports, strict=True):
        _check_partners(path, report, found, trust)
        _check_comparable(path, report, paths[0], reports[0])
    partners = [partner.name for partner in reports[0].partners]
    file = None if references is None else check_path("references", references)
    stored = load_population_references(found, file).collect_scores(reports[0].condition, partners)
    best = _find_best(reports) if stored is None else stored
    rows = [(name, replace(report, references=best)) for name, report in zip(names, reports, strict=True)]
    rows.sort(key=lambda row: row[1].estimate_all()["br_prox"].value, reverse=True)
    return Leaderboard(tuple(row[1] for row in rows), tuple(row[0] for row in rows), stored is not None)


def _find_best(reports: Sequence[StrangersReport]) -> npt.NDArray[np.float64]:
    """Return the scores (partners, scenes) of the policy with the largest return with each partner."""
    scores = np.concatenate([report.scores for report in reports])
    best = scores.mean(axis=-1).argmax(axis=0)
    chosen: npt.NDArray[np.float64] = scores[best, np.arange(scores.shape[1])]
    return chosen


def _check_partners(path: Path, report: StrangersReport, population: Population, trust: bool) -> None:
    """Check that a report has exactly the partners of its split of the population."""
    if report.population != population.label:
        raise OptionError(
            f"{path} must be of population {population.label}, got {report.population}; pass the population's file"
        )
    other = "giver" if report.agent == "receiver" else "receiver"
    if report.partners != population.select(other, report.partner_split):
        raise ResultsError(f"{path} must have the partners of {report.partner_split!r}, got others; evaluate again")
    found = [
        (partner, getattr(report.reports[policy, partner.name].metadata, other))
        for policy in report.policies
        for partner in report.partners
    ]
    wrong = find_wrong_labels(list_labels(population, other, report.partners, trust), found)
    if wrong:
        raise ResultsError(f"{path} must have results of {wrong[0]!r} of the population, got another policy")


def _check_comparable(path: Path, report: StrangersReport, first_path: Path, first: StrangersReport) -> None:
    for name in ("partners", "condition"):
        if getattr(report, name) != getattr(first, name):
            raise ResultsError(
                f"{path} and {first_path} must have the same {name}; evaluate with the same families, scenes, data "
                "and physics"
            )


def _format_difference(
    statistic: Statistic,
    first: npt.NDArray[np.float64],
    second: npt.NDArray[np.float64],
    references: npt.NDArray[np.float64] | None = None,
) -> str:
    return format_estimate(estimate_difference(statistic, first, second, references), spec="+.1f")
