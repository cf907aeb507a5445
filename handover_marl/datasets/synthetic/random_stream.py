"""Random numbers that do not depend on the machine or on the version of NumPy.

NumPy guarantees the raw output of its bit generators, but not the numbers that `Generator` makes of
it, so all numbers are derived from raw 64-bit words.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from handover_marl.datasets.synthetic.calibration import LEVELS, QUANTILES

#: Version of the scene generator, part of every seed. It changes whenever the scenes do.
VERSION = 1

# The index is part of the seed.
_PURPOSES = ("side", "placement", "timing", "motion", "clutter")


class RandomStream:
    """Stream of random numbers for one scene and purpose; the streams are independent.

    Args:
        scene_id: Scene number.
        purpose: "side", "placement", "timing", "motion" or "clutter".
    """

    def __init__(self, scene_id: int, purpose: str) -> None:
        seed = np.random.SeedSequence([VERSION, scene_id, _PURPOSES.index(purpose)])
        self._bits = np.random.PCG64(seed)

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Draw a number from the open interval (low, high)."""
        fraction = ((int(self._bits.random_raw()) >> 11) + 0.5) * 2.0**-53
        return low + (high - low) * fraction

    def normal(self) -> float:
        """Draw a standard normal number."""
        return float(ndtri(self.uniform()))

    def integer(self, n: int) -> int:
        """Draw an integer from 0 to n - 1."""
        return min(int(self.uniform() * n), n - 1)

    def weighted_index(self, weights: Sequence[float]) -> int:
        """Draw an index with probability proportional to its weight."""
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
        """Draw a number from the distribution of a table in `calibration.QUANTILES`."""
        return _interpolate_quantile(name, self.uniform())

    def draw_correlated_quantiles(self, first: str, second: str, correlation: float) -> list[float]:
        """Draw two numbers from tables in `calibration.QUANTILES`, correlated by a Gaussian copula."""
        one, other = self.normal(), self.normal()
        correlated = correlation * one + np.sqrt(1.0 - correlation**2) * other
        return [_interpolate_quantile(first, float(ndtr(one))), _interpolate_quantile(second, float(ndtr(correlated)))]


def _interpolate_quantile(name: str, level: float) -> float:
    return float(np.interp(level, LEVELS, QUANTILES[name]))
