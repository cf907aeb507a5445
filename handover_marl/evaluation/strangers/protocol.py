"""Protocol of the evaluation with unseen partners, its leaderboard, and its reference scores."""

import contextlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig, build_configs
from handover_marl.evaluation.crossplay import crossplay, resolve_policies
from handover_marl.evaluation.metadata import CONFIG_FILE, OFFICIAL_WORLD
from handover_marl.evaluation.reports.report import Report, evaluate
from handover_marl.evaluation.reports.tables import N_EPISODES, NO_VALUE, ReportTable, TabularResult
from handover_marl.evaluation.strangers.references import Condition, Reference, ReferenceTable, load_references
from handover_marl.evaluation.strangers.report import (
    COLUMNS,
    ENTRY_FILE,
    NO_REFERENCES_NOTE,
    NOTE,
    OTHER_AGENT,
    PROXIMITY_NOTE,
    StrangersReport,
    read_entry,
    read_report,
)
from handover_marl.evaluation.strangers.scores import compute_mean, compute_proximity, estimate_difference
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path, forward_signature, require_modules
from handover_marl.policies.populations import ALL, DEFAULT_POPULATION, Partner, Population, load_population
from handover_marl.policies.reference import PolicyLike, parse_policy

#: Number of scenes for each partner: 648 episodes with the 18 test givers of `strangers-v1`.
DEFAULT_N_SCENES = 36
FAST = "fast"


@forward_signature(EvaluationConfig, ExecutionConfig, without=("shard",), defaults={"physics": FAST})
def strangers(
    receiver: Sequence[PolicyLike] | PolicyLike | None = None,
    giver: Sequence[PolicyLike] | PolicyLike | None = None,
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    partners: str = "test",
    n_scenes: int = DEFAULT_N_SCENES,
    setup: str | EvaluationConfig | None = None,
    split: str = "test",
    references: str | os.PathLike[str] | None = None,
    execution: ExecutionConfig | None = None,
    **options: Any,
) -> StrangersReport:
    """Evaluate a receiver, or a giver, with unseen partners from a population.

    Args:
        receiver: Receiver to evaluate with givers, as for `benchmark`; or several trainings of one method.
        giver: Giver to evaluate with receivers, in place of a receiver.
        population: Name of a shipped population, or path of a file; see `handover_marl.policies.populations`.
        partners: Families of the population to evaluate with: "train", "test" or "all".
        n_scenes: Number of scenes, evenly spaced over the split; all scenes if it has fewer. Ignored if `scenes` is
            given.
        setup: Official setup, "s0" to "s3", or one of other data; or a whole `handover_marl.EvaluationConfig`, whose
            policies are ignored.
        split: Split of the scenes, "train", "val" or "test".
        references: File of references, as `strangers-references` writes it; default: the population's file.
        execution: Execution settings. The output folder gets a result folder for each pair, the files of `crossplay`,
            `strangers.md` and `strangers.json`; an interrupted evaluation resumes there.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`; the default of
            `physics` is "fast".

    Raises:
        OptionError: Not exactly one of receiver and giver is given, two trainings are the same, the world or the rules
            are not the official ones, the population has no partners in the split, or the output folder holds another
            evaluation.
        HandoverError: The same errors as `crossplay` and `load_population`.
    """
    if not isinstance(setup, EvaluationConfig):
        options.setdefault("physics", FAST)
    config, execution = build_configs(setup, options, execution, split=split)
    if config.world_config != OFFICIAL_CONFIG:
        raise OptionError(
            "world_config must be the official one for strangers, got another; use crossplay for other worlds and rules"
        )
    if config.inference_time is not None:
        raise OptionError(f"inference_time must be None for strangers, got {config.inference_time}; use crossplay")
    policies = giver if receiver is None else receiver
    if policies is None or (receiver is not None and giver is not None):
        raise OptionError("pass exactly one of receiver and giver; the population has partners for both")
    if execution.shard is not None:
        raise OptionError(f"shard must be left out, got {execution.shard!r}; use workers, or a Ray cluster")
    agent = "receiver" if giver is None else "giver"
    found = load_population(population, execution.trust)
    chosen = found.select(OTHER_AGENT[agent], partners)
    dataset = config.open_dataset()
    if config.scenes is None:
        scenes = dataset.list_scenes(dataset.resolve_setup(config.setup), config.split)
        config = replace(config, scenes=select_scenes_evenly(scenes, n_scenes))
    table = load_references(found, references)
    folder = execution.folder
    if folder is not None and not execution.fresh and (folder / ENTRY_FILE).is_file():
        entry = read_entry(folder)
        if (entry["population"], entry["partner_split"]) != (found.label, partners):
            raise OptionError(
                f"out must be a folder for population {found.label}, families of {partners}, got {folder} with "
                f"{entry['population']}, families of {entry['partner_split']}; choose another folder"
            )
    trainings = resolve_policies(agent, policies, dataset, config, execution.trust)
    if len({policy.code_hash for policy in trainings}) < len(trainings):
        raise OptionError(f"{agent} must name different policies, got two with the same code and weights; drop one")
    others = [found.get_policy(partner) for partner in chosen]
    givers, receivers = (others, trainings) if agent == "receiver" else (trainings, others)
    result = crossplay(givers, receivers, config, execution=execution)
    names, labels = (result.receivers, result.givers) if agent == "receiver" else (result.givers, result.receivers)
    reports = {
        (name, partner.name): result.reports[(label, name) if agent == "receiver" else (name, label)]
        for name in names
        for partner, label in zip(chosen, labels, strict=True)
    }
    report = StrangersReport(found.label, partners, agent, names, chosen, reports)
    report = replace(report, references=table.find_all(report.condition, [each.name for each in chosen]))
    if folder is not None:
        report.write(folder)
    return report


