"""Features by name."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.datasets.ycb import CLASS_NAMES
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.learning import features
from handover_marl.learning.grasp_features import N_ADDED, GraspFeatures
from handover_marl.observations import Observation, giver_observation_space, observation_space
from handover_marl.receivers.base import ReceiverContext

Features = Callable[[Observation], npt.NDArray[np.float32]]

_N_CLASSES = max(CLASS_NAMES)
_N_RECEIVER = 35 + _N_CLASSES

# For each agent: name, function and how many numbers.
_FEATURES: dict[str, dict[str, tuple[Features, int]]] = {
    "giver": {
        "giver": (features.giver_features, 18 + _N_CLASSES),
        "flat_giver": (features.flat_giver_features, spaces.flatdim(giver_observation_space())),
    },
    "receiver": {
        "receiver": (features.receiver_features, _N_RECEIVER),
        "flat_receiver": (features.flat_receiver_features, spaces.flatdim(observation_space())),
    },
}
_WITH_CONTEXT: dict[str, tuple[Callable[[ReceiverContext], Features], int]] = {
    "grasp": (GraspFeatures, _N_RECEIVER + N_ADDED)
}


def available_features(agent: str) -> tuple[str, ...]:
    """Names of an agent's features.

    Raises:
        UnknownNameError: There is no such agent.
    """
    if agent not in _FEATURES:
        raise UnknownNameError("agent", agent, _FEATURES)
    return (*_FEATURES[agent], *(_WITH_CONTEXT if agent == "receiver" else ()))


def n_features(agent: str, name: str) -> int:
    """How many numbers an agent's features are.

    Raises:
        UnknownNameError: There is no such agent, or it has none of that name.
    """
    if name not in available_features(agent):
        raise UnknownNameError(f"features of the {agent}", name, available_features(agent))
    found: tuple[Any, int] = _WITH_CONTEXT[name] if name in _WITH_CONTEXT else _FEATURES[agent][name]
    return found[1]


def make_features(agent: str, name: str, context: ReceiverContext | None = None) -> Features:
    """An agent's features by name.

    Args:
        agent: "giver" or "receiver".
        name: Name of the features.
        context: The objects' grasps, which some features show.

    Raises:
        UnknownNameError: There is no such agent, or it has none of that name.
        OptionError: They need a context.
    """
    n_features(agent, name)
    if name not in _WITH_CONTEXT:
        return _FEATURES[agent][name][0]
    if context is None:
        raise OptionError(f"features {name!r} need the objects' grasps")
    return _WITH_CONTEXT[name][0](context)
