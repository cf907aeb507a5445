"""Base classes of action schemes, which convert network outputs in [-1, 1] to an agent's actions.

Networks learn best with few outputs of equal scale for which zero is a sensible action. Training environments and
learned policies decode outputs with the same schemes. Built-in schemes, subclasses of `ArrayScheme`, decode the outputs
of many episodes at once; actions do not depend on the other episodes. Users write subclasses of `ActionScheme`.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation, add_episode_axis
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ONLY_ROW, AnyArray, ArrayFactory
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.policies.policy import Action, PolicyContext

Outputs = npt.NDArray[np.floating]


class ActionScheme(ABC):
    """Base class of user-defined action schemes: decoder of network outputs into one agent's actions in one episode.

    Attributes:
        name: Name of the scheme in policy files.
        agent: Agent that acts, "giver" or "receiver".
        size: Number of network outputs that the scheme decodes.
        wait: Time at the start of an episode during which the agent does not act (s); may be changed
            only in schemes in which it is not zero by default.
        outputs: Current outputs (size,) of the network, float64; zeros at the start of an episode.

    Args:
        context: Robot, task and known grasps of the objects.
    """

    name: ClassVar[str]
    agent: ClassVar[str]
    size: ClassVar[int]
    wait: float = 0.0

    def __init__(self, context: PolicyContext) -> None:
        self.context = context
        self.reset()

    def reset(self) -> None:
        """Clear the state of the previous episode; the outputs become zero."""
        self.outputs: npt.NDArray[np.float64] = np.zeros(self.size)

    def needs_outputs(self, observation: Observation) -> bool:
        """Return whether the network must be evaluated now; else its previous outputs remain in use."""
        return True

    def set_outputs(self, outputs: Outputs) -> None:
        """Use network outputs (size,), clipped to [-1, 1], until the next call."""
        self.outputs = np.clip(np.asarray(outputs, dtype=np.float64), -1.0, 1.0)

    @abstractmethod
    def compute_action(self, observation: Observation) -> Action:
        """Decode the current outputs: return the action, float32, (8,) of a giver or (9,) of a receiver."""


class ArrayScheme(ABC):
    """Base class of built-in action schemes: decoder of network outputs into one agent's actions in n episodes.

    Methods act on r of the n episodes: `rows` are their indices, and all other arrays have one row for each of them.

    Args:
        context: Robot, task and known grasps of the objects.
        selector: Selector of the grasps that some schemes and features use.
        count: Number n of episodes.
        arrays: Factory of NumPy arrays, or of PyTorch tensors on a device.

    Attributes:
        name: Name of the scheme in policy files.
        agent: Agent that acts, "giver" or "receiver".
        size: Number of network outputs that the scheme decodes.
        wait: Time at the start of an episode during which the agent does not act (s); may be changed only in schemes
            in which it is not zero by default.
    """

    name: ClassVar[str]
    agent: ClassVar[str]
    size: int
    wait: float = 0.0

    def __init__(
        self, context: PolicyContext, selector: LowestCostGraspSelector, count: int, arrays: ArrayFactory = NUMPY_ARRAYS
    ) -> None:
        self._selector, self._arrays = selector, arrays
        self._outputs = arrays.zeros((count, self.size))
        self.allocate(context, count)

    def allocate(self, context: PolicyContext, count: int) -> None:  # noqa: B027
        """Create the subclass's constants and arrays (n, ...) for n = `count` episodes; called once."""

    def reset(self, row: int) -> None:
        """Clear the state of the finished episode with index `row`, so that the next one can use this row."""
        self._outputs[row] = 0.0

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the network must be evaluated now, (r,), in each of the r episodes with indices `rows`.

        The other episodes keep their previous outputs. `observation` has arrays (r, ...).
        """
        return self._arrays.full(len(rows), True, "bool")

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Use outputs (r, size), clipped to [-1, 1], in the episodes with indices `rows` until their next call."""
        xp = self._arrays.xp
        self._outputs[rows] = xp.astype(outputs, xp.float64).clip(-1.0, 1.0)

    @abstractmethod
    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Decode the current outputs of the r episodes with indices `rows`: return actions, float32.

        They are (r, 8) for givers, (r, 9) for receivers. `observation` has arrays (r, ...) of the agent's observations.
        """


class InvertibleScheme(ArrayScheme):
    """Base class of schemes that also convert actions to outputs, so that networks can imitate any policy."""

    @abstractmethod
    def outputs_from_actions(self, actions: AnyArray, observation: Observation) -> AnyArray:
        """Return outputs (r, size) in [-1, 1] whose decoded actions equal given actions (r, 8 or 9), approximately.

        Actions beyond the reach of the outputs are reduced. `observation` has arrays (r, ...) of the agent's
        observations.
        """


class RawScheme(ArrayScheme):
    """Base class of identity schemes: the outputs are the actions in physical units and are not clipped."""

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Use outputs (r, size), without clipping, in the episodes with indices `rows` until their next call."""
        xp = self._arrays.xp
        self._outputs[rows] = xp.astype(outputs, xp.float64)

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the current outputs (r, size) of the episodes with indices `rows` as their actions, float32."""
        xp = self._arrays.xp
        return xp.astype(self._outputs[rows], xp.float32)


class SingleEpisodeScheme:
    """Action scheme of a single episode, made by `make_action_scheme` from an `ArrayScheme` of n = 1 episode."""

    def __init__(self, scheme: ArrayScheme) -> None:
        self.scheme = scheme
        self.reset()

    @property
    def wait(self) -> float:
        """Time at the start of an episode during which the agent does not act (s)."""
        return self.scheme.wait

    def reset(self) -> None:
        """Clear the state of the previous episode; the outputs become zero."""
        self.scheme.reset(0)

    def needs_outputs(self, observation: Observation) -> bool:
        """Return whether the network must be evaluated now; else its previous outputs remain in use."""
        return bool(self.scheme.needs_outputs(ONLY_ROW, add_episode_axis(observation))[0])

    def set_outputs(self, outputs: Outputs) -> None:
        """Use network outputs (size,), clipped to [-1, 1] unless the scheme is raw, until the next call."""
        self.scheme.set_outputs(ONLY_ROW, np.asarray(outputs)[None])

    def compute_action(self, observation: Observation) -> Action:
        """Decode the current outputs: return the action, float32, (8,) of a giver or (9,) of a receiver."""
        action: Action = self.scheme.compute_actions(ONLY_ROW, add_episode_axis(observation))[0]
        return action
