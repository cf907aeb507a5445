"""Protocol of the evaluation with partners that a policy has not met, and its output folder.

In an output folder, `strangers.json` lists the pairs of policies, which have official result folders.
"""

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig, build_configs
from handover_marl.evaluation.crossplay import crossplay, format_pair_folder, resolve_policies
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD
from handover_marl.evaluation.strangers.references import Condition, load_population_references
from handover_marl.evaluation.strangers.report import OTHER_AGENT, StrangersReport
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.options import check_path, forward_signature
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, load_population
from handover_marl.policies.reference import PolicyLike

ENTRY_FILE, TABLES_FILE = "strangers.json", "strangers.md"
#: Number of scenes for each partner: 648 episodes with the 18 test givers of `strangers-v1`.
DEFAULT_N_SCENES = 36
FAST = "fast"
_MAX_BYTES = 10_000_000


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
    """Evaluate a receiver, or a giver, with partners of a population that it has not met.

    Args:
        receiver: Receiver to evaluate with givers, as for `benchmark`; or several trainings of one method.
        giver: Giver to evaluate with receivers, in place of a receiver.
        population: Name of a shipped population, or path of a file; see
            `handover_marl.policies.populations`.
        partners: Families of the population to evaluate with: "train", "test" or "all".
        n_scenes: Number of scenes, evenly spaced over the split; all scenes if it has fewer. Ignored beside `scenes`.
        setup: Official setup, "s0" to "s3", or one of other data; or a whole `handover_marl.EvaluationConfig`, whose
            policies are ignored.
        split: Split of the scenes, "train", "val" or "test".
        references: File of references, as `strangers-references` writes it; default: that of the population.
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
    if not isinstance(setup, EvaluationConfig) and "physics" not in options:
        options["physics"] = FAST
    config, execution = build_configs(setup, options, execution, split=split)
    if config.world_config != OFFICIAL_CONFIG:
        raise OptionError(
            "world_config must be the official one for strangers, got another; use crossplay for other worlds and rules"
        )
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
    table = load_population_references(found, None if references is None else check_path("references", references))
    folder = execution.folder
    if folder is not None and not execution.fresh and (folder / ENTRY_FILE).is_file():
        entry = read_entry(folder)
        if (entry["population"], entry["partner_split"]) != (found.label, partners):
            raise OptionError(
                f"out must be a folder for population {found.label}, families of {partners}, got {folder} with "
                f"{entry['population']}, families of {entry['partner_split']}; choose another folder"
            )
    others = [found.get_policy(partner) for partner in chosen]
    trainings = resolve_policies(agent, policies, dataset, config, execution.trust)
    if len({policy.code_hash for policy in trainings}) < len(trainings):
        raise OptionError(f"{agent} must name different policies, got two with the same code and weights; drop one")
    givers, receivers = (others, trainings) if agent == "receiver" else (trainings, others)
    result = crossplay(givers, receivers, config, execution=execution)
    names, labels = (result.receivers, result.givers) if agent == "receiver" else (result.givers, result.receivers)
    if len(labels) != len(chosen):
        raise OptionError(f"population {found.path} must have different policies, got two with the same label")
    reports = {
        (name, partner.name): result.reports[(label, name) if agent == "receiver" else (name, label)]
        for name in names
        for partner, label in zip(chosen, labels, strict=True)
    }
    report = StrangersReport(found.label, partners, agent, names, chosen, reports)
    report = replace(report, references=table.find_all(report.condition, [each.name for each in chosen]))
    if folder is not None:
        _write_entry(folder, report)
    return report


def _write_entry(folder: Path, report: StrangersReport) -> None:
    """Write `strangers.json`, with the folders that `crossplay` gave to the pairs, and `strangers.md`."""
    folders: dict[str, dict[str, str]] = {policy: {} for policy in report.policies}
    for (policy, partner), pair in report.reports.items():
        folders[policy][partner] = format_pair_folder((pair.metadata.giver, pair.metadata.receiver))
    content = {
        "population": report.population,
        "partner_split": report.partner_split,
        "agent": report.agent,
        "policies": report.policies,
        "partners": [asdict(partner) for partner in report.partners],
        "folders": folders,
        **report.to_json(),
    }
    write_atomically(folder / ENTRY_FILE, json.dumps(content, indent=1, allow_nan=False) + "\n")
    write_atomically(folder / TABLES_FILE, f"# Strangers\n\n{report}\n")


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
