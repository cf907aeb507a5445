"""Protocol of the evaluation with unseen partners, and its leaderboard."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig, build_configs
from handover_marl.evaluation.crossplay import crossplay, resolve_policies
from handover_marl.evaluation.reports.tables import N_EPISODES, ReportTable, TabularResult
from handover_marl.evaluation.strangers.report import (
    COLUMNS,
    ENTRY_FILE,
    NOTE,
    OTHER_AGENT,
    StrangersReport,
    estimate_mean_score,
    list_differences,
    make_report,
    read_report,
    read_strangers_entry,
)
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path, forward_signature, require_modules
from handover_marl.policies.populations import DEFAULT_POPULATION, load_population
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.engines import FAST

#: Number of scenes for each partner: 648 episodes with the 18 test givers of `strangers-v1`.
DEFAULT_N_SCENES = 36


_OTHERS = dict.fromkeys(("world_config", "inference_time", "shard"), "use crossplay for other conditions")


@forward_signature(EvaluationConfig, ExecutionConfig, without=_OTHERS, defaults={"physics": FAST})
def strangers(
    receiver: Sequence[PolicyLike] | PolicyLike | None = None,
    giver: Sequence[PolicyLike] | PolicyLike | None = None,
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    partners: str = "test",
    n_scenes: int = DEFAULT_N_SCENES,
    setup: str | None = None,
    split: str = "test",
    **options: Any,
) -> StrangersReport:
    """Evaluate a receiver, or a giver, with unseen partners from a population.

    Args:
        receiver: Receiver to evaluate with givers, as for `benchmark`; or a sequence of trainings of one method.
        giver: Giver to evaluate with receivers, in place of a receiver; or a sequence of trainings.
        population: Name of a shipped population, or path of a file; see `handover_marl.policies.populations`.
        partners: Families (groups of similar partners) of the population to evaluate with: "train", "test" or "all".
        n_scenes: Number of scenes, evenly spaced over the split, at most all; ignored if `scenes` is given.
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: Split of the scenes, "train", "val" or "test".
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`; the default of
            `physics` is "fast". The folder `out` gets a result folder for each pair, the files of `crossplay`,
            `strangers.md` and `strangers.json`; an interrupted evaluation resumes there.

    Raises:
        OptionError: Not exactly one of receiver and giver is given, two trainings are the same, world or rules are not
            official, there are no such partners, or the output folder belongs to another population or `partners`.
        HandoverError: The same errors as `crossplay` and `load_population`.
    """
    options = {"physics": FAST, **options, "setup": setup, "split": split}
    config, execution = build_configs(options)
    policies = giver if receiver is None else receiver
    if policies is None or (receiver is not None and giver is not None):
        raise OptionError("pass exactly one of receiver and giver; the population has partners for both")
    agent = "receiver" if giver is None else "giver"
    found = load_population(population, execution.trust)
    others = [found.get_policy(partner) for partner in found.select(OTHER_AGENT[agent], partners)]
    dataset = config.open_dataset()
    if config.scenes is None:
        scenes = dataset.list_scenes(dataset.resolve_setup(config.setup), config.split)
        options["scenes"] = select_scenes_evenly(scenes, n_scenes)
    trainings = resolve_policies(agent, policies, dataset, config, execution.trust)
    if len({policy.code_hash for policy in trainings}) < len(trainings):
        raise OptionError(f"{agent} must name different policies, got two with the same code and weights; drop one")
    folder = execution.folder
    if folder is not None and not execution.overwrite and (folder / ENTRY_FILE).is_file():
        stored = read_strangers_entry(folder)
        kept = {giver if stored.agent == "giver" else receiver for giver, receiver in stored.pairs}
        is_same = (stored.population, stored.partner_split, stored.agent) == (found.label, partners, agent)
        if not is_same or not kept <= {policy.label for policy in trainings}:
            raise OptionError(
                f"out must be a folder of this {agent}, population {found.label} and families of {partners}; {folder} "
                f"is of {stored.agent} {', '.join(sorted(kept))}, {stored.population} and families of "
                f"{stored.partner_split}; choose another folder"
            )
    givers, receivers = (trainings, others) if agent == "giver" else (others, trainings)
    result = crossplay(givers, receivers, **options)
    report = make_report(result, found, partners, agent)
    if folder is not None:
        report.write(folder)
    return report


@dataclass(frozen=True, eq=False)
class Leaderboard(TabularResult):
    """Evaluations of several methods with the same partners. `str` returns Markdown tables.

    Attributes:
        reports: Report of every (name of the method, split of the scenes), the methods with the largest average success
            (AS) first, and the splits of a method one after the other. All reports of a split have the same scenes.
    """

    reports: dict[tuple[str, str], StrangersReport]

    @property
    def titles(self) -> list[str]:
        """Titles of the reports in tables, such as "METHOD, test": name of the method and split of the scenes."""
        return [", ".join(key) for key in self.reports]

    @property
    def conditions(self) -> str:
        """Scenes, simulation and data of the evaluations as text."""
        firsts = {split: report.first_report for (_, split), report in self.reports.items()}
        scenes = [f"{len(report.episodes)} scenes of {split}" for split, report in firsts.items()]
        report = next(iter(firsts.values()))
        metadata = report.metadata
        return (
            f"{metadata.setup}, {' and '.join(scenes)} each, {metadata.physics} physics, seed {metadata.seed}, data: "
            f"{report.data_label}, handover_marl {metadata.version}"
        )

    def write_heat_map(self, path: Path) -> None:
        """Write a heat map of the success rates by partner and method as PNG; requires the extra `plot`."""
        require_modules("the heat map", "plot", "matplotlib")
        from handover_marl.visualization.pictures import draw_heat_map

        first = next(iter(self.reports.values()))
        rates = np.stack([report.successes.mean(axis=(0, 2)) for report in self.reports.values()], axis=1).tolist()
        partners = [f"{partner.name} ({partner.family})" for partner in first.partners]
        labels = (OTHER_AGENT[first.agent], first.agent)
        title = f"{first.population}\n{self.conditions}"
        write_atomically(path, draw_heat_map(rates, partners, self.titles, title, labels))

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables (scores, differences to the first method, success by family) and notes."""
        first = next(iter(self.reports.values()))
        scores, differences, baselines = [], [], dict[str, tuple[str, StrangersReport]]()
        for (name, split), report in self.reports.items():
            found, robot = report.estimate_all(), report.first_report.metadata.robot
            cells = [found[key].format() for key in COLUMNS]
            scores.append([name, split, len(report.policies), robot, *cells, report.scores.size])
            best, base = baselines.setdefault(split, (name, report))
            if report is not base:
                arrays = [(getattr(base, kind), getattr(report, kind)) for kind in ("successes", "contacts", "scores")]
                gains = [estimate_mean_score(first, base.partner_families, second) for first, second in arrays]
                differences.append([best, name, split, *(gain.format("+.1f") for gain in gains)])
        families = [
            [family, *(f"{100 * report.successes[:, chosen].mean():.1f}" for report in self.reports.values())]
            for family, chosen in first.families.items()
        ]
        gain_titles = ["success, points", "contact, points", "AS, points"]
        return [
            f"{len(first.partners)} partners of {first.population}, families of {first.partner_split}; "
            f"{self.conditions}.",
            ReportTable(
                ["method", "split", "trainings", "robot", *COLUMNS.values(), N_EPISODES.title], scores, n_keys=2
            ),
            ReportTable(["method", "minus", "split", *gain_titles], differences, n_keys=3),
            ReportTable(["family", *(f"{title}: success %" for title in self.titles)], families),
            f"{NOTE} Differences are paired by partner and scene.",
        ]


def make_leaderboard(
    folders: Sequence[str | os.PathLike[str]],
    population: str | os.PathLike[str] = DEFAULT_POPULATION,
    names: Sequence[str] | None = None,
    trust: bool = False,
) -> Leaderboard:
    """Make the leaderboard of folders that `strangers` wrote, one for each method and split of scenes.

    Every value is computed from the result folders of the pairs.

    Args:
        folders: Output folders of `strangers` with equal partners, data and simulation, and the same scenes per split.
        population: Population of the evaluations: name of a shipped one, or path of a file.
        names: Name of the method of every folder; default: the labels of its policies.
        trust: Whether modules that the population names may be imported.

    Raises:
        OptionError: There is no folder, a method has two folders of a split, or the folders are of another population.
        ResultsError: An evaluation is not finished, or differs in partners, scenes, data, seed or simulation.
    """
    if not folders or len(folders) != len(folders if names is None else names):
        given = f"{len(folders)} folders{'' if names is None else f' and {len(names)} names'}"
        raise OptionError(f"folders must name folders of handover-marl strangers, all named or none, got {given}")
    found, conditions = load_population(population, trust), dict[object, dict[str, object]]()
    reports: dict[tuple[str, str], StrangersReport] = {}
    for number, folder in enumerate(folders):
        path = check_path("folder", folder)
        report = read_report(path, found)
        name = ", ".join(report.policies) if names is None else names[number]
        condition, split = report.condition, report.first_report.metadata.split
        if (name, split) in reports:
            raise OptionError(
                f"folders must have one evaluation of {name!r} with the split {split}, got another one in {path}; name "
                "the methods, as NAME=DIR"
            )
        reports[name, split] = report
        differences = {*list_differences(condition, conditions.setdefault("", condition))} - {"split", "scenes", "data"}
        differences.update(list_differences(condition, conditions.setdefault(split, condition)))
        if differences:
            raise ResultsError(
                f"{path} must have the {' and '.join(sorted(differences))} of the other folders; evaluate with the "
                "same version, partners, seed, scenes, data and physics"
            )
    # Methods are sorted by their AS on the split of the first folder; each method's splits follow one another.
    splits = list(dict.fromkeys(split for _, split in reports))
    keys = sorted(reports, key=lambda key: (splits.index(key[1]), -reports[key].scores.mean()))
    order = list(dict.fromkeys(name for name, _ in keys))
    return Leaderboard({key: reports[key] for key in sorted(keys, key=lambda key: order.index(key[0]))})
