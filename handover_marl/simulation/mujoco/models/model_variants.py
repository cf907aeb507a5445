"""Collision groups of bodies, and variants of a scene's model without some collisions."""

import copy
from collections.abc import Sequence
from enum import IntFlag
from weakref import WeakValueDictionary

import mujoco
import numpy as np

from handover_marl.config import OBJECT_DOF


class CollisionGroup(IntFlag):
    """Collision groups: bits of MuJoCo's contype and conaffinity. The Panda collides with all."""

    ROBOT = 1
    OBJECT = 2
    SUPPORT = 4
    HAND = 8
    GROUND = 16


#: Groups that a released object collides with, apart from the robot.
RELEASED_COLLISIONS = CollisionGroup.OBJECT | CollisionGroup.SUPPORT | CollisionGroup.GROUND


class ModelVariants:
    """Variants of a scene's model with a released target object or a hand without collisions.

    Copying a model takes 1 ms; a variant is shared for as long as it is referenced.

    Args:
        model: Model of the scene, in which actuators hold the target object.
        target: Body number of the target object.
        actuators: Number of the first of the object's six actuators.
        hand: Body numbers of the hand.
    """

    def __init__(self, model: "mujoco.MjModel", target: int, actuators: int, hand: Sequence[int]) -> None:
        self._model = model
        self._target, self._actuators, self._hand = target, actuators, list(hand)
        self._variants: WeakValueDictionary[tuple[bool, bool], mujoco.MjModel] = WeakValueDictionary()

    def select(self, released: bool, hand_collides: bool) -> "mujoco.MjModel":
        """Return a variant of the scene's MuJoCo model.

        Args:
            released: Whether the target object is free: its actuators are off and it collides with
                supports.
            hand_collides: Whether the hand collides. Otherwise steps take a tenth less time.
        """
        if hand_collides and not released:
            return self._model
        variant = self._variants.get((released, hand_collides))
        if variant is None:
            # Threads may copy the same variant twice; the later copy is shared.
            variant = self._variants[released, hand_collides] = self._copy(released, hand_collides)
        return variant

    def _copy(self, released: bool, hand_collides: bool) -> "mujoco.MjModel":
        model = copy.copy(self._model)
        if released:
            first = model.body_geomadr[self._target]
            geoms = slice(first, first + model.body_geomnum[self._target])
            model.geom_conaffinity[geoms] = model.body_conaffinity[self._target] = int(RELEASED_COLLISIONS)
            model.actuator_forcerange[self._actuators : self._actuators + OBJECT_DOF] = 0.0
        if not hand_collides:
            model.body_contype[self._hand] = 0
            model.geom_contype[np.isin(model.geom_bodyid, self._hand)] = 0
        return model
