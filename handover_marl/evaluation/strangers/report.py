"""Report of an evaluation with unseen partners, its output folder, and 95 % intervals of scores by a jackknife.

An output folder has the files of `crossplay` and, in `strangers.json`, the population, the agent of the evaluated
policies and the labels of the pairs (giver, receiver).

Arrays of scores have the axes policies (several trainings of one method), partners and scenes.

An interval is a statistic plus and minus a standard error times a quantile of Student's distribution. The squared
standard error is the sum of the jackknife variances (Efron and Stein, Annals of Statistics 9(3), 1981) when policies,
families of partners and scenes are left out one at a time; its degrees of freedom are Satterthwaite's. The interval of
a rate is Wilson's with the same quantile, for the number of independent episodes that have this standard error (Korn
and Graubard, Survey Methodology 24(2), 1998). Percentiles of a bootstrap are too narrow for six families.
"""

import functools
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.crossplay import CrossPlay, PolicyPair, format_pair_folder
from handover_marl.evaluation.reports.report import Report, load_report
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    FLUENCY,
    N_EPISODES,
    NO_VALUE,
    Estimate,
    ReportTable,
    TabularResult,
    estimate_average_success,
    estimate_fluency,
    format_percent_rate,
)
from handover_marl.evaluation.results import EpisodeResult
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.populations import Partner, Population

Array = npt.NDArray[np.float64]
#: Function from the rates (partners,) with the partners to a number, such as `np.min` for the worst partner.
Statistic = Callable[[Array], np.floating]
ENTRY_FILE, TABLES_FILE = "strangers.json", "strangers.md"
_CONDITION = ("dataset", "setup", "split", "physics", "missing_package", "seed", "world", "version")
_MAX_BYTES = 1_000_000
#: Agent of the partners, by the agent of the evaluated policies.
OTHER_AGENT = {"receiver": "giver", "giver": "receiver"}
_PARTNER_METRICS = ("max_robot_hand_force", "max_robot_object_force", "human_idle")
_METRIC_COLUMNS = tuple(column for column in FLUENCY if column.key in _PARTNER_METRICS)
#: Titles of the metrics of a method, by key.
COLUMNS = {
    "success": "success %",
    "contact": "contact %",
    AVERAGE_SUCCESS.key: AVERAGE_SUCCESS.title,
    "worst_partner_success": "worst success %",
    "largest_partner_contact": "largest contact %",
}

NOTE = (
    "Success, contact and AS: means over partners, scenes and policies. 95 % intervals: jackknife over policies, "
    "families and scenes, in a single family over its partners; for the worst and the largest value over policies and "
    "scenes; those of rates are at least as wide as Wilson's. By partner: Wilson and bootstrap."
)


