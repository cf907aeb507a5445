"""Multilayer perceptron in NumPy, and the encoding of a policy network's inputs and outputs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError

Array = npt.NDArray[np.float32]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": lambda values: np.tanh(values),
    "relu": lambda values: np.maximum(values, np.float32(0.0)),
    "identity": lambda values: values,
}


class PolicyFunction(Protocol):
    """Callable from a feature vector to network outputs, such as a `DenseNetwork`."""

    @property
    def n_inputs(self) -> int:
        """Number of input features."""

    @property
    def n_outputs(self) -> int:
        """Number of network outputs."""

    def __call__(self, inputs: Array) -> Array:
        """Return the outputs (n_outputs,) for features (n_inputs,)."""


@dataclass(frozen=True, eq=False)
class DenseNetwork:
    """Multilayer perceptron that runs in NumPy, so that trained policies need no PyTorch.

    Attributes:
        weights: Weight matrices (n_outputs, n_inputs) of the layers.
        biases: Bias vectors (n_outputs,) of the layers.
        activation: Activation between layers: "tanh", "relu" or "identity".
        output: Activation after the last layer: "tanh", "relu" or "identity".

    Raises:
        DataFormatError: Shapes do not match, a number is not finite, or an activation is unknown.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str = "tanh"
    output: str = "identity"

    def __post_init__(self) -> None:
        if not self.weights or len(self.weights) != len(self.biases):
            raise DataFormatError(
                f"a network must have one bias vector per weight matrix, got {len(self.biases)} for {len(self.weights)}"
            )
        width = None
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if weight.ndim != 2 or bias.shape != weight.shape[:1] or width not in (None, weight.shape[1]):
                raise DataFormatError(f"layer {number} with shapes {weight.shape} and {bias.shape} does not fit")
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise DataFormatError(f"layer {number} has numbers that are not finite")
            width = weight.shape[0]
        for name in (self.activation, self.output):
            if name not in ACTIVATIONS:
                raise DataFormatError(f"unknown activation {name!r}; valid: {', '.join(ACTIVATIONS)}")

    @property
    def n_inputs(self) -> int:
        """Number of inputs of the first layer."""
        return int(self.weights[0].shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of outputs of the last layer."""
        return int(self.weights[-1].shape[0])

    def __call__(self, inputs: Array) -> Array:
        """Return the outputs (n_outputs,) for inputs (n_inputs,)."""
        values, activate = inputs.astype(np.float32), ACTIVATIONS[self.activation]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            values = activate(weight @ values + bias)
        return ACTIVATIONS[self.output](self.weights[-1] @ values + self.biases[-1])


@dataclass(frozen=True)
class PolicySpec:
    """Encoding of a network's inputs and outputs, stored with the network in a policy file.

    Attributes:
        agent: Agent that the policy controls, "giver" or "receiver".
        features: Name of the input features, see `handover_marl.learning.features`.
        actions: Name of the action scheme that decodes outputs, see `handover_marl.learning.schemes`.
        control_period: Time between two decisions (s).
        origin: Command, seed and budget of the training, for human readers.
    """

    agent: str
    features: str
    actions: str
    control_period: float = 0.1
    origin: str = ""
