"""Selection of a diverse population by the determinant of event counts, as in ZSC-Eval (NeurIPS 2024)."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.results.episode_result import EpisodeResult

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