def update_references(
    folders: Iterable[str | os.PathLike[str]],
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    out: str | os.PathLike[str] | None = None,
    trust: bool = False,
) -> ReferenceTable:
    """Update the reference of each partner, the best policy known, from result folders; write and return the table.

    Args:
        folders: Result folders, or folders that contain some, such as those of `strangers` and `crossplay`. Pairs
            without a partner of the population are ignored. In a folder of `strangers`, only the evaluated
            policy can become a reference; in other folders, giver and receiver can.
        population: Name of a shipped population, or path of a file.
        out: File of references to update; default: the population's file.
        trust: Whether modules that the population names may be imported, and code in policy files may run.

    Raises:
        ResultsError: A folder has no result, or the file cannot be written.
        HandoverError: The population or its references cannot be read.
    """
    found = load_population(population, trust)
    path = found.references_path if out is None else check_path("out", out)
    table = load_references(found, out, is_new=True)
    labels = {"giver": _list_labels(found, "giver", trust), "receiver": _list_labels(found, "receiver", trust)}
    for folder in folders:
        parent = check_path("folder", folder)
        results = sorted(file.parent for file in parent.rglob(CONFIG_FILE))
        if not results:
            raise ResultsError(f"{parent} must contain result folders, got none with {CONFIG_FILE}")
        for result in results:
            report = evaluate(result)
            is_entry = (result.parent / ENTRY_FILE).is_file()
            for agent in (read_entry(result.parent)["agent"],) if is_entry else OTHER_AGENT:
                partner = labels[OTHER_AGENT[agent]].get(getattr(report.metadata, OTHER_AGENT[agent]))
                if partner is not None and report.metadata.world == OFFICIAL_WORLD:
                    reference = _make_reference(agent, report, partner.policy)
                    table = table.update(Condition.from_report(agent, report), partner.name, reference)
    write_atomically(path, table.to_json())
    return table


