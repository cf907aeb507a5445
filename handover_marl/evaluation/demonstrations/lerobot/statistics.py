"""Statistics of features in LeRobot's data sets, with which LeRobot's policies normalize inputs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

#: Statistics of one feature by name, as nested lists: "min", "max", "mean", "std", "count", "q01" to "q99".
FeatureStatistics = dict[str, list[Any]]

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_MAX_QUANTILE_ROWS = 100_000  # of images and clouds, evenly chosen


def compute_statistics(array: npt.NDArray[Any], is_image: bool = False) -> FeatureStatistics:
    """Return the statistics of a feature in one episode.

    Args:
        array: (T, ..., n) values of T frames; each of the n last components has its own statistics.
        is_image: Whether the values are colours (T, H, W, 3) of 0 to 255, which become (3, 1, 1) of 0 to 1.
    """
    rows = array.reshape(-1, array.shape[-1] if array.ndim > 1 else 1)
    rows = rows.astype(np.float64) if rows.dtype == np.bool_ else rows
    some = rows[:: -(-len(rows) // _MAX_QUANTILE_ROWS)]
    values = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0, dtype=np.float64),
        "std": rows.std(axis=0, dtype=np.float64),
        **dict(zip(_QUANTILES, np.quantile(some, list(_QUANTILES.values()), axis=0), strict=True)),
    }
    statistics = {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}
    if is_image:
        statistics = {name: (value / 255.0).reshape(-1, 1, 1) for name, value in statistics.items()}
    return {**{name: value.tolist() for name, value in statistics.items()}, "count": [len(array)]}


def merge_statistics(episodes: Sequence[FeatureStatistics]) -> FeatureStatistics:
    """Return the statistics of a feature in several episodes; quantiles are means weighted by frames.

    Args:
        episodes: Statistics in each episode, as `compute_statistics` returns them.
    """
    stacked = {name: np.array([episode[name] for episode in episodes]) for name in episodes[0]}
    counts = stacked.pop("count")[:, 0]

    def average(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(np.average(values, axis=0, weights=counts))

    mean = average(stacked["mean"])
    merged = {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(average(stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)),
        **{name: average(stacked[name]) for name in _QUANTILES},
    }
    return {**{name: value.tolist() for name, value in merged.items()}, "count": [int(counts.sum())]}
