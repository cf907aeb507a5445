"""Multilayer perceptron in NumPy, with normalized inputs and bounded outputs, and its encoding."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import expit

from handover_marl.errors import DataFormatError

Array = npt.NDArray[np.float32]

#: Features and action scheme of policies from other libraries: flat observations, physical units.
RAW_ENCODINGS = {"giver": ("flat_giver", "giver"), "receiver": ("flat_receiver", "receiver")}
#: Activations by name; they return float32 arrays for float32 arrays.
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": lambda values: np.tanh(values),
    "relu": lambda values: np.maximum(values, np.float32(0.0)),
    "identity": lambda values: values,
    "elu": lambda values: np.where(values > 0.0, values, np.expm1(np.minimum(values, np.float32(0.0)))),
    "leaky_relu": lambda values: np.where(values > 0.0, values, np.float32(0.01) * values),
    "sigmoid": lambda values: np.asarray(expit(values)),
    "silu": lambda values: np.asarray(values * expit(values)),
}


@dataclass(frozen=True, eq=False)
class InputNormalization:
    """Normalization of a network's inputs: (inputs - mean) / scale, clipped to [-clip, clip].

    Attributes:
        mean: Means (n_inputs,) of the inputs.
        scale: Standard deviations (n_inputs,) of the inputs, greater than 0.
        clip: Largest absolute values (n_inputs,) of normalized inputs; infinite without a limit.

    Raises:
        DataFormatError: Shapes differ, or a number is out of range.
    """

    mean: npt.NDArray[np.float64]
    scale: npt.NDArray[np.float64]
    clip: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.mean.ndim != 1 or not self.mean.shape == self.scale.shape == self.clip.shape:
            shapes = f"{self.mean.shape}, {self.scale.shape} and {self.clip.shape}"
            raise DataFormatError(f"mean, scale and clip of the inputs must be vectors of one length, got {shapes}")
        if not (np.isfinite(self.mean).all() and np.isfinite(self.scale).all()):
            raise DataFormatError("mean and scale of the inputs must be finite numbers")
        if not ((self.scale > 0.0).all() and (self.clip > 0.0).all()):
            raise DataFormatError("scale and clip of the inputs must be greater than 0")

    def __call__(self, inputs: Array) -> Array:
        """Return the normalized inputs (n_inputs,) or (r, n_inputs)."""
        return np.clip((inputs - self.mean) / self.scale, -self.clip, self.clip).astype(np.float32)


@dataclass(frozen=True, eq=False)
class OutputBounds:
    """Bounds of an action space, to which outputs are mapped as in Stable-Baselines3's `predict`.

    Attributes:
        low: Lower bounds (n_outputs,).
        high: Upper bounds (n_outputs,).
        is_scaled: Whether outputs in [-1, 1] are scaled to the bounds (SAC, TD3, DDPG) rather than
            clipped to them (PPO, A2C).

    Raises:
        DataFormatError: Shapes differ, or the bounds are not finite and in order.
    """

    low: Array
    high: Array
    is_scaled: bool

    def __post_init__(self) -> None:
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise DataFormatError(
                f"bounds of the outputs must be vectors of one length, got {self.low.shape} and {self.high.shape}"
            )
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all() and (self.low <= self.high).all()):
            raise DataFormatError("bounds of the outputs must be finite, the lower ones not above the upper ones")

    def __call__(self, outputs: Array) -> Array:
        """Return the action (n_outputs,) or (r, n_outputs) within the bounds."""
        if not self.is_scaled:
            return np.clip(outputs, self.low, self.high)
        shares = (outputs + np.float32(1.0)) / np.float32(2.0)
        return np.asarray(self.low + shares * (self.high - self.low), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class DenseNetwork:
    """Multilayer perceptron that runs in NumPy, so that trained policies need no PyTorch.

    Attributes:
        weights: Weight matrices (n_outputs, n_inputs) of the layers.
        biases: Bias vectors (n_outputs,) of the layers.
        activation: Activation between layers, a key of `ACTIVATIONS`.
        output: Activation after the last layer, a key of `ACTIVATIONS`.
        normalization: Normalization of the inputs, or None.
        bounds: Bounds to which the outputs are mapped, or None.

    Raises:
        DataFormatError: Shapes do not match, a number is not finite, or an activation is unknown.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str = "tanh"
    output: str = "identity"
    normalization: InputNormalization | None = None
    bounds: OutputBounds | None = None

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
        if self.normalization is not None and len(self.normalization.mean) != self.n_inputs:
            raise DataFormatError(
                f"normalization must be for the network's {self.n_inputs} inputs, got {len(self.normalization.mean)}"
            )
        if self.bounds is not None and len(self.bounds.low) != self.n_outputs:
            raise DataFormatError(
                f"bounds must be for the network's {self.n_outputs} outputs, got {len(self.bounds.low)}"
            )

    @property
    def n_inputs(self) -> int:
        """Number of inputs of the first layer."""
        return int(self.weights[0].shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of outputs of the last layer."""
        return int(self.weights[-1].shape[0])

    def __call__(self, inputs: Array) -> Array:
        """Return the outputs (n_outputs,) for inputs (n_inputs,), or (r, n_outputs) for r inputs (r, n_inputs).

        The outputs for r inputs equal those for each of them to the bit.
        """
        values = inputs.astype(np.float32) if self.normalization is None else self.normalization(inputs)
        activate = ACTIVATIONS[self.activation]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            values = activate(_multiply(weight, values) + bias)
        outputs = ACTIVATIONS[self.output](_multiply(self.weights[-1], values) + self.biases[-1])
        return outputs if self.bounds is None else self.bounds(outputs)


def _multiply(weight: Array, values: Array) -> Array:
    """Return the products (..., n_outputs) of a matrix (n_outputs, n_inputs) and vectors (..., n_inputs)."""
    if values.ndim == 1:
        return weight @ values
    # One product of matrix and vector per row: the rounding of a product of matrices depends on the number of rows.
    product: Array = np.matmul(weight, values[..., None])[..., 0]
    return product


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
