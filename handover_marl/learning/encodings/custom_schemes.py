"""User-defined action schemes: use of functions as schemes, and checks of the returned actions."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from handover_marl.config import PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, to_numpy
from handover_marl.learning.action_scheme import Action, ActionScheme, Outputs
from handover_marl.learning.array_schemes import ArrayScheme
from handover_marl.learning.encodings.choices import (
    check_agent,
    check_returned_vector,
    check_size,
    construct_encoding,
    get_choice_name,
    run_custom_code,
    split_episodes,
)
from handover_marl.policies.policy import PolicyContext

KIND = "action scheme"
_ACTION_SIZES = {"giver": GIVER_ACTION_SIZE, "receiver": PANDA_DOF}

#: Function from outputs (size,) in [-1, 1] and an observation to an action.
SchemeFunction: TypeAlias = Callable[[Outputs, Observation], Action]
#: Name of a built-in scheme, `module:name`, a class, or a function with a declared size.
SchemeLike: TypeAlias = str | type[ActionScheme] | SchemeFunction


class CustomScheme(ArrayScheme):
    """User-defined action schemes, one for each episode; called one after another, and their actions are checked.

    Args:
        agent: "giver" or "receiver".
        name: Name of the scheme.
        size: Number of outputs that the scheme decodes.
        schemes: Scheme of each episode, or function from outputs and observation to an action.
        arrays: Creator of the actions.
    """

    def __init__(
        self, agent: str, name: str, size: int, schemes: Sequence[ActionScheme | SchemeFunction], arrays: ArrayFactory
    ) -> None:
        self.agent, self.name, self.size = agent, name, size  # type: ignore[misc]
        self._schemes, self._arrays = schemes, arrays
        # Those of functions; schemes store their own.
        self._outputs = arrays.zeros((len(schemes), size))
        if isinstance(schemes[0], ActionScheme):
            self.wait = schemes[0].wait

    def reset(self, row: int) -> None:
        """Clear the state of the previous episode."""
        super().reset(row)
        scheme = self._schemes[row]
        if isinstance(scheme, ActionScheme):
            self._run(scheme.reset)

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the network must be evaluated now, in each of r episodes."""
        needs = [
            not isinstance(scheme := self._schemes[row], ActionScheme) or bool(self._run(scheme.needs_outputs, one))
            for row, one in split_episodes(rows, observation)
        ]
        return self._arrays.asarray(needs, "bool")

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store new network outputs (r, size), clipped to [-1, 1] unless a user-defined class does otherwise."""
        super().set_outputs(rows, outputs)
        for row, own in zip(rows.tolist(), to_numpy(outputs), strict=True):
            scheme = self._schemes[row]
            if isinstance(scheme, ActionScheme):
                self._run(scheme.set_outputs, own)

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the agent's actions (r, ...) for the current outputs.

        Raises:
            EncodingError: A scheme fails, or returns anything but a finite float32 action.
        """
        own = split_episodes(rows, observation)
        return self._arrays.asarray(np.stack([self._compute_action(row, one) for row, one in own]))

    def _compute_action(self, row: int, observation: Observation) -> Action:
        scheme = self._schemes[row]
        if isinstance(scheme, ActionScheme):
            action = self._run(scheme.compute_action, observation)
        else:
            action = self._run(scheme, to_numpy(self._outputs[row]), observation)
        advice = "convert with numpy.asarray(action, dtype=numpy.float32)"
        return check_returned_vector(f"action of {KIND} {self.name!r}", action, (_ACTION_SIZES[self.agent],), advice)

    def _run(self, method: Callable[..., Any], *arguments: Any) -> Any:
        return run_custom_code(f"{KIND} {self.name!r}", method, *arguments)


def make_custom_scheme(
    agent: str, choice: Any, context: PolicyContext, count: int, arrays: ArrayFactory, name: str = ""
) -> CustomScheme:
    """Make the action scheme of n episodes from a subclass of `ActionScheme` or a function with a declared size.

    Args:
        agent: "giver" or "receiver".
        choice: Subclass of `ActionScheme`, or function from outputs and observation to an action.
        context: Robot, task and known grasps of the objects.
        count: Number n of episodes.
        arrays: Creator of the actions.
        name: Name of the scheme; default: the name of the class or function.

    Raises:
        OptionError: The size is missing or malformed, the scheme is for the other agent, or the class
            is no `ActionScheme`.
        EncodingError: The constructor of the class fails.
    """
    name = name or get_choice_name(choice)
    if not callable(choice) or (isinstance(choice, type) and not issubclass(choice, ActionScheme)):
        raise OptionError(
            f"{KIND} must be a name, a subclass of handover_marl.learning.action_scheme.ActionScheme or a function, "
            f"got {choice!r}"
        )
    check_agent(KIND, choice, agent)
    size = getattr(choice, "size", None)
    if size is None:
        raise OptionError(
            f"{KIND} {name!r} must declare the number of outputs; add the class attribute size, or @declare_size(n) "
            "above a function"
        )
    check_size(f"size of {KIND} {name!r}", size)
    is_class = isinstance(choice, type)
    schemes = [construct_encoding(KIND, choice, context) if is_class else choice for _ in range(count)]
    return CustomScheme(agent, name, size, schemes, arrays)
