"""Select the givers of a population from candidates by the diversity of what happens with a receiver.

    handover-marl crossplay --givers GIVERS --receivers reactive --split train --physics fast --out results/candidates
    python experiments/strangers/select_population.py --results results/candidates --out strangers-v1.json

Features of a candidate are the mean events of its episodes with the receiver
(`count_events`). In every family, the candidates with the largest determinant are selected, as in ZSC-Eval (NeurIPS
2024). The script prints the table of features and writes the population and its policy files; the
receivers of the candidates' file are taken over.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl.datasets import open_dataset
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import CONFIG_FILE
from handover_marl.execution.files import write_atomically
from handover_marl.policies.populations import Partner, Population, format_population, load_population
from handover_marl.policies.reference import parse_policy

CANDIDATES = Path(__file__).with_name("candidates.json")
Array = npt.NDArray[np.float64]
_EPSILON = 1e-3
_MAX_SUBSETS = 200_000
#: Titles of the events that `count_events` returns.
EVENTS = (
    "success",
    "human contact",
    "object drop",
    "timeout",
    "release",
    "handover time s",
    "exchange time s",
    "gripper path m",
    "giver path m",
    "robot idle",
    "human idle",
    "robot-object impulse N s",
)


@dataclass(frozen=True)
class Args:
    """Options of the command line.

    Attributes:
        results: Folder with a result folder for each candidate, evaluated with the same receiver and scenes.
        out: Population file to write.
        candidates: File of the candidates, in the format of a population.
        per_family: Number of candidates to select in each family.
        min_success: Success rate with the receiver (0..1) below which a candidate is not selected: partners with whom
            nobody succeeds do not separate policies.
        name: Name of the population.
        version: Version of the population.
        description: Description of the population.
    """

    results: Path
    out: Path
    candidates: Path = CANDIDATES
    per_family: int = 3
    min_success: float = 0.25
    name: str = "strangers-v1"
    version: str = "1.1"
    description: str = "Givers whose behaviour differs from the recordings in ten families, and receivers."


def read_reports(population: Population, folder: Path) -> list[Report]:
    """Read the report of every giver of a population; the last scenes that all have in common are kept."""
    dataset = open_dataset("synthetic")
    reports = {report.metadata.giver: report for report in map(evaluate, find_folders(folder))}
    labels = [parse_policy("giver", population.get_policy(each)).resolve(dataset).label for each in population.givers]
    chosen = [reports[label] for label in labels]
    common = set.intersection(*({episode.index for episode in report.episodes} for report in chosen))
    return [
        replace(report, episodes=tuple(episode for episode in report.episodes if episode.index in common))
        for report in chosen
    ]


def find_folders(folder: Path) -> list[Path]:
    """Return the result folders below a folder."""
    return sorted(path.parent for path in folder.rglob(CONFIG_FILE))


def select_by_family(givers: Sequence[Partner], features: Array, per_family: int) -> tuple[Partner, ...]:
    """Select the most diverse givers of every family, given normalized features (n, e)."""
    chosen: list[Partner] = []
    for family in dict.fromkeys(giver.family for giver in givers):
        numbers = [number for number, giver in enumerate(givers) if giver.family == family]
        selected = select_diverse(features[numbers], min(per_family, len(numbers)))
        chosen += [givers[numbers[number]] for number in selected]
    return tuple(chosen)


def format_features(givers: Sequence[Partner], counts: Array, chosen: Sequence[Partner]) -> str:
    """Return the table of events (n, e) of all candidates."""
    rows = [
        [giver.name, giver.family, "yes" if giver in chosen else "", *(f"{value:.2f}" for value in row)]
        for giver, row in zip(givers, counts, strict=True)
    ]
    return format_table(["giver", "family", "selected", *EVENTS], rows, n_keys=3, max_width=1000)


def copy_policy_files(population: Population, chosen: Sequence[Partner], folder: Path) -> None:
    """Copy the policy files that chosen partners name with `{folder}` from a population's folder to another one."""
    for partner in chosen:
        _, marker, name = partner.policy.partition(":{folder}/")
        if marker:
            write_atomically(folder / name, (population.path.parent / name).read_bytes())


def count_events(episodes: Sequence[EpisodeResult]) -> Array:
    """Return the mean events (12,) of episodes of a giver with a receiver; `EVENTS` has their titles.

    Missing values, such as the handover time without a release, count as 0.

    Raises:
        ValueError: An episode has no fluency metrics.
    """
    means: Array = np.array([_count_events_of(episode) for episode in episodes]).mean(axis=0)
    return means


def normalize_features(counts: npt.ArrayLike) -> Array:
    """Divide event counts (n, e), at least 0, by their column's maximum plus 1e-3."""
    values = np.asarray(counts, dtype=np.float64)
    normalized: Array = values / (values.max(axis=0) + _EPSILON)
    return normalized


def compute_diversity(features: Array, chosen: Sequence[int]) -> float:
    """Compute the determinant of L = B B^T for the chosen rows B of the features (n, e)."""
    rows = features[list(chosen)]
    return float(np.linalg.det(rows @ rows.T))


def select_diverse(features: npt.ArrayLike, k: int) -> tuple[int, ...]:
    """Return the k rows of features (n, e) with the largest determinant of L = B B^T, in ascending order.

    All subsets are compared, so that the result is optimal; the first of equal ones is returned.

    Args:
        features: Normalized event counts.
        k: Number of rows; more than e rows have the determinant 0, so that k must be at most n and e.

    Raises:
        ValueError: k is out of range, or there are more than 200,000 subsets.
    """
    values = np.asarray(features, dtype=np.float64)
    if not 1 <= k <= min(values.shape):
        raise ValueError(f"k must be from 1 to {min(values.shape)} for features of shape {values.shape}, got {k}")
    if math.comb(len(values), k) > _MAX_SUBSETS:
        raise ValueError(f"subsets must be at most {_MAX_SUBSETS}, got {math.comb(len(values), k)}; choose by family")
    return max(itertools.combinations(range(len(values)), k), key=lambda chosen: compute_diversity(values, chosen))


def _count_events_of(episode: EpisodeResult) -> list[float]:
    fluency = episode.fluency
    if fluency is None:
        raise ValueError(f"episode {episode.index} must have fluency metrics, got none")
    statuses = (EpisodeStatus.SUCCESS, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)
    return [
        *(float(bool(episode.status & status)) for status in statuses),
        float(episode.release_step is not None),
        fluency.handover_time or 0.0,
        fluency.exchange_time or 0.0,
        fluency.gripper_path or 0.0,
        fluency.giver_path,
        fluency.robot_idle,
        fluency.human_idle,
        fluency.robot_object_impulse or 0.0,
    ]


def main(args: Args) -> None:
    """Select givers, write the population and print the features."""
    candidates = load_population(args.candidates)
    reports = read_reports(candidates, args.results)
    counts = np.array([count_events(report.episodes) for report in reports])
    possible = [number for number, report in enumerate(reports) if report.success_rate >= args.min_success]
    givers = [candidates.givers[number] for number in possible]
    chosen = select_by_family(givers, normalize_features(counts)[possible], args.per_family)
    copy_policy_files(candidates, (*chosen, *candidates.receivers), args.out.parent)
    write_atomically(
        args.out, format_population(args.name, args.version, args.description, chosen, candidates.receivers)
    )
    first = reports[0]
    print(format_features(candidates.givers, counts, chosen))
    print(f"\nReceiver {first.metadata.receiver}, {first.heading}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
