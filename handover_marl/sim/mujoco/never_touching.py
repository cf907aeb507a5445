"""Which links of a robot can never touch, whatever its joints do: contacts need not be looked for between them."""

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Links stay this far apart (m) where joints go past their limits by so much (rad or m), as soft limits let them.
_APART, _PAST = 0.01, 0.05
# Of joints between two links and of poses that are looked at before two are taken to touch.
_JOINTS, _POSES = 2, 2000


def never_touching(model: "mujoco.MjModel") -> list[tuple[int, int]]:
    """Pairs of a robot's bodies that stay apart in every pose within the joints' limits.

    A proof, not a sample: where two are farther apart than their points can move while joints go from the middle of a
    box of angles to its corners, they touch nowhere in the box; else the box is halved.

    Args:
        model: The robot alone.
    """
    data = mujoco.MjData(model)
    solid = [body for body in range(1, model.nbody) if model.body_geomnum[body]]
    return [pair for pair in itertools.combinations(solid, 2) if _Pair(model, data, *pair).stays_apart()]


class _Pair:
    """Two bodies, and the joints that move one against the other."""

    def __init__(self, model: "mujoco.MjModel", data: "mujoco.MjData", first: int, second: int) -> None:
        self._model, self._data = model, data
        ways = [_up(model, body) for body in (first, second)]
        shared = set(ways[0]) & set(ways[1])
        levers: dict[int, float] = {}
        for way in ways:
            levers.update(_levers(model, [body for body in way if body not in shared]))
        self._joints, self._levers = list(levers), np.array(list(levers.values()))
        self._geoms = list(itertools.product(_geoms(model, first), _geoms(model, second)))

    def stays_apart(self) -> bool:
        model = self._model
        if not 0 < len(self._joints) <= _JOINTS or not model.jnt_limited[self._joints].all():
            return False
        low, high = model.jnt_range[self._joints].T
        boxes = [(low - _PAST, high + _PAST)]
        for _ in range(_POSES):
            if not boxes:
                return True
            low, high = boxes.pop()
            middle, reach = (low + high) / 2.0, (high - low) / 2.0 * self._levers
            gap = self._gap(middle) - _APART
            if gap <= 0.0:
                return False
            if gap <= reach.sum():
                axis = int(np.argmax(reach))
                cut = np.eye(len(middle), dtype=bool)[axis]
                boxes += [(low, np.where(cut, middle, high)), (np.where(cut, middle, low), high)]
        return False

    def _gap(self, angles: Array) -> float:
        """How far the two are apart (m)."""
        self._data.qpos[self._model.jnt_qposadr[self._joints]] = angles
        mujoco.mj_kinematics(self._model, self._data)
        return float(min(mujoco.mj_geomDistance(self._model, self._data, *pair, 1.0, None) for pair in self._geoms))


def _up(model: "mujoco.MjModel", body: int) -> list[int]:
    """A body and those that carry it, up to the world."""
    return [body] if body == 0 else [body, *_up(model, int(model.body_parentid[body]))]


def _levers(model: "mujoco.MjModel", way: Sequence[int]) -> dict[int, float]:
    """How far points of the first body of a way up may move, for each joint on it (m for each rad or m)."""
    found: dict[int, float] = {}
    farthest = max((_reach(model, geom) for geom in _geoms(model, way[0])), default=0.0) if way else 0.0
    for body in way:
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            found[int(joint)] = 1.0 if slides else farthest + float(np.linalg.norm(model.jnt_pos[joint]))
            # Joints further up turn it with this one as far out as it goes.
            farthest += float(np.abs(model.jnt_range[joint]).max()) + _PAST if slides else 0.0
        farthest += float(np.linalg.norm(model.body_pos[body]))
    return found


def _reach(model: "mujoco.MjModel", geom: int) -> float:
    """How far a geom reaches from its body's origin (m)."""
    return float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom])


def _geoms(model: "mujoco.MjModel", body: int) -> range:
    return range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