@dataclass(frozen=True, eq=False)
class StrangersReport(TabularResult):
    """Results of the policies of one method with a population of partners. `str` returns Markdown tables.

    Attributes:
        population: Name, version and hash of the population.
        partner_split: Split of the population, "train", "test" or "all".
        agent: Agent of the evaluated policies, "receiver" or "giver".
        policies: Labels of the evaluated policies, several trainings of one method.
        partners: Partners with whom every policy was evaluated.
        reports: Report of every (label of the policy, name of the partner).
    """

    population: str
    partner_split: str
    agent: str
    policies: tuple[str, ...]
    partners: tuple[Partner, ...]
    reports: dict[tuple[str, str], Report]

    @property
    def first_report(self) -> Report:
        """Report of the first policy with the first partner."""
        return next(iter(self.reports.values()))

    @property
    def partner_families(self) -> list[str]:
        """Family of every partner, in the order of `partners`."""
        return [partner.family for partner in self.partners]

    @property
    def families(self) -> dict[str, list[int]]:
        """Indices in `partners` of the members of each family, by the family's name."""
        names = self.partner_families
        return {family: [number for number, name in enumerate(names) if name == family] for family in names}

    @property
    def condition(self) -> dict[str, object]:
        """Condition of all reports (`describe_condition`), with the evaluated agent and the partners' code hashes."""
        key = f"{OTHER_AGENT[self.agent]}_hash"
        codes = {partner: getattr(report.metadata, key) for (_, partner), report in self.reports.items()}
        return {**describe_condition(self.first_report), "agent": self.agent, "partners": codes}

    @functools.cached_property
    def scores(self) -> Array:
        """Scores of episodes (policies, partners, scenes), 0 to 1, whose mean is the average success (AS)."""
        return self._collect(lambda episode: episode.speed_score)

    @functools.cached_property
    def successes(self) -> Array:
        """Successes (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(episode.success))

    @functools.cached_property
    def contacts(self) -> Array:
        """Contacts between robot and person (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(bool(episode.status & EpisodeStatus.HUMAN_CONTACT)))

    def _collect(self, measure: Callable[[EpisodeResult], float]) -> Array:
        rows = itertools.product(self.policies, self.partners)
        values = [[measure(each) for each in self.reports[policy, partner.name].episodes] for policy, partner in rows]
        return np.array(values).reshape(len(self.policies), len(self.partners), -1)

    def estimate_all(self) -> dict[str, Estimate]:
        """Return estimates (0..1) of the metrics of a method, by the keys of `COLUMNS`."""
        return self._estimate_means(range(len(self.partners))) | {
            "worst_partner_success": estimate_partner_rate(np.min, self.successes, None),
            "largest_partner_contact": estimate_partner_rate(np.max, self.contacts, None),
        }

    def _estimate_means(self, indices: Sequence[int]) -> dict[str, Estimate]:
        """Return estimates of success, contact and AS (0..1), by key, over the partners at the given `indices`."""
        families = [self.partners[number].family for number in indices]
        success = estimate_partner_rate(np.mean, self.successes[:, indices], families)
        score = estimate_mean_score(self.scores[:, indices], families)
        return {
            "success": success,
            "contact": estimate_partner_rate(np.mean, self.contacts[:, indices], families),
            # Without a success the jackknife has no width, as in `estimate_average_success`.
            AVERAGE_SUCCESS.key: score if score.mean else replace(score, interval_95=success.interval_95),
        }

    def find_worst_partner(self) -> Partner:
        """Return the partner with the smallest success rate; among equal ones, the one with the smallest AS."""
        rates = zip(self.successes.mean(axis=(0, 2)), self.scores.mean(axis=(0, 2)), strict=True)
        return self.partners[min(enumerate(rates), key=lambda pair: pair[1])[0]]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables (summary, families, partners) and notes."""
        report, metadata, found = self.first_report, self.first_report.metadata, self.estimate_all()
        titles = COLUMNS | {
            "worst_partner_success": f"success % with the worst partner ({self.find_worst_partner().name})",
            "largest_partner_contact": "contact % with the partner with most contacts",
        }
        summary = [[title, found[key].format()] for key, title in titles.items()]
        families = [
            [family, *(mean.format() for mean in self._estimate_means(indices).values()), self.scores[:, indices].size]
            for family, indices in self.families.items()
        ]
        return [
            f"{self.agent.capitalize()} {', '.join(self.policies)} with {len(self.partners)} "
            f"{OTHER_AGENT[self.agent]}s of {self.population}, families of {self.partner_split}.\n{metadata.setup} "
            f"{metadata.split}, {report.extent} for each, {metadata.physics} physics, seed {metadata.seed}, data: "
            f"{report.data_label}. handover_marl {metadata.version}.",
            ReportTable(["metric", "value (95 % interval)"], summary),
            ReportTable(["family", "success %", "contact %", "AS %", N_EPISODES.title], families),
            self._build_partner_table(),
            NOTE,
        ]

    def _build_partner_table(self) -> ReportTable:
        rows = []
        for number, partner in enumerate(self.partners):
            episodes = [each for policy in self.policies for each in self.reports[policy, partner.name].episodes]
            n, means = len(episodes), estimate_fluency(episodes)
            counts = [int(flags[:, number].sum()) for flags in (self.successes, self.contacts)]
            cells = [format_percent_rate(count, n) for count in counts]
            cells.append(estimate_average_success([each.speed_score for each in episodes]).format(".2f", ".1f"))
            metrics = [(column.scale, means[column.key].mean if means else None) for column in _METRIC_COLUMNS]
            forces = [NO_VALUE if mean is None else f"{scale * mean:.3g}" for scale, mean in metrics]
            rows.append([partner.name, partner.family, *cells, *forces, n])
        header = ["partner", "family", "success %", "contact %", "AS %"]
        return ReportTable([*header, *(column.title for column in _METRIC_COLUMNS), N_EPISODES.title], rows, n_keys=2)

    def write(self, folder: Path) -> None:
        """Write population, agent and pairs (`strangers.json`) and the tables (`strangers.md`) to an output folder."""
        pairs = [(report.metadata.giver, report.metadata.receiver) for report in self.reports.values()]
        scenes = [episode.scene_id for episode in self.first_report.episodes]
        entry = StrangersEntry(self.population, self.partner_split, self.agent, pairs, scenes)
        write_atomically(folder / ENTRY_FILE, json.dumps(entry._asdict(), indent=1) + "\n")
        write_atomically(folder / TABLES_FILE, f"# Strangers\n\n{self}\n")


def describe_condition(report: Report) -> dict[str, object]:
    """Return the condition of an evaluation by name: simulation, scene numbers and data of each scene.

    Scores are comparable only under the same condition.
    """
    return {
        **{name: getattr(report.metadata, name) for name in _CONDITION},
        "scenes": [episode.scene_id for episode in report.episodes],
        "data": [(each.fingerprint, each.n_objects, each.models) for each in report.episodes],
    }


def list_differences(first: Mapping[str, object], second: Mapping[str, object]) -> list[str]:
    """Return the names of the values in which two conditions (`describe_condition`) differ."""
    return [name for name, value in first.items() if value != second[name]]


def make_report(crossplay: CrossPlay, population: Population, split: str, agent: str) -> StrangersReport:
    """Make the report on the policies of `agent` from their cross-play with the partners in a population's `split`."""
    partners, is_giver = population.select(OTHER_AGENT[agent], split), agent == "giver"
    names, labels = crossplay.givers, crossplay.receivers
    if not is_giver:
        names, labels = labels, names
    if len(labels) != len(partners):
        raise ResultsError(f"the evaluation must have the {len(partners)} partners of {split!r}, got {len(labels)}")
    reports = {
        (name, partner.name): crossplay.reports[(name, label) if is_giver else (label, name)]
        for name in names
        for partner, label in zip(partners, labels, strict=True)
    }
    return StrangersReport(population.label, split, agent, names, partners, reports)


