"""Folder of an evaluation with strangers: `strangers.json` lists its pairs, which have official result folders."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from handover_marl.datasets import open_dataset
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.crossplay import format_pair_folder
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD
from handover_marl.evaluation.strangers.references import Condition
from handover_marl.evaluation.strangers.report import StrangersReport
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.populations import Partner, Population
from handover_marl.policies.reference import parse_policy

ENTRY_FILE, TABLES_FILE = "strangers.json", "strangers.md"
_MAX_BYTES = 10_000_000


@dataclass(frozen=True)
class StrangersEntry:
    """Content of `strangers.json` that identifies an evaluation.

    Attributes:
        population: Name, version and hash of the population.
        population_hash: Hash of the population.
        partner_split: Split of the population.
        agent: Agent of the evaluated policies.
        policies: Labels of the evaluated policies.
        partners: Partners in the order of the population.
        folders: Name of the result folder of every pair, by label of the policy and name of the partner.
    """

    population: str
    population_hash: str
    partner_split: str
    agent: str
    policies: tuple[str, ...]
    partners: tuple[Partner, ...]
    folders: Mapping[str, Mapping[str, str]]

    @classmethod
    def from_report(cls, report: StrangersReport, population: Population) -> "StrangersEntry":
        """Create the entry of a report, whose pairs have the folders that `crossplay` gave them."""
        folders = {
            policy: {partner.name: _get_folder(report.reports[policy, partner.name]) for partner in report.partners}
            for policy in report.policies
        }
        return cls(
            report.population,
            population.content_hash,
            report.partner_split,
            report.agent,
            report.policies,
            report.partners,
            folders,
        )


def check_folder(folder: Path, population_hash: str, partner_split: str) -> None:
    """Check that an output folder has no evaluation with another population.

    Raises:
        OptionError: It has one.
    """
    if not (folder / ENTRY_FILE).is_file():
        return
    entry = read_entry(folder)
    if (entry.population_hash, entry.partner_split) != (population_hash, partner_split):
        raise OptionError(
            f"out must be a folder for population {population_hash}, families of {partner_split}, got {folder} with "
            f"{entry.population}, families of {entry.partner_split}; choose another folder"
        )


def write_entry(folder: Path, entry: StrangersEntry, report: StrangersReport) -> None:
    """Write `strangers.json` and `strangers.md`.

    Raises:
        ResultsError: The folder cannot be written.
    """
    content = json.dumps({**asdict(entry), **report.to_json()}, indent=1, allow_nan=False)
    write_atomically(folder / ENTRY_FILE, content + "\n")
    write_atomically(folder / TABLES_FILE, f"# Strangers\n\n{report}\n")


def read_entry(folder: Path) -> StrangersEntry:
    """Read the identity of an evaluation from `strangers.json`.

    Raises:
        ResultsError: The file is missing or malformed.
    """
    path = folder / ENTRY_FILE
    try:
        return _parse_entry(json.loads(read_plain_file(path, _MAX_BYTES)))
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
    reports = {
        (policy, partner.name): evaluate(folder / entry.folders[policy][partner.name])
        for policy in entry.policies
        for partner in entry.partners
    }
    for (policy, partner_name), report in reports.items():
        _check_pair(folder, entry, policy, partner_name, report, next(iter(reports.values())))
    codes = check_code(folder, reports.values())
    if len({codes[entry.agent, policy] for policy in entry.policies}) < len(entry.policies):
        raise ResultsError(f"{folder} must have different policies, got two with the same code and weights")
    return StrangersReport(entry.population, entry.partner_split, entry.agent, entry.policies, entry.partners, reports)


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


def check_code(where: object, reports: Iterable[Report]) -> dict[tuple[str, str], str]:
    """Return the hashes of code and weights by agent and label, checked so that each label has one.

    Raises:
        ResultsError: Two reports have different policies of the same label.
    """
    found: dict[tuple[str, str], str] = {}
    for metadata in (report.metadata for report in reports):
        for agent, label, code in (
            ("giver", metadata.giver, metadata.giver_hash),
            ("receiver", metadata.receiver, metadata.receiver_hash),
        ):
            if found.setdefault((agent, label), code) != code:
                raise ResultsError(
                    f"{where} must have results of one version of {label!r}, got {found[agent, label]} and {code}; "
                    "evaluate again"
                )
    return found


def _get_folder(report: Report) -> str:
    return format_pair_folder((report.metadata.giver, report.metadata.receiver))


def _parse_entry(content: Any) -> StrangersEntry:
    texts = {key: content[key] for key in ("population", "population_hash", "partner_split", "agent")}
    policies = tuple(content["policies"])
    partners = tuple(Partner(**partner) for partner in content["partners"])
    folders = {policy: dict(content["folders"][policy]) for policy in policies}
    names = [name for part in folders.values() for name in part.values()]
    plain = [*texts.values(), *policies, *names, *(value for each in partners for value in asdict(each).values())]
    if not policies or not partners or not all(isinstance(text, str) and text.isprintable() for text in plain):
        raise ValueError("policies and partners must be text, and not be empty")
    if any(set(part) != {partner.name for partner in partners} for part in folders.values()):
        raise ValueError("folders must have every partner of every policy")
    if any(Path(name).name != name for name in names):
        raise ValueError("folders must be names of folders beside strangers.json")
    if texts["agent"] not in ("receiver", "giver"):
        raise ValueError(f"agent must be receiver or giver, got {texts['agent']!r}")
    return StrangersEntry(**texts, policies=policies, partners=partners, folders=folders)


def _check_pair(
    folder: Path, entry: StrangersEntry, policy: str, partner_name: str, report: Report, first: Report
) -> None:
    """Check that a pair has the policy, the scenes and the simulation that the entry states."""
    metadata, name = report.metadata, entry.folders[policy][partner_name]
    label = metadata.receiver if entry.agent == "receiver" else metadata.giver
    if label != policy:
        raise ResultsError(f"{folder / name} must have results of {policy!r}, got {label!r}")
    if metadata.world != OFFICIAL_WORLD:
        raise ResultsError(f"{folder / name} must have the official world and rules, got world {metadata.world!r}")
    conditions = [Condition.from_report(entry.agent, each) for each in (report, first)]
    differences = conditions[0].list_differences(conditions[1])
    if metadata.robot != first.metadata.robot:
        differences.append("robot")
    if differences:
        raise ResultsError(
            f"{folder / name} must have the {' and '.join(differences)} of the other pairs; run the same command to "
            "resume"
        )
