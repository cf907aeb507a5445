"""Protocol of the evaluation with partners that a policy has not met, and update of its reference scores."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig, build_configs
from handover_marl.evaluation.crossplay import crossplay, resolve_policies
from handover_marl.evaluation.metadata import CONFIG_FILE, OFFICIAL_WORLD
from handover_marl.evaluation.reports.report import Report, evaluate
from handover_marl.evaluation.strangers.references import Condition, Reference, ReferenceTable, load_references
from handover_marl.evaluation.strangers.report import ENTRY_FILE, OTHER_AGENT, StrangersReport, read_entry
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path, forward_signature
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, Population, load_population
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
    table = load_references(found, references)
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
        report.write(folder)
    return report


def update_references(
    folders: Iterable[str | os.PathLike[str]],
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    out: str | os.PathLike[str] | None = None,
    trust: bool = False,
) -> ReferenceTable:
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
    table = load_references(found, out, is_new=True)
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
    write_atomically(path, table.to_json())
    return table


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