class StrangersEntry(NamedTuple):
    """Content of `strangers.json`; `pairs` are labels (giver, receiver), `scenes` the scene numbers of the last run."""

    population: str
    partner_split: str
    agent: str
    pairs: list[PolicyPair]
    scenes: Sequence[int | None]


def read_strangers_entry(folder: Path) -> StrangersEntry:
    """Read `strangers.json` in an output folder of `strangers`; raise `ResultsError` if that fails."""
    path = folder / ENTRY_FILE
    try:
        content = json.loads(read_plain_file(path, _MAX_BYTES))
        pairs = [(str(giver), str(receiver)) for giver, receiver in content["pairs"]]
        population, partner_split, agent = (str(content[key]) for key in ("population", "partner_split", "agent"))
        entry = StrangersEntry(population, partner_split, agent, pairs, [int(scene) for scene in content["scenes"]])
        if entry.agent not in OTHER_AGENT:
            raise ValueError(f"agent must be one of {', '.join(OTHER_AGENT)}")
    except FileNotFoundError as error:
        raise ResultsError(
            f"{path} does not exist: run `handover-marl strangers` into this folder, or the same command again if it "
            "was interrupted"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ResultsError(f"{path}: not a readable evaluation with strangers ({shorten_text(error)})") from error
    return entry


def read_report(folder: Path, population: Population) -> StrangersReport:
    """Compute the report of an output folder of `strangers` from its stored results in the scenes of the last run."""
    entry = read_strangers_entry(folder)
    if entry.population != population.label:
        raise OptionError(
            f"{folder} must be of population {population.label}, got {entry.population}; pass the population's file"
        )
    reports: dict[PolicyPair, Report] = {}
    for pair in entry.pairs:
        report = load_report(folder / format_pair_folder(pair))
        episodes = tuple(episode for episode in report.episodes if episode.scene_id in entry.scenes)
        report = reports[pair] = replace(report, episodes=episodes)
        differences = list_differences(*map(describe_condition, (report, next(iter(reports.values())))))
        differences += [] if (report.metadata.giver, report.metadata.receiver) == pair else [f"labels {pair}"]
        if differences:
            raise ResultsError(
                f"{folder / format_pair_folder(pair)} must have the {' and '.join(differences)} of the other pairs; "
                "run the same command to resume"
            )
    return make_report(CrossPlay(reports), population, entry.partner_split, entry.agent)


def estimate_mean_score(scores: Array, families: Sequence[str] | None, minus: Array | None = None) -> Estimate:
    """Estimate the mean of scores (policies, partners, scenes), 0 to 1, with a 95 % interval.

    The jackknife leaves out policies, scenes and families of partners one at a time, or partners if there is one
    family. `families` has the family of each partner; with None, no partner is left out, as for the worst partner.
    With the scores of another method, `minus`, the difference of the means is estimated, paired by partner and scene;
    the numbers of policies may differ. Its interval is at least as wide as that of Agresti and Min (2005).
    """

    def compute(own: Array, *others: Array) -> float:
        return float(own.mean() - sum(other.mean() for other in others))

    value, error, quantile = _apply_jackknife(compute, [scores] if minus is None else [scores, minus], families)
    if minus is None and scores.size == 1:
        return Estimate(value, None, 1)
    if minus is not None:
        gains = scores.mean(axis=0) - minus.mean(axis=0)
        n = gains.size + 2
        error = max(error, float(np.sqrt((gains**2).sum() + 1.0 - gains.sum() ** 2 / n)) / n)
    low, high = value - quantile * error, value + quantile * error
    return Estimate(value, (max(0.0 if minus is None else -1.0, low), min(1.0, high)), scores.size)


def estimate_partner_rate(statistic: Statistic, flags: Array, families: Sequence[str] | None) -> Estimate:
    """Estimate a `statistic` of the partners' rates, with a 95 % interval at least as wide as Wilson's.

    `flags` (policies, partners, scenes) has 0 or 1 for each episode. `families` is as in `estimate_mean_score`; None is
    for the rate with a single partner, e.g. `np.min` for the worst.
    """
    value, error, quantile = _apply_jackknife(
        lambda own: float(statistic(own.mean(axis=2).mean(axis=0))), [flags], families
    )
    n = flags.size if families is not None else flags.size // flags.shape[1]
    weight = quantile**2 / (min(n, value * (1.0 - value) / error**2) if error else n)
    center = (value + weight / 2.0) / (1.0 + weight)
    half = np.sqrt(weight * value * (1.0 - value) + weight**2 / 4.0) / (1.0 + weight)
    return Estimate(value, (max(0.0, float(center - half)), min(1.0, float(center + half))), n)


def _apply_jackknife(
    compute: Callable[..., float], methods: list[Array], families: Sequence[str] | None
) -> tuple[float, float, float]:
    """Return `compute(*methods)`, its jackknife standard error, and the 97.5 % quantile of Student's distribution.

    `methods` has the scores (policies, partners, scenes) of each method; `families` is as in `estimate_mean_score`.
    """
    shape = methods[0].shape
    everywhere = range(len(methods))
    # For each variance: the arrays that change together, their axis, and the index sets that are left out in turn.
    variations: list[tuple[Sequence[int], int, list[list[int]]]] = [(everywhere, 2, _group(range(shape[2])))]
    variations += [([number], 0, _group(range(len(method)))) for number, method in enumerate(methods)]
    if families is not None:
        variations.append((everywhere, 1, _group(families if len(set(families)) > 1 else range(shape[1]))))
    variances, freedoms = [], []
    for chosen, axis, groups in variations:
        if len(groups) > 1:
            values = [
                compute(*(np.delete(each, group, axis) if n in chosen else each for n, each in enumerate(methods)))
                for group in groups
            ]
            freedoms.append(len(groups) - 1)
            variances.append(freedoms[-1] * np.var(values))
    variance = np.array(variances)
    freedom = variance.sum() ** 2 / (variance**2 / freedoms).sum() if variance.any() else np.inf
    return compute(*methods), float(np.sqrt(variance.sum())), float(scipy.stats.t.ppf(0.975, freedom))


def _group(labels: Sequence[object]) -> list[list[int]]:
    """Return one list for each different label: the indices of its entries."""
    return [[n for n, label in enumerate(labels) if label == one] for one in dict.fromkeys(labels)]
