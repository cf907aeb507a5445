"""Update of reference scores from result folders."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from handover_marl.datasets import open_dataset
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult
from handover_marl.evaluation.results.metadata import CONFIG_FILE, OFFICIAL_WORLD
from handover_marl.evaluation.strangers.protocol import ENTRY_FILE, read_entry
from handover_marl.evaluation.strangers.references import Condition, Reference, ReferenceTable, load_references
from handover_marl.evaluation.strangers.report import OTHER_AGENT
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, Population, load_population
from handover_marl.policies.reference import parse_policy


@dataclass(frozen=True, eq=False)
class ReferenceSummary(TabularResult):
    """References of a population after an update. `str` returns a Markdown table.

    Attributes:
        population: Population of the partners.
        table: References.
    """

    population: Population
    table: ReferenceTable

    def build_tables(self) -> list[ReportTable]:
        """Build a table with one row for each partner and condition."""
        rows = [
            [
                partner,
                f"{condition.dataset} {condition.setup} {condition.split}",
                condition.physics,
                reference.policy,
                f"{100 * reference.mean:.1f}",
                len(condition.scenes),
            ]
            for condition, section in self.table.sections.items()
            for partner, reference in section.items()
        ]
        return [ReportTable(["partner", "scenes", "physics", "best policy", "AS %", "n"], rows)]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading and table."""
        return [f"Best policies known for the partners of {self.population.label}.", *self.build_tables()]


def update_references(
    folders: Iterable[str | os.PathLike[str]],
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    out: str | os.PathLike[str] | None = None,
    trust: bool = False,
) -> ReferenceSummary:
    """Update the references of a population from result folders and write them.

    Args:
        folders: Result folders, or folders that contain some, such as those of `strangers` and `crossplay`. Pairs
            without a partner of the population are ignored. In a folder of `strangers`, only the evaluated
            policy can become a reference; in other folders, giver and receiver can.
        population: Name of a shipped population, or path of a file.
        out: File of references to update; default: that of the population.
        trust: Whether modules that the population names may be imported, and code in policy files may run.

    Raises:
        ResultsError: A folder has no result, or the file cannot be written.
        HandoverError: The population or its references cannot be read.
    """
    found = load_population(population, trust)
    path = found.references_path if out is None else check_path("out", out)
    table = load_references(path, found.content_hash)
    labels = {
        "giver": list_labels(found, "giver", found.givers, trust),
        "receiver": list_labels(found, "receiver", found.receivers, trust),
    }
    for report, agents in _read_reports(folders):
        for agent in agents:
            other = OTHER_AGENT[agent]
            partner = labels[other].get(getattr(report.metadata, other))
            if partner is not None and report.metadata.world == OFFICIAL_WORLD:
                condition, reference = _make_reference(agent, report, partner.policy)
                table = table.update(condition, partner.name, reference)
    write_atomically(path, table.format())
    return ReferenceSummary(found, table)


def _read_reports(folders: Iterable[str | os.PathLike[str]]) -> Iterator[tuple[Report, tuple[str, ...]]]:
    """Yield every report, and the agents whose policies may become references.

    A result folder of `strangers` has one evaluated agent; in other result folders both agents count.
    """
    for folder in folders:
        path = check_path("folder", folder)
        results = sorted(file.parent for file in path.rglob(CONFIG_FILE))
        if not results:
            raise ResultsError(f"{path} must contain result folders, got none with {CONFIG_FILE}")
        for result in results:
            is_entry = (result.parent / ENTRY_FILE).is_file()
            yield evaluate(result), (read_entry(result.parent)["agent"],) if is_entry else tuple(OTHER_AGENT)


def _make_reference(agent: str, report: Report, partner_policy: str) -> tuple[Condition, Reference]:
    """Return the condition of a report, and the agent's policy with its scores and the command of the evaluation."""
    metadata = report.metadata
    policy, names = getattr(metadata, agent), ("dataset", "setup", "split", "physics", "robot", "seed")
    policies = {"giver": metadata.giver, "receiver": metadata.receiver} | {OTHER_AGENT[agent]: partner_policy}
    options = {**policies, **{name: getattr(metadata, name) for name in names}}
    options["scenes"] = ",".join(str(episode.scene_id) for episode in report.episodes)
    reference = Reference(
        policy,
        version=f"{metadata.version} {getattr(metadata, f'{agent}_hash')}".strip(),
        command=f"handover-marl pair {' '.join(f'--{name} {value}' for name, value in options.items())}",
        scores=tuple(episode.speed_score for episode in report.episodes),
    )
    return Condition.from_report(agent, report), reference


def list_labels(
    population: Population, agent: str, partners: Sequence[Partner], trust: bool = False
) -> dict[str, Partner]:
    """Return partners by the label that they have in result folders.

    Partners that cannot be made here, for example for lack of an optional package, are left out.

    Args:
        population: Population.
        agent: Agent of the partners, "giver" or "receiver".
        partners: Partners of this agent.
        trust: Whether code in policy files may run.
    """
    # Labels do not depend on the data set.
    dataset = open_dataset("synthetic")
    labels: dict[str, Partner] = {}
    for partner in partners:
        try:
            reference = parse_policy(agent, population.get_policy(partner), trust).resolve(dataset)
        except OptionError:
            continue
        labels[reference.label] = partner
    return labels
