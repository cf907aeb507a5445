"""How the vision receiver follows an object from look to look: its middle, and what was seen of its surface."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]

# Clouds are matched with so many points about, to so many, so often, by this share of them; fewer tell nothing.
_MATCHED, _KEPT, _ROUNDS, _TRIMMED, _FEW = 200, 500, 4, 0.8, 20
# A surface at a point is that of so many points around it; ways in which it is less certain than this are none.
_AROUND, _DOUBT = 8, 0.01


@dataclass(frozen=True)
class Trust:
    """How far one look is trusted against those before.

    Attributes:
        follow: Share of what surprises in a place that is believed.
        change: Share of it that changes the velocity.
        renew: Share of what is told of the chosen grasp that becomes part of it.
    """

    follow: float
    change: float
    renew: float


class Track:
    """Follows a place with what it moves, by a g-h filter.

    Args:
        slowing: What is not seen loses this share of its velocity at each look.
    """

    def __init__(self, slowing: float) -> None:
        self._slowing = slowing
        self.place: Array | None = None
        self.velocity = np.zeros(3)
        self._time = 0.0

    def see(self, time: float, place: Array, trust: Trust) -> None:
        """Take note of a place (3,) at a time (s)."""
        if self.place is None:
            self.place = place.copy()
        elif time > self._time:
            step = time - self._time
            surprise = place - self.place - step * self.velocity
            self.place = self.place + step * self.velocity + trust.follow * surprise
            self.velocity = self.velocity + trust.change * surprise / step
        self._time = time

    def expected(self, time: float) -> Array:
        """(3,) where it should be at a time (s) from now on, once it was seen."""
        if self.place is None:
            raise ValueError("nothing was seen")
        return self.place + (time - self._time) * self.velocity

    def coast(self, time: float) -> None:
        """Go on without a sight; what is not seen is taken to stop soon."""
        if self.place is not None and time > self._time:
            self.velocity = (1.0 - self._slowing) * self.velocity
            self.place = self.place + (time - self._time) * self.velocity
            self._time = time


class SeenBody:
    """What was seen of a body that moves with the object, one point for each small cube; it is forgotten after a while.

    Args:
        cube: Side of the cubes (m).
        memory: For how long what is not seen any more is remembered (s).

    Attributes:
        points: (n, 3) relative to the object's middle (m).
    """

    def __init__(self, cube: float, memory: float) -> None:
        self._cube, self._memory = cube, memory
        self.points = np.zeros((0, 3))
        self._times = np.zeros(0)

    def see(self, time: float, points: Array, forget: bool) -> None:
        """Take note of points (k, 3) relative to the object's middle at a time (s).

        Args:
            time: Now.
            points: They.
            forget: Whether what was seen long ago is forgotten, if there is something new.
        """
        if forget and len(points):
            kept = self._times > time - self._memory
            self.points, self._times = self.points[kept], self._times[kept]
        both = np.concatenate([points, self.points])
        _, first = np.unique(np.floor(both / self._cube).astype(np.int64), axis=0, return_index=True)
        self.points, self._times = both[first], np.concatenate([np.full(len(points), time), self._times])[first]


class KeyView:
    """One look at an object, against which later ones are matched: errors of many looks would add up.

    Args:
        points: (k, 3) relative to the object's middle (m).
    """

    def __init__(self, points: Array) -> None:
        self._points = points[:: max(1, len(points) // _KEPT)]
        self._tree = cKDTree(self._points)
        _, around = self._tree.query(self._points, k=min(_AROUND, len(self._points)))
        apart = self._points[around] - self._points[around].mean(axis=1, keepdims=True)
        self._normals: Array = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]

    def beside(self, points: Array, reach: float) -> tuple[Array, float]:
        """How far points (k, 3) lie beside that look (3,) (m), and which share of them is part of it.

        Iterated closest points on planes (Chen and Medioni, 1992) without turns; what cannot be told, such as the way
        along a plane, is nothing.

        Args:
            points: They, relative to where the object's middle should be (m).
            reach: Farther away from what was seen than this they are something new (m).
        """
        moved, share = np.zeros(3), 0.0
        some = points[:: max(1, len(points) // _MATCHED)]
        for _ in range(_ROUNDS):
            away, nearest = self._tree.query(some - moved, distance_upper_bound=reach)
            known = np.isfinite(away)
            share = float(known.mean())
            if known.sum() < _FEW:
                return moved, 0.0
            used = away <= np.quantile(away[known], _TRIMMED)
            across = self._normals[nearest[used]]
            left = np.einsum("nk,nk->n", across, some[used] - moved - self._points[nearest[used]])
            stiff = across.T @ across + _DOUBT * len(across) * np.eye(3)
            moved = moved + np.linalg.solve(stiff, across.T @ left)
        return moved, share
