"""A small multilayer perceptron in NumPy: what a shipped policy needs to run, without PyTorch."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError

Array = npt.NDArray[np.float32]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": lambda values: np.tanh(values),
    "relu": lambda values: np.maximum(values, np.float32(0.0)),
    "identity": lambda values: values,
}


@dataclass(frozen=True, eq=False)
class Network:
    """Dense layers with one activation between them.

    Attributes:
        weights: (m, n) matrices, each as wide as the one before is high.
        biases: (m,) vectors.
        activation: Between layers: "tanh", "relu" or "identity".
        output: After the last layer, likewise.

    Raises:
        DataFormatError: Shapes do not fit together, a number is not finite, or there is no such activation.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str = "tanh"
    output: str = "identity"

    def __post_init__(self) -> None:
        if not self.weights or len(self.weights) != len(self.biases):
            raise DataFormatError(f"{len(self.weights)} weight matrices and {len(self.biases)} biases make no network")
        width = None
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            fits = weight.ndim == 2 and bias.shape == weight.shape[:1] and width in (None, weight.shape[1])
            if not fits:
                raise DataFormatError(f"layer {number} with shapes {weight.shape} and {bias.shape} does not fit")
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise DataFormatError(f"layer {number} has numbers that are not finite")
            width = weight.shape[0]
        for name in (self.activation, self.output):
            if name not in ACTIVATIONS:
                raise DataFormatError(f"unknown activation {name!r}; valid: {', '.join(ACTIVATIONS)}")

    @property
    def n_inputs(self) -> int:
        """Numbers that go in."""
        return int(self.weights[0].shape[1])

    @property
    def n_outputs(self) -> int:
        """Numbers that come out."""
        return int(self.weights[-1].shape[0])

    def __call__(self, inputs: Array) -> Array:
        """(n_outputs,) for (n_inputs,)."""
        values, between = inputs.astype(np.float32), ACTIVATIONS[self.activation]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            values = between(weight @ values + bias)
        return ACTIVATIONS[self.output](self.weights[-1] @ values + self.biases[-1])
