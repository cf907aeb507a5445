"""Protocol of the evaluation with partners that a policy has not met."""

import os
from collections.abc import Sequence
from dataclasses import replace

from typing_extensions import Unpack

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError
from handover_marl.evaluation.config import EvaluationConfig, EvaluationOptions, ExecutionConfig, build_configs
from handover_marl.evaluation.crossplay import CrossPlay, crossplay, resolve_policies
from handover_marl.evaluation.strangers.entry import StrangersEntry, check_folder, write_entry
from handover_marl.evaluation.strangers.references import load_population_references
from handover_marl.evaluation.strangers.report import StrangersReport
from handover_marl.execution.options import check_path, forward_signature
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, Population, load_population
from handover_marl.policies.reference import PolicyLike

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
    **options: Unpack[EvaluationOptions],
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
    chosen = found.select("giver" if agent == "receiver" else "receiver", partners)
    config = _choose_scenes(config, n_scenes)
    table = load_population_references(found, None if references is None else check_path("references", references))
    if execution.folder is not None and not execution.fresh:
        check_folder(execution.folder, found.content_hash, partners)
    others = [found.get_policy(partner) for partner in chosen]
    trainings = resolve_policies(agent, policies, config.open_dataset(), config, execution.trust)
    if len({policy.code_hash for policy in trainings}) < len(trainings):
        raise OptionError(f"{agent} must name different policies, got two with the same code and weights; drop one")
    givers, receivers = (others, trainings) if agent == "receiver" else (trainings, others)
    result = crossplay(givers, receivers, config, execution=execution)
    report = _make_report(result, agent, found, chosen, partners)
    report = replace(report, references=table.find_all(report.condition, [each.name for each in chosen]))
    if execution.folder is not None:
        write_entry(execution.folder, StrangersEntry.from_report(report, found), report)
    return report


def _choose_scenes(config: EvaluationConfig, n_scenes: int) -> EvaluationConfig:
    if config.scenes is not None:
        return config
    dataset = config.open_dataset()
    split = dataset.list_scenes(dataset.resolve_setup(config.setup), config.split)
    return replace(config, scenes=select_scenes_evenly(split, n_scenes))


def _make_report(
    result: CrossPlay, agent: str, population: Population, partners: tuple[Partner, ...], split: str
) -> StrangersReport:
    policies, others = (result.receivers, result.givers) if agent == "receiver" else (result.givers, result.receivers)
    if len(others) != len(partners):
        raise OptionError(f"population {population.path} must have different policies, got two with the same label")
    reports = {
        (policy, partner.name): result.reports[(other, policy) if agent == "receiver" else (policy, other)]
        for policy in policies
        for partner, other in zip(partners, others, strict=True)
    }
    return StrangersReport(population.label, split, agent, policies, partners, reports)
