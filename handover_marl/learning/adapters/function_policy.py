"""Policies that run a function, a PyTorch module or a file of another library."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.observations import Observation, giver_observation_space, receiver_observation_space
from handover_marl.episode.spaces import STATE, check_vector
from handover_marl.errors import ActionError, HandoverError, OptionError
from handover_marl.execution.files import shorten_text
from handover_marl.learning.adapters.models import Model, ModelFunction, reset_function
from handover_marl.learning.adapters.network_policy import NetworkPolicy
from handover_marl.learning.encodings.custom_features import AgentFeatures, FeaturesLike
from handover_marl.learning.encodings.custom_schemes import SchemeLike
from handover_marl.learning.features import make_features
from handover_marl.learning.schemes import make_scheme
from handover_marl.policies.policy import PolicyContext

#: Choice of features for functions that take observations as they are.
OBSERVATION = "observation"


@dataclass(frozen=True, eq=False)
class Encoding:
    """Encoding of the inputs and outputs of an adapted policy.

    Attributes:
        features: Features, see `handover_marl.encode`, or `OBSERVATION`.
        action_scheme: Action scheme, see `handover_marl.encode`.
        control_period: Time between two decisions (s).
        obs_mode: Observation mode of a receiver.
    """

    features: FeaturesLike
    action_scheme: SchemeLike
    control_period: float = 0.1
    obs_mode: str = STATE


class FunctionPolicy(NetworkPolicy):
    """Policy that runs a model; made by `handover_marl.as_receiver` and `handover_marl.as_giver`.

    Args:
        agent: Agent that the policy controls, "giver" or "receiver".
        context: Robot, task and known grasps of the objects.
        model: Function, PyTorch module, network of a policy file, or content of a TorchScript or ONNX file.
        encoding: Encoding of inputs and outputs.
        name: Name of the policy.
        label: Unique label of the policy in result files.
        digest: Hash of model and encoding.
        wait: Time for which the robot stays at its waiting pose at the start of an episode (s);
            default: that of the action scheme. Only action schemes that wait have this option.

    Raises:
        OptionError: The model does not fit features or action scheme, or a package is missing.
        DataFormatError: A file does not fit features or action scheme.
    """

    def __init__(
        self,
        agent: str,
        context: PolicyContext,
        model: Model,
        encoding: Encoding,
        name: str = "function",
        label: str = "function",
        digest: str = "",
        wait: float | None = None,
    ) -> None:
        self.name = name  # type: ignore[misc]
        self.obs_mode = encoding.obs_mode
        self._agent, self._label, self._digest, self._features = agent, label, digest, encoding.features
        scheme = make_scheme(agent, encoding.action_scheme, context)
        features = None
        if not _is_observation(encoding.features):
            features = make_features(agent, encoding.features, context)
        super().__init__(
            _return_observation if features is None else features, scheme, encoding.control_period, wait, name
        )
        self._n_outputs = scheme.size
        sizes = None if features is None else (features.size, scheme.size)
        self._check_declared_sizes(model, sizes)
        self._function = model.load(agent, sizes)
        if model.is_network:
            self._try_zeros(features, context)

    @property
    def features(self) -> FeaturesLike:
        """Features that the function receives, or `OBSERVATION` if it receives whole observations."""
        return self._features

    @property
    def function(self) -> ModelFunction:
        """Function from inputs to outputs."""
        return self._function

    @property
    def label(self) -> str:
        """Unique label of the policy in result files: its name, and a hash unless a name was given."""
        return self._label

    @property
    def weights_hash(self) -> str:
        """Hash of the function's code and values, of weights, and of the encoding."""
        return self._digest

    def reset(self, seed: int | None = None) -> None:
        """Clear the state of the previous episode; a function with a method `reset(seed)` is reset too."""
        super().reset(seed)
        reset_function(self._function, seed)

    def evaluate(self, inputs: Any) -> npt.NDArray[np.float32]:
        """Return the outputs (n_outputs,) of the function for encoded inputs.

        Raises:
            ActionError: The outputs are not `n_outputs` finite real numbers.
        """
        outputs = self._function(inputs)
        if isinstance(outputs, np.ndarray) and outputs.dtype.kind not in "biuf":
            raise ActionError(
                f"outputs of the {self._agent} {self.name!r} must be real numbers, got an array of {outputs.dtype}"
            )
        if outputs is None:
            raise ActionError(f"outputs of the {self._agent} {self.name!r} must be numbers, got None; return them")
        return check_vector(
            f"outputs of the {self._agent} {self.name!r}", outputs, self._n_outputs, "as its action scheme decodes"
        )

    def _check_declared_sizes(self, model: Model, sizes: tuple[int, int] | None) -> None:
        function = getattr(model, "function", None)
        declared = getattr(function, "n_inputs", None), getattr(function, "n_outputs", None)
        if model.is_network and function is not None and sizes is not None and declared != sizes:
            raise OptionError(
                f"{self.name!r} must have {sizes[0]} inputs, the features, and {sizes[1]} outputs, which the action "
                f"scheme decodes, got {declared[0]} and {declared[1]}; pass features and action_scheme of its training"
            )

    def _try_zeros(self, features: AgentFeatures | None, context: PolicyContext) -> None:
        """Check the sizes of a network by its outputs for zeros, which need not be finite."""
        space: spaces.Space[Any] = self._make_observation_space(context) if features is None else features.space
        wanted = "the observation" if features is None else f"features of shape (1, {features.size})"
        try:
            with np.errstate(all="ignore"):
                outputs = self._function(_make_zeros(space))
        except HandoverError:
            raise
        except Exception as error:  # code of the user
            raise OptionError(
                f"{self.name!r} must accept {wanted}, got {type(error).__name__}: {shorten_text(error)}; pass the "
                "features of its training"
            ) from error
        if not isinstance(outputs, np.ndarray) or outputs.shape != (self._n_outputs,):
            got = f"shape {outputs.shape}" if isinstance(outputs, np.ndarray) else type(outputs).__name__
            raise OptionError(
                f"{self.name!r} must return outputs of shape (1, {self._n_outputs}) for action scheme "
                f"{self._scheme.name!r}, got {got}; pass the action scheme of its training"
            )

    def _make_observation_space(self, context: PolicyContext) -> spaces.Dict:
        if self._agent == "giver":
            return giver_observation_space(context.config.giver)
        return receiver_observation_space(self.obs_mode)


def _is_observation(features: object) -> bool:
    return isinstance(features, str) and features == OBSERVATION


def _return_observation(observation: Observation) -> Observation:
    return observation


def _make_zeros(space: Any) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _make_zeros(part) for key, part in space.spaces.items()}
    return np.zeros(space.shape, dtype=space.dtype)
