"""Random numbers that do not depend on the machine or on the version of NumPy, and the statistics of DexYCB.

NumPy guarantees the raw output of its bit generators, but not the numbers that `Generator` makes of
it, so all numbers are derived from raw 64-bit words. `dexycb_statistics.json` has the source, the units and a
description of every table. The tables of hand directions and of `entry_x` describe right hands: recorded left hands
were mirrored (positions x -> 2 * MIRROR_X - x, directions x -> -x). Positions of objects were not mirrored.
"""

import json
import math
from collections.abc import Sequence
from importlib.resources import files
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

_STATISTICS = json.loads((files(__package__) / "dexycb_statistics.json").read_text())

# Levels of the quantile tables, and the tables by name.
_LEVELS = np.array(_STATISTICS["levels"])
_QUANTILES = {name: np.array(table["values"]) for name, table in _STATISTICS["quantiles"].items()}

#: Rank correlations between two quantities of the tables, for `draw_correlated_quantiles`.
START_HANDOVER_X, START_HANDOVER_Y, ELEVATION_ROLL = (
    float(_STATISTICS["rank_correlations"][name]) for name in ("start_handover_x", "start_handover_y", "elevation_roll")
)

#: Number of recordings by their length in frames of 40 ms.
FRAME_COUNTS: MappingProxyType[int, int] = MappingProxyType(
    {int(length): count for length, count in _STATISTICS["recordings_by_length"].items()}
)

#: Number of recordings by YCB class and by the object axis that points up on the table: +x, -x, +y, -y, +z, -z.
UP_AXES: MappingProxyType[int, tuple[int, ...]] = MappingProxyType(
    {int(number): tuple(counts) for number, counts in _STATISTICS["recordings_by_class_and_up_axis"].items()}
)

#: Position x (m) of the plane at which the entry of left hands is mirrored to that of right hands.
MIRROR_X: float = _STATISTICS["mirror_x"]

#: Integers of at least 0 that identify a scene, an object or a person.
Seed = tuple[int, ...]
#: Version of the scene generator, part of every seed. It changes whenever the scenes do.
VERSION = 1

#: Purposes of random numbers. A purpose's index is part of the seed, so new purposes are added at the end.
PURPOSES: Final = (
    *("side", "placement", "timing", "motion", "clutter"),
    *("person", "object", "human grasps", "robot grasps", "post-arrival motion"),
)


class RandomStream:
    """Stream of random numbers that are the same on every machine.

    Args:
        seed: Integers of at least 0 that identify the stream; streams with different seeds are independent.
    """

    def __init__(self, *seed: int) -> None:
        self._bits = np.random.PCG64(np.random.SeedSequence(seed))

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Draw a number from the open interval (low, high)."""
        fraction = ((int(self._bits.random_raw()) >> 11) + 0.5) * 2.0**-53
        return low + (high - low) * fraction

    def uniforms(self, *shape: int) -> npt.NDArray[np.float64]:
        """Draw an array of the given shape; its entries, in C order, are those of repeated calls of `uniform()`."""
        words = self._bits.random_raw(math.prod(shape))
        return np.asarray(((words >> np.uint64(11)) + 0.5) * 2.0**-53).reshape(shape)

    def normal(self) -> float:
        """Draw a standard normal number."""
        return float(ndtri(self.uniform()))

    def normals(self, *shape: int) -> npt.NDArray[np.float64]:
        """Draw standard normal numbers as an array of the given shape."""
        return np.asarray(ndtri(self.uniforms(*shape)))

    def integer(self, n: int) -> int:
        """Draw an integer from 0 to n - 1."""
        return min(int(self.uniform() * n), n - 1)

    def weighted_index(self, weights: Sequence[float]) -> int:
        """Draw an index into `weights`, with probabilities proportional to the weights."""
        total, threshold = 0.0, self.uniform(0.0, float(sum(weights)))
        for index, weight in enumerate(weights):
            total += weight
            if threshold < total:
                return index
        return len(weights) - 1

    def weighted_order(self, weights: Sequence[float]) -> list[int]:
        """Draw the indices of all positive weights in random order, without replacement.

        Each next index is drawn from the remaining ones with probability proportional to its weight.
        """
        remaining = {index: weight for index, weight in enumerate(weights) if weight > 0.0}
        order = []
        while remaining:
            order.append(list(remaining)[self.weighted_index(list(remaining.values()))])
            del remaining[order[-1]]
        return order

    def draw_quantile(self, name: str) -> float:
        """Draw a number from DexYCB's distribution of a quantity, given by its quantile table `name`."""
        return float(np.interp(self.uniform(), _LEVELS, _QUANTILES[name]))

    def draw_correlated_quantiles(self, first: str, second: str, correlation: float) -> list[float]:
        """Draw one number from each of two quantile tables, with a `correlation` (-1 to 1) by a Gaussian copula."""
        one, other = self.normal(), self.normal()
        correlated = correlation * one + np.sqrt(1.0 - correlation**2) * other
        levels = zip((first, second), (float(ndtr(one)), float(ndtr(correlated))), strict=True)
        return [float(np.interp(level, _LEVELS, _QUANTILES[name])) for name, level in levels]


def open_stream(seed: Seed, purpose: str) -> RandomStream:
    """Return the random stream for one of `PURPOSES` and the scene, object or person that `seed` identifies."""
    return RandomStream(*seed, PURPOSES.index(purpose))
