"""Copies of a scene's model for moments in which something does not count, all of one layout."""

import copy
from collections.abc import Sequence
from weakref import WeakValueDictionary

import mujoco
import numpy as np

from handover_marl.config import OBJECT_DOF
from handover_marl.sim.mujoco.scene_spec import RELEASED


class ModelVariants:
    """A model's variants, made when they are wanted (in a millisecond) and shared by all who hold one at the time.

    Args:
        model: All there is, the object led by its servos.
        target: Body number of the object that is handed over.
        servos: The first of its six servos.
        hand: Body numbers of the hand.
    """

    def __init__(self, model: "mujoco.MjModel", target: int, servos: int, hand: Sequence[int]) -> None:
        self._target, self._servos, self._hand = target, servos, list(hand)
        self._model = model
        self._made: WeakValueDictionary[tuple[bool, bool], mujoco.MjModel] = WeakValueDictionary()

    def of(self, released: bool, hand: bool) -> "mujoco.MjModel":
        """A variant.

        Args:
            released: Nobody holds the target object: nothing leads it, and it touches what it meets.
            hand: Whether the hand is felt. Who knows that it touches nothing saves a tenth of the engine's time.
        """
        if hand and not released:
            return self._model
        found = self._made.get((released, hand))
        if found is None:
            # Variants of one model are wanted by several threads; whose comes last is shared.
            found = self._made[released, hand] = self._make(released, hand)
        return found

    def _make(self, released: bool, hand: bool) -> "mujoco.MjModel":
        own = copy.copy(self._model)
        if released:
            own.geom_conaffinity[_geoms(own, self._target)] = own.body_conaffinity[self._target] = int(RELEASED)
            own.actuator_forcerange[self._servos : self._servos + OBJECT_DOF] = 0.0
        if not hand:
            own.body_contype[self._hand] = 0
            own.geom_contype[np.isin(own.geom_bodyid, self._hand)] = 0
        return own


def _geoms(model: "mujoco.MjModel", body: int) -> slice:
    first = int(model.body_geomadr[body])
    return slice(first, first + int(model.body_geomnum[body]))