def _make_reference(agent: str, report: Report, partner_policy: str) -> Reference:
    """Return the policy of `agent` in a report as a reference, with a command that evaluates it with a partner."""
    metadata = report.metadata
    policy, names = getattr(metadata, agent), ("dataset", "setup", "split", "physics", "robot", "seed")
    policies = {"giver": metadata.giver, "receiver": metadata.receiver} | {OTHER_AGENT[agent]: partner_policy}
    options = {**policies, **{name: getattr(metadata, name) for name in names}}
    options["scenes"] = ",".join(str(episode.scene_id) for episode in report.episodes)
    return Reference(
        policy,
        version=f"{metadata.version} {getattr(metadata, f'{agent}_hash')}".strip(),
        command=f"handover-marl pair {' '.join(f'--{name} {value}' for name, value in options.items())}",
        scores=tuple(episode.speed_score for episode in report.episodes),
    )


def _list_labels(population: Population, agent: str, trust: bool) -> dict[str, Partner]:
    """Return the givers or receivers of a population by the label that they have in result folders.

    Partners that cannot be made here, for example for lack of an optional package, are left out.
    """
    # Labels do not depend on the data set.
    dataset = open_dataset("synthetic")
    labels: dict[str, Partner] = {}
    for partner in population.select(agent, ALL):
        with contextlib.suppress(OptionError):
            labels[parse_policy(agent, population.get_policy(partner), trust).resolve(dataset).label] = partner
    return labels


