"""Leaderboard: table of several evaluations with the same partners and scenes, made from their folders."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.reports.tables import AVERAGE_SUCCESS, N_EPISODES, NO_VALUE, ReportTable, TabularResult
from handover_marl.evaluation.strangers.protocol import list_labels
from handover_marl.evaluation.strangers.references import Condition, load_references
from handover_marl.evaluation.strangers.report import (
    NO_REFERENCES_NOTE,
    NOTE,
    OTHER_AGENT,
    PROXIMITY_NOTE,
    StrangersReport,
    check_code,
    format_estimate,
    read_report,
)
from handover_marl.evaluation.strangers.scores import Statistic, compute_mean, compute_proximity, estimate_difference
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path, require_modules
from handover_marl.policies.populations import DEFAULT_POPULATION, Population, load_population

_COLUMNS = {
    "success": "success %",
    "contact": "contact %",
    AVERAGE_SUCCESS.key: AVERAGE_SUCCESS.title,
    "br_prox": "BR-Prox %",
    "worst_partner_success": "worst success %",
    "largest_partner_contact": "largest contact %",
}


@dataclass(frozen=True, eq=False)
class Leaderboard(TabularResult):
    """Evaluations of several methods with the same partners. `str` returns Markdown tables.

    Attributes:
        reports: Reports, the methods with the largest AS first, and the splits of a method one after the other. All
            reports of a split have the same scenes.
        names: Name of the method of every report.
    """

    reports: tuple[StrangersReport, ...]
    names: tuple[str, ...]

    @property
    def splits(self) -> dict[str, list[int]]:
        """Indices of the reports of every split of scenes."""
        found: dict[str, list[int]] = {}
        for number, report in enumerate(self.reports):
            found.setdefault(report.condition.split, []).append(number)
        return found

    @property
    def titles(self) -> list[str]:
        """Name and split of every report."""
        return [f"{name}, {report.condition.split}" for name, report in zip(self.names, self.reports, strict=True)]

    def write_heat_map(self, path: Path) -> None:
        """Write a heat map of the success rates by partner and method as PNG; requires the extra `plot`.

        Raises:
            OptionError: matplotlib is missing.
            ResultsError: The file cannot be written.
        """
        require_modules("the heat map", "plot", "matplotlib")
        from handover_marl.visualization.figures import draw_heat_map

        first = self.reports[0]
        rates = np.stack([report.successes.mean(axis=(0, 2)) for report in self.reports], axis=1).tolist()
        partners = [f"{partner.name} ({partner.family})" for partner in first.partners]
        other = OTHER_AGENT[first.agent]
        title = f"{first.population}\n{self._describe_conditions()}"
        write_atomically(path, draw_heat_map(rates, partners, self.titles, title, (other, first.agent)))

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of scores, of differences to the first method, and of success by family."""
        return [self._build_scores(), self._build_differences(), self._build_families()]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and notes."""
        first = self.reports[0]
        heading = (
            f"{len(first.partners)} partners of {first.population}, families of {first.partner_split}; "
            f"{self._describe_conditions()}."
        )
        notes = [NOTE, "Differences are paired by partner and scene."]
        known = [report.references is not None for report in self.reports]
        notes += [PROXIMITY_NOTE] if any(known) else []
        notes += [] if all(known) else [NO_REFERENCES_NOTE]
        return [heading, *self.build_tables(), " ".join(notes)]

    def _describe_conditions(self) -> str:
        condition, report = self.reports[0].condition, next(iter(self.reports[0].reports.values()))
        scenes = [
            f"{len(self.reports[rows[0]].condition.scenes)} scenes of {split}" for split, rows in self.splits.items()
        ]
        return (
            f"{condition.setup}, {' and '.join(scenes)} each, {condition.physics} physics, seed {condition.seed}, "
            f"data: {report.data_label}, handover_marl {condition.version}"
        )

    def _build_scores(self) -> ReportTable:
        rows = []
        for name, report in zip(self.names, self.reports, strict=True):
            found, metadata = report.estimate_all(), next(iter(report.reports.values())).metadata
            cells = [format_estimate(found[key]) if key in found else NO_VALUE for key in _COLUMNS]
            rows.append([name, metadata.split, len(report.policies), metadata.robot, *cells, report.scores.size])
        header = ["method", "split", "trainings", "robot", *_COLUMNS.values(), N_EPISODES.title]
        return ReportTable(header, rows, n_keys=2)

    def _build_differences(self) -> ReportTable:
        rows = []
        for split, (first, *others) in self.splits.items():
            for other in others:
                one, two = self.reports[first], self.reports[other]
                has_proximity = one.best_scores is not None and not (one.is_reference or two.is_reference)
                cells = [
                    _format_difference(compute_mean, one, one.successes, two.successes),
                    _format_difference(compute_mean, one, one.contacts, two.contacts),
                    _format_difference(compute_mean, one, one.scores, two.scores),
                    _format_difference(compute_proximity, one, one.scores, two.scores) if has_proximity else NO_VALUE,
                ]
                rows.append([self.names[first], self.names[other], split, *cells])
        titles = ["success, points", "contact, points", "AS, points", "BR-Prox, points"]
        return ReportTable(["method", "minus", "split", *titles], rows, n_keys=3)

    def _build_families(self) -> ReportTable:
        first = self.reports[0]
        rows = []
        for family in first.families:
            chosen = [number for number, partner in enumerate(first.partners) if partner.family == family]
            rows.append([family, *(f"{100 * each.successes[:, chosen].mean():.1f}" for each in self.reports)])
        return ReportTable(["family", *(f"{title}: success %" for title in self.titles)], rows)


def make_leaderboard(
    folders: Sequence[str | os.PathLike[str]],
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    references: str | os.PathLike[str] | None = None,
    names: Sequence[str] | None = None,
    trust: bool = False,
) -> Leaderboard:
    """Make the leaderboard of folders that `strangers` wrote, one for each method and split of scenes.

    Every value is computed from the result folders of the pairs.

    Args:
        folders: Output folders of `strangers` with the same partners, data and simulation, and in each split the same
            scenes.
        population: Population of the evaluations.
        references: File of references; default: that of the population.
        names: Name of the method of every folder; default: the label of the policy.
        trust: Whether modules that the population names may be imported, and code in policy files may run.

    Raises:
        OptionError: There is no folder, a method has two folders of a split, or the population is another one.
        ResultsError: A folder is not a finished evaluation, or the evaluations differ in partners, scenes, data, seed
            or simulation.
        DataNotFoundError: The file of references does not exist.
    """
    if not folders:
        raise OptionError("folders must name at least one folder of handover-marl strangers, got none")
    paths = [check_path("folder", folder) for folder in folders]
    reports = [read_report(path) for path in paths]
    methods = [", ".join(report.policies) for report in reports] if names is None else names
    found = load_population(population, trust)
    for path, report in zip(paths, reports, strict=True):
        _check_partners(path, report, found, trust)
    _check_comparable(paths, methods, reports)
    partners = [partner.name for partner in reports[0].partners]
    table = load_references(found, references)
    reports = [replace(each, references=table.find_all(each.condition, partners)) for each in reports]
    splits = [*dict.fromkeys(report.condition.split for report in reports)]
    rows = [
        (splits.index(report.condition.split), -report.scores.mean(), name, report)
        for name, report in zip(methods, reports, strict=True)
    ]
    rows.sort(key=lambda row: row[:2])
    order = [*dict.fromkeys(row[2] for row in rows)]
    rows.sort(key=lambda row: order.index(row[2]))
    return Leaderboard(tuple(row[3] for row in rows), tuple(row[2] for row in rows))


def _check_partners(path: Path, report: StrangersReport, population: Population, trust: bool) -> None:
    """Check that a report has exactly the partners of its split of the population."""
    if report.population != population.label:
        raise OptionError(
            f"{path} must be of population {population.label}, got {report.population}; pass the population's file"
        )
    other = OTHER_AGENT[report.agent]
    if report.partners != population.select(other, report.partner_split):
        raise ResultsError(f"{path} must have the partners of {report.partner_split!r}, got others; evaluate again")
    found = list_labels(population, other, report.partners, trust)
    labels = {partner.name: label for label, partner in found.items()}
    for (_, name), pair in report.reports.items():
        label = getattr(pair.metadata, other)
        if labels.get(name, label) != label:
            raise ResultsError(f"{path} must have results of {name!r} of the population, got another policy")


def _check_comparable(paths: Sequence[Path], names: Sequence[str], reports: Sequence[StrangersReport]) -> None:
    """Check that reports have the same partners and simulation, and those of a split the same scenes."""
    first = reports[0]
    folders: dict[tuple[str, str], Path] = {}
    firsts: dict[str, Condition] = {}
    codes: dict[tuple[str, str, str], str] = {}
    for path, name, report in zip(paths, names, reports, strict=True):
        condition = report.condition
        if (known := folders.setdefault((name, condition.split), path)) is not path:
            raise OptionError(
                f"folders must have one evaluation of {name!r} with the split {condition.split}, got {known} and "
                f"{path}; name the methods, as NAME=DIR"
            )
        differences = {*condition.list_differences(first.condition)} - {"split", "scenes", "data"}
        differences.update(condition.list_differences(firsts.setdefault(condition.split, condition)))
        if report.partners != first.partners:
            differences.add("partners")
        for (agent, label), code in check_code(path, report.reports.values()).items():
            # Two methods may have policies of one label, and the policies of a method and the partners one code.
            if codes.setdefault((agent, label, name if agent == first.agent else ""), code) != code:
                differences.add(f"code of {label!r}")
        if differences:
            raise ResultsError(
                f"{path} must have the {' and '.join(sorted(differences))} of the other folders; evaluate with the "
                "same version, partners, seed, scenes, data and physics"
            )


def _format_difference(
    statistic: Statistic,
    report: StrangersReport,
    first: npt.NDArray[np.float64],
    second: npt.NDArray[np.float64],
) -> str:
    references = report.best_scores if statistic is compute_proximity else None
    found = estimate_difference(statistic, first, second, report.partner_families, references)
    return format_estimate(found, spec="+.1f")
