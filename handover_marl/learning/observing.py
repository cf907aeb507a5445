"""Features by name."""

import functools
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.config import ProtocolConfig
from handover_marl.episode.observations import Observation, giver_observation_space, observation_space
from handover_marl.errors import UnknownNameError
from handover_marl.learning import features
from handover_marl.learning.grasp_features import N_ADDED, N_CLOSE, CloseFeatures, GraspFeatures
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.policies.context import PolicyContext

Features = Callable[[Observation], npt.NDArray[np.float32]]

_N_CLASSES = max(CLASS_NAMES)
_N_RECEIVER = 35 + _N_CLASSES


class _Plain(Protocol):
    def __call__(self, observation: Observation, protocol: ProtocolConfig) -> npt.NDArray[np.float32]: ...


def _plain(function: _Plain) -> Callable[[PolicyContext], Features]:
    return lambda context: functools.partial(function, protocol=context.protocol)


# For each agent: name, what makes them, and how many numbers they are.
_FEATURES: dict[str, dict[str, tuple[Callable[[PolicyContext], Features], int]]] = {
    "giver": {
        "giver": (_plain(features.giver_features), 18 + _N_CLASSES),
        "flat_giver": (_plain(features.flat_giver_features), spaces.flatdim(giver_observation_space())),
    },
    "receiver": {
        "receiver": (_plain(features.receiver_features), _N_RECEIVER),
        "flat_receiver": (_plain(features.flat_receiver_features), spaces.flatdim(observation_space())),
        "grasp": (GraspFeatures, _N_RECEIVER + N_ADDED),
        "close": (CloseFeatures, N_CLOSE),
    },
}


def available_features(agent: str) -> tuple[str, ...]:
    """Names of an agent's features.

    Raises:
        UnknownNameError: There is no such agent.
    """
    if agent not in _FEATURES:
        raise UnknownNameError("agent", agent, _FEATURES)
    return tuple(_FEATURES[agent])


def n_features(agent: str, name: str) -> int:
    """How many numbers an agent's features are.

    Raises:
        UnknownNameError: There is no such agent, or it has none of that name.
    """
    if name not in available_features(agent):
        raise UnknownNameError(f"features of the {agent}", name, available_features(agent))
    return _FEATURES[agent][name][1]


def make_features(agent: str, name: str, context: PolicyContext) -> Features:
    """An agent's features by name.

    Args:
        agent: "giver" or "receiver".
        name: Name of the features.
        context: The task and the objects' grasps, which some features show.

    Raises:
        UnknownNameError: There is no such agent, or it has none of that name.
    """
    n_features(agent, name)
    return _FEATURES[agent][name][0](context)