@dataclass(frozen=True, eq=False)
class Leaderboard(TabularResult):
    """Evaluations of several methods with the same partners. `str` returns Markdown tables.

    Attributes:
        reports: Reports, the methods with the largest average success (AS) first, and the splits of a method one
            after the other. All reports of a split have the same scenes.
        names: Name of the method of every report.
    """

    reports: tuple[StrangersReport, ...]
    names: tuple[str, ...]

    @property
    def splits(self) -> dict[str, list[int]]:
        """Indices of the evaluations in `reports`, by their split of scenes."""
        found: dict[str, list[int]] = {}
        for number, report in enumerate(self.reports):
            found.setdefault(report.condition.split, []).append(number)
        return found

    @property
    def titles(self) -> list[str]:
        """Titles of the reports in tables: name of the method and split of the scenes."""
        return [f"{name}, {report.condition.split}" for name, report in zip(self.names, self.reports, strict=True)]

    def write_heat_map(self, path: Path) -> None:
        """Write a heat map of the success rates by partner and method as PNG; requires the extra `plot`.

        Raises:
            OptionError: matplotlib is missing.
            ResultsError: The file cannot be written.
        """
        require_modules("the heat map", "plot", "matplotlib")
        from handover_marl.visualization.pictures import draw_heat_map

        first = self.reports[0]
        rates = np.stack([report.successes.mean(axis=(0, 2)) for report in self.reports], axis=1).tolist()
        partners = [f"{partner.name} ({partner.family})" for partner in first.partners]
        title = f"{first.population}\n{self._describe_conditions()}"
        labels = (OTHER_AGENT[first.agent], first.agent)
        write_atomically(path, draw_heat_map(rates, partners, self.titles, title, labels))

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables (scores, differences to the first method, success by family) and notes."""
        first = self.reports[0]
        known = [report.references is not None for report in self.reports]
        notes = [NOTE, "Differences are paired by partner and scene."]
        notes += [PROXIMITY_NOTE] * any(known) + [NO_REFERENCES_NOTE] * (not all(known))
        return [
            f"{len(first.partners)} partners of {first.population}, families of {first.partner_split}; "
            f"{self._describe_conditions()}.",
            self._build_scores(),
            self._build_differences(),
            self._build_families(),
            " ".join(notes),
        ]

    def _describe_conditions(self) -> str:
        condition, report = self.reports[0].condition, self.reports[0].first_report
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
            found, metadata = report.estimate_all(), report.first_report.metadata
            cells = [found[key].format() if key in found else NO_VALUE for key in COLUMNS]
            rows.append([name, metadata.split, len(report.policies), metadata.robot, *cells, report.scores.size])
        header = ["method", "split", "trainings", "robot", *COLUMNS.values(), N_EPISODES.title]
        return ReportTable(header, rows, n_keys=2)

    def _build_differences(self) -> ReportTable:
        rows = []
        for split, (first, *others) in self.splits.items():
            one = self.reports[first]
            for other in others:
                two, families = self.reports[other], one.partner_families
                arrays = [(one.successes, two.successes), (one.contacts, two.contacts), (one.scores, two.scores)]
                found = [estimate_difference(compute_mean, *each, families) for each in arrays]
                if one.best_scores is not None and not (one.is_reference or two.is_reference):
                    found.append(estimate_difference(compute_proximity, *arrays[-1], families, one.best_scores))
                cells = [*(each.format("+.1f") for each in found), *[NO_VALUE] * (4 - len(found))]
                rows.append([self.names[first], self.names[other], split, *cells])
        titles = ["success, points", "contact, points", "AS, points", "BR-Prox, points"]
        return ReportTable(["method", "minus", "split", *titles], rows, n_keys=3)

    def _build_families(self) -> ReportTable:
        rows = [
            [family, *(f"{100 * each.successes[:, chosen].mean():.1f}" for each in self.reports)]
            for family, chosen in self.reports[0].families.items()
        ]
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
        population: Population of the evaluations: name of a shipped one, or path of a file.
        references: File of references; default: the population's file.
        names: Name of the method of every folder; default: the labels of its policies.
        trust: Whether modules that the population names may be imported, and code in policy files may run.

    Raises:
        OptionError: There is no folder, a method has two folders of a split, or the folders are of another population.
        ResultsError: A folder is not a finished evaluation, or the evaluations differ in partners, scenes, data, seed
            or simulation.
        DataNotFoundError: The file of references does not exist.
    """
    if not folders:
        raise OptionError("folders must name at least one folder of handover-marl strangers, got none")
    found, paths = load_population(population, trust), [check_path("folder", folder) for folder in folders]
    reports = [read_report(path, found) for path in paths]
    methods = [", ".join(report.policies) for report in reports] if names is None else names
    _check_comparable(paths, methods, reports)
    partners = [partner.name for partner in reports[0].partners]
    table = load_references(found, references)
    reports = [replace(each, references=table.find_all(each.condition, partners)) for each in reports]
    # Methods are sorted by their AS on the split of the first folder; each method's splits follow one another.
    splits = [*dict.fromkeys(report.condition.split for report in reports)]
    rows = list(zip(methods, reports, strict=True))
    rows.sort(key=lambda row: (splits.index(row[1].condition.split), -row[1].scores.mean()))
    order = [*dict.fromkeys(name for name, _ in rows)]
    rows.sort(key=lambda row: order.index(row[0]))
    return Leaderboard(tuple(report for _, report in rows), tuple(name for name, _ in rows))


def _check_comparable(paths: Sequence[Path], names: Sequence[str], reports: Sequence[StrangersReport]) -> None:
    """Check that reports have the same partners and simulation, and those of a split the same scenes."""
    first = reports[0]
    folders: dict[tuple[str, str], Path] = {}
    firsts: dict[str, Condition] = {}
    for path, name, report in zip(paths, names, reports, strict=True):
        condition = report.condition
        if (known := folders.setdefault((name, condition.split), path)) is not path:
            raise OptionError(
                f"folders must have one evaluation of {name!r} with the split {condition.split}, got {known} and "
                f"{path}; name the methods, as NAME=DIR"
            )
        differences = {*condition.list_differences(first.condition)} - {"split", "scenes", "data"}
        differences.update(condition.list_differences(firsts.setdefault(condition.split, condition)))
        differences.update(["partners"] if report.partner_codes != first.partner_codes else [])
        if differences:
            raise ResultsError(
                f"{path} must have the {' and '.join(sorted(differences))} of the other folders; evaluate with the "
                "same version, partners, seed, scenes, data and physics"
            )
