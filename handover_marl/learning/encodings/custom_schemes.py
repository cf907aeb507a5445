"""User-defined action schemes: use of functions as schemes, and checks of the returned actions."""

from collections.abc import Callable
from typing import Any, TypeAlias

from handover_marl.config import PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.errors import EncodingError, HandoverError, OptionError
from handover_marl.learning.action_scheme import Action, ActionScheme, Outputs
from handover_marl.learning.encodings.choices import (
    check_agent,
    check_returned_vector,
    check_size,
    construct_encoding,
    get_choice_name,
)
from handover_marl.policies.policy import PolicyContext

KIND = "action scheme"
_ACTION_SIZES = {"giver": GIVER_ACTION_SIZE, "receiver": PANDA_DOF}

#: Function from outputs (size,) in [-1, 1] and an observation to an action.
SchemeFunction: TypeAlias = Callable[[Outputs, Observation], Action]
#: Name of a built-in scheme, `module:name`, a class, or a function with a declared size.
SchemeLike: TypeAlias = str | type[ActionScheme] | SchemeFunction


class CheckedScheme(ActionScheme):
    """User-defined action scheme whose actions are checked; made by `schemes.make_scheme`.

    Args:
        agent: "giver" or "receiver".
        name: Name of the scheme.
        size: Number of outputs that the scheme decodes.
        scheme: User-defined scheme, or function from outputs and observation to an action.
        context: Robot, task and known grasps of the objects.
    """

    def __init__(
        self, agent: str, name: str, size: int, scheme: ActionScheme | SchemeFunction, context: PolicyContext
    ) -> None:
        self.agent, self.name, self.size = agent, name, size  # type: ignore[misc]
        self.scheme = scheme
        super().__init__(context)
        if isinstance(scheme, ActionScheme):
            self.wait = scheme.wait

    def reset(self) -> None:
        """Clear the state of the previous episode."""
        super().reset()
        if isinstance(self.scheme, ActionScheme):
            self._run(self.scheme.reset)

    def needs_outputs(self, observation: Observation) -> bool:
        """Return whether the network must be evaluated now."""
        return not isinstance(self.scheme, ActionScheme) or bool(self._run(self.scheme.needs_outputs, observation))

    def set_outputs(self, outputs: Outputs) -> None:
        """Store new network outputs (size,), clipped to [-1, 1] unless a user-defined class does otherwise."""
        if isinstance(self.scheme, ActionScheme):
            self._run(self.scheme.set_outputs, outputs)
        else:
            super().set_outputs(outputs)

    def compute_action(self, observation: Observation) -> Action:
        """Return the agent's action for the current outputs.

        Raises:
            EncodingError: The scheme fails, or returns anything but a finite float32 action.
        """
        if isinstance(self.scheme, ActionScheme):
            action = self._run(self.scheme.compute_action, observation)
        else:
            action = self._run(self.scheme, self.outputs, observation)
        advice = "convert with numpy.asarray(action, dtype=numpy.float32)"
        return check_returned_vector(f"action of {KIND} {self.name!r}", action, (_ACTION_SIZES[self.agent],), advice)

    def _run(self, method: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except HandoverError:
            raise
        except Exception as error:  # code of the user
            raise EncodingError(f"{KIND} {self.name!r} failed ({type(error).__name__}: {error})") from error


def make_custom_scheme(agent: str, choice: Any, context: PolicyContext, name: str = "") -> CheckedScheme:
    """Make a checked action scheme from a subclass of `ActionScheme` or a function with a declared size.

    Args:
        agent: "giver" or "receiver".
        choice: Subclass of `ActionScheme`, or function from outputs and observation to an action.
        context: Robot, task and known grasps of the objects.
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
    scheme = construct_encoding(KIND, choice, context) if isinstance(choice, type) else choice
    return CheckedScheme(agent, name, size, scheme, context)
