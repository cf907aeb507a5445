"""Report of an evaluation with partners that the evaluated policies have not met."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.episode_tables import estimate_fluency
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    FLUENCY,
    N_EPISODES,
    NO_VALUE,
    ReportTable,
    TabularResult,
    append_interval,
    format_percent_mean,
    format_percent_rate,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.strangers.references import Condition, Reference
from handover_marl.evaluation.strangers.scores import (
    Estimate,
    Statistic,
    compute_largest,
    compute_mean,
    compute_proximity,
    compute_worst,
    compute_worst_proximity,
    estimate,
    estimate_rate,
)
from handover_marl.policies.populations import Partner

Array = npt.NDArray[np.float64]
#: Agent of the partners, by the agent of the evaluated policies.
OTHER_AGENT = {"receiver": "giver", "giver": "receiver"}
_PARTNER_METRICS = ("max_robot_hand_force", "max_robot_object_force", "human_idle")
_METRIC_COLUMNS = tuple(column for column in FLUENCY if column.key in _PARTNER_METRICS)

NOTE = (
    "Success, contact and AS: means over partners, scenes and policies. 95 % intervals: jackknife over policies, "
    "families and scenes, in a single family over its partners; for the worst and the largest value over policies and "
    "scenes; those of rates are at least as wide as Wilson's. By partner: Wilson and bootstrap."
)
PROXIMITY_NOTE = (
    "BR-Prox: AS divided by the AS of the best policy known for the partner on these scenes, interquartile mean over "
    "partners and policies; without an interval for a method that is itself the best known with a partner."
)
NO_REFERENCES_NOTE = (
    "No BR-Prox: a partner has no reference for this version, physics, seed, scenes and data (hash, models, number of "
    "objects). Search best responses on these scenes (experiments/strangers/search_best_responses.py) and pass them to "
    "handover-marl strangers-references."
)


@dataclass(frozen=True, eq=False)
class StrangersReport(TabularResult):
    """Results of the policies of one method with a population of partners. `str` returns Markdown tables.

    Attributes:
        population: Name, version and hash of the population.
        partner_split: Split of the population, "train", "test" or "all".
        agent: Agent of the evaluated policies, "receiver" or "giver".
        policies: Labels of the evaluated policies, several trainings of one method.
        partners: Partners.
        reports: Report of every (label of the policy, name of the partner).
        references: Best policy known for each partner on these scenes, or None if a partner has none.
    """

    population: str
    partner_split: str
    agent: str
    policies: tuple[str, ...]
    partners: tuple[Partner, ...]
    reports: dict[tuple[str, str], Report]
    references: tuple[Reference, ...] | None = None

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the partners, in their order."""
        return tuple(dict.fromkeys(partner.family for partner in self.partners))

    @property
    def partner_families(self) -> list[str]:
        """Family of every partner."""
        return [partner.family for partner in self.partners]

    @property
    def best_scores(self) -> Array | None:
        """Scores (partners, scenes) of the references, or None if a partner has none."""
        return None if self.references is None else np.array([reference.scores for reference in self.references])

    @property
    def is_reference(self) -> bool:
        """Whether an evaluated policy is itself the reference of a partner, which defines its proximity as 1."""
        return any(reference.policy in self.policies for reference in self.references or ())

    @property
    def condition(self) -> Condition:
        """Scenes and simulation."""
        return Condition.from_report(self.agent, next(iter(self.reports.values())))

    @functools.cached_property
    def scores(self) -> Array:
        """Scores of average success (policies, partners, scenes)."""
        return self._collect(lambda episode: episode.speed_score)

    @functools.cached_property
    def successes(self) -> Array:
        """Successes (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(episode.success))

    @functools.cached_property
    def contacts(self) -> Array:
        """Contacts between robot and person (policies, partners, scenes), 0 or 1."""
        return self._collect(lambda episode: float(bool(episode.status & EpisodeStatus.HUMAN_CONTACT)))

    def estimate_all(self) -> dict[str, Estimate]:
        """Estimate the metrics of the summary, by key; rates and shares 0..1, BR-Prox without references left out."""
        families = self.partner_families
        found = {
            "success": estimate_rate(compute_mean, self.successes, families),
            "contact": estimate_rate(compute_mean, self.contacts, families),
            AVERAGE_SUCCESS.key: estimate(compute_mean, self.scores, families),
            "worst_partner_success": estimate_rate(compute_worst, self.successes, None),
            "largest_partner_contact": estimate_rate(compute_largest, self.contacts, None),
        }
        if self.best_scores is not None:
            found["br_prox"] = self._estimate_proximity(compute_proximity, families, self.best_scores)
            found["worst_br_prox"] = self._estimate_proximity(compute_worst_proximity, None, self.best_scores)
        return found

    def _estimate_proximity(self, statistic: Statistic, families: Sequence[str] | None, references: Array) -> Estimate:
        found = estimate(statistic, self.scores, families, references)
        return replace(found, interval_95=None) if self.is_reference else found

    def find_worst_partner(self) -> Partner:
        """Return the partner with the smallest success rate; of several the one with the smallest AS."""
        rates = zip(self.successes.mean(axis=(0, 2)), self.scores.mean(axis=(0, 2)), strict=True)
        return self.partners[min(enumerate(rates), key=lambda pair: pair[1])[0]]

    def build_tables(self) -> list[ReportTable]:
        """Build the tables of the summary, of families and of partners."""
        return [self._build_summary(), self._build_family_table(), self._build_partner_table()]

    def build_sections(self) -> list[str | ReportTable]:
        """Build heading, tables and notes."""
        summary, families, partners = self.build_tables()
        notes = f"{NOTE} {NO_REFERENCES_NOTE if self.references is None else PROXIMITY_NOTE}"
        return [self._format_heading(), summary, families, partners, notes]

    def to_json(self) -> dict[str, object]:
        """Return the summary and the results by partner as JSON types; rates 0..1."""
        return {
            "summary": {
                key: {"value": each.value, "interval_95": each.interval_95} for key, each in self.estimate_all().items()
            },
            "worst_partner": self.find_worst_partner().name,
            "n_policies": len(self.policies),
            "n_partners": len(self.partners),
            "n_scenes": self.scores.shape[2],
            "results": {
                partner.name: {
                    "family": partner.family,
                    "success": float(self.successes[:, number].mean()),
                    "contact": float(self.contacts[:, number].mean()),
                    AVERAGE_SUCCESS.key: float(self.scores[:, number].mean()),
                    "reference_AS": None if self.references is None else self.references[number].mean,
                }
                for number, partner in enumerate(self.partners)
            },
        }

    def collect_episodes(self, partner: Partner) -> list[EpisodeResult]:
        """Return the episodes of all policies with a partner."""
        return [episode for policy in self.policies for episode in self.reports[policy, partner.name].episodes]

    def _collect(self, measure: Callable[[EpisodeResult], float]) -> Array:
        return np.array(
            [[[measure(each) for each in self.reports[policy, partner.name].episodes] for partner in self.partners]
             for policy in self.policies]
        )  # fmt: skip

    def _format_heading(self) -> str:
        report = next(iter(self.reports.values()))
        metadata = report.metadata
        kind = "givers" if self.agent == "receiver" else "receivers"
        return (
            f"{self.agent.capitalize()} {', '.join(self.policies)} with {len(self.partners)} {kind} of "
            f"{self.population}, families of {self.partner_split}.\n{metadata.setup} {metadata.split}, {report.extent} "
            f"for each, {metadata.physics} physics, seed {metadata.seed}, data: {report.data_label}. handover_marl "
            f"{metadata.version}."
        )

    def _build_summary(self) -> ReportTable:
        titles = {
            "success": "success %",
            "contact": "contact %",
            AVERAGE_SUCCESS.key: AVERAGE_SUCCESS.title,
            "br_prox": "BR-Prox %",
            "worst_partner_success": f"success % with the worst partner ({self.find_worst_partner().name})",
            "worst_br_prox": "BR-Prox % with the worst partner",
            "largest_partner_contact": "contact % with the partner with most contacts",
        }
        found = self.estimate_all()
        rows = [[title, format_estimate(found[key])] for key, title in titles.items() if key in found]
        return ReportTable(["metric", "value (95 % interval)"], rows)

    def _build_family_table(self) -> ReportTable:
        rows = []
        for family in self.families:
            chosen = [number for number, partner in enumerate(self.partners) if partner.family == family]
            names = [family] * len(chosen)
            cells = [
                format_estimate(estimate_rate(compute_mean, self.successes[:, chosen], names)),
                format_estimate(estimate_rate(compute_mean, self.contacts[:, chosen], names)),
                format_estimate(estimate(compute_mean, self.scores[:, chosen], names)),
            ]
            rows.append([family, *cells, self.scores[:, chosen].size])
        return ReportTable(["family", "success %", "contact %", "AS %", N_EPISODES.title], rows)

    def _build_partner_table(self) -> ReportTable:
        rows = []
        for number, partner in enumerate(self.partners):
            episodes, means = self.collect_episodes(partner), estimate_fluency(self.collect_episodes(partner))
            n = len(episodes)
            counts = [int(flags[:, number].sum()) for flags in (self.successes, self.contacts)]
            cells = [
                *(format_percent_rate(count, n) for count in counts),
                format_percent_mean([each.speed_score for each in episodes]),
            ]
            if self.references is not None:
                best = np.array([self.references[number].mean])
                cells.append(f"{100 * compute_proximity(self.scores[:, [number]].mean(axis=-1), best):.0f}")
            forces = [
                NO_VALUE if column.key not in means or (mean := means[column.key].mean) is None
                else f"{column.scale * mean:.3g}"
                for column in _METRIC_COLUMNS
            ]  # fmt: skip
            rows.append([partner.name, partner.family, *cells, *forces, n])
        titles = [column.title for column in _METRIC_COLUMNS]
        header = ["partner", "family", "success %", "contact %", "AS %"]
        header += [] if self.references is None else ["BR-Prox %"]
        return ReportTable([*header, *titles, N_EPISODES.title], rows, n_keys=2)


def format_estimate(found: Estimate, spec: str = ".1f") -> str:
    """Format an estimate of a share with its interval in percent."""
    return append_interval(f"{100.0 * found.value:{spec}}", found.interval_95, spec)
