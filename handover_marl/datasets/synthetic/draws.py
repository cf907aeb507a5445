"""Random numbers that are the same everywhere.

NumPy keeps the raw output of its bit generators for ever but may change what `Generator` makes of it, so that
everything here is derived from raw 64-bit words.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from handover_marl.datasets.synthetic.calibration import LEVELS

#: Version of the generator; part of every seed. Scenes change with it and with nothing else.
VERSION = 1

_PURPOSES = ("side", "stage", "timing", "motion", "clutter")


class Draws:
    """A stream of random numbers for one scene and purpose.

    Args:
        scene_id: The scene.
        purpose: One of a few names; purposes do not disturb each other.
    """

    def __init__(self, scene_id: int, purpose: str) -> None:
        seed = np.random.SeedSequence([VERSION, scene_id, _PURPOSES.index(purpose)])
        self._bits = np.random.PCG64(seed)

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """A number in the open interval."""
        share = ((int(self._bits.random_raw()) >> 11) + 0.5) * 2.0**-53
        return low + (high - low) * share

    def normal(self) -> float:
        """A standard normal number."""
        return float(ndtri(self.uniform()))

    def integer(self, n: int) -> int:
        """One of 0 .. n-1."""
        return min(int(self.uniform() * n), n - 1)

    def weighted(self, weights: Sequence[float]) -> int:
        """An index, drawn in proportion to its weight."""
        total, aim = 0.0, self.uniform(0.0, float(sum(weights)))
        for index, weight in enumerate(weights):
            total += weight
            if aim < total:
                return index
        return len(weights) - 1

    def order(self, weights: Sequence[float]) -> list[int]:
        """All indices with a positive weight, drawn one after another without replacement."""
        left = {index: weight for index, weight in enumerate(weights) if weight > 0.0}
        drawn = []
        while left:
            names = list(left)
            drawn.append(names[self.weighted([left[name] for name in names])])
            del left[drawn[-1]]
        return drawn

    def quantile(self, table: npt.ArrayLike) -> float:
        """A number from a distribution given by its quantiles at `LEVELS`."""
        return at_level(table, self.uniform())

    def correlated_quantiles(self, first: npt.ArrayLike, second: npt.ArrayLike, correlation: float) -> list[float]:
        """Two numbers from two distributions, joined by a Gaussian copula."""
        one, other = self.normal(), self.normal()
        joined = correlation * one + np.sqrt(1.0 - correlation**2) * other
        return [at_level(first, float(ndtr(one))), at_level(second, float(ndtr(joined)))]


def at_level(table: npt.ArrayLike, level: float) -> float:
    """The value of a quantile table at a level (0..1), interpolated."""
    return float(np.interp(level, LEVELS, np.asarray(table, dtype=np.float64)))
