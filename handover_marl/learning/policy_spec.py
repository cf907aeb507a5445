"""Multilayer perceptron with normalized inputs and bounded outputs, and the encoding of a policy that uses it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.spaces import STATE
from handover_marl.errors import DataFormatError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, get_namespace, is_tensor

Array = npt.NDArray[np.float32]

#: Features and action scheme by agent for policies from other libraries: flat observations, physical units.
RAW_ENCODINGS = {"giver": ("flat_giver", "giver"), "receiver": ("flat_receiver", "receiver")}
#: Value of `PolicySpec.features` for functions that take observations as they are.
OBSERVATION = "observation"
#: Activations by name, functions of an array namespace and an array.
ACTIVATIONS: dict[str, Callable[[Any, AnyArray], AnyArray]] = {
    "tanh": lambda xp, values: xp.tanh(values),
    "relu": lambda xp, values: values.clip(0.0),
    "identity": lambda xp, values: values,
    "elu": lambda xp, values: xp.where(values > 0.0, values, xp.expm1(values.clip(None, 0.0))),
    "leaky_relu": lambda xp, values: xp.where(values > 0.0, values, 0.01 * values),
    # Without the exponential function, which overflows.
    "sigmoid": lambda xp, values: 0.5 + 0.5 * xp.tanh(0.5 * values),
    "silu": lambda xp, values: values * (0.5 + 0.5 * xp.tanh(0.5 * values)),
}


@dataclass(frozen=True, eq=False)
class InputNormalization:
    """Normalization of a network's inputs: (inputs - mean) / scale, clipped to [-clip, clip].

    Attributes:
        mean: Means (n_inputs,) of the inputs.
        scale: Standard deviations (n_inputs,) of the inputs, greater than 0.
        clip: Largest absolute values (n_inputs,) of normalized inputs; infinite without a limit.

    Raises:
        DataFormatError: A number is out of range.
    """

    mean: npt.NDArray[np.float64]
    scale: npt.NDArray[np.float64]
    clip: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        if not ((self.scale > 0.0).all() and (self.clip > 0.0).all()):
            raise DataFormatError("scale and clip of the inputs must be greater than 0")

    def __call__(self, inputs: AnyArray) -> AnyArray:
        """Return the normalized inputs (n_inputs,) or (r, n_inputs)."""
        xp = get_namespace(inputs)
        return xp.astype(((inputs - self.mean) / self.scale).clip(-self.clip, self.clip), xp.float32)


@dataclass(frozen=True, eq=False)
class OutputBounds:
    """Bounds of an action space, to which outputs are mapped as in Stable-Baselines3's `predict`.

    Attributes:
        low: Lower bounds (n_outputs,).
        high: Upper bounds (n_outputs,).
        is_scaled: Whether outputs in [-1, 1] are scaled to the bounds (SAC, TD3, DDPG) rather than
            clipped to them (PPO, A2C).
    """

    low: Array
    high: Array
    is_scaled: bool

    def __call__(self, outputs: AnyArray) -> AnyArray:
        """Scale or clip outputs (n_outputs,) or (r, n_outputs) to the bounds; return them in the same shape."""
        if not self.is_scaled:
            return outputs.clip(self.low, self.high)
        return self.low + (outputs + 1.0) / 2.0 * (self.high - self.low)


@dataclass(frozen=True, eq=False)
class DenseNetwork:
    """Multilayer perceptron in NumPy, or on PyTorch tensors (`copy_to`); raises DataFormatError if parts do not fit.

    Attributes:
        weights: Weight matrices (n_outputs, n_inputs) of the layers.
        biases: Bias vectors (n_outputs,) of the layers.
        activation: Activation between layers, a key of `ACTIVATIONS`.
        output: Activation after the last layer, a key of `ACTIVATIONS`.
        normalization: Normalization of the inputs, or None.
        bounds: Bounds to which the outputs are mapped, or None.
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
        for name in (self.activation, self.output):
            if name not in ACTIVATIONS:
                raise DataFormatError(f"unknown activation {name!r}; valid: {', '.join(ACTIVATIONS)}")
        width = None
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if weight.ndim != 2 or bias.shape != weight.shape[:1] or width not in (None, weight.shape[1]):
                raise DataFormatError(
                    f"layer {number} must have weights (m, {width or 'n'}) and biases (m,), got shapes {weight.shape} "
                    f"and {bias.shape}; export the policy again"
                )
            xp, width = get_namespace(weight), weight.shape[0]
            if not (xp.isfinite(weight).all() and xp.isfinite(bias).all()):
                raise DataFormatError(f"layer {number} must have finite numbers only; export another policy")
        ends: list[tuple[AnyArray, int]] = []
        ends += [(self.normalization.mean, self.n_inputs)] if self.normalization is not None else []
        ends += [(self.bounds.low, self.n_outputs)] if self.bounds is not None else []
        if any(values.shape != (size,) for values, size in ends):
            raise DataFormatError(
                f"normalization or bounds do not fit {self.n_inputs} inputs, {self.n_outputs} outputs"
            )

    @property
    def n_inputs(self) -> int:
        """Number of inputs of the first layer."""
        return int(self.weights[0].shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of outputs of the last layer."""
        return int(self.weights[-1].shape[0])

    def copy_to(self, arrays: ArrayFactory) -> "DenseNetwork":
        """Return a copy whose weights, inputs and outputs are arrays of the factory, e.g. tensors on a GPU."""
        copy, scaling, bounds = arrays.asarray, self.normalization, self.bounds
        return replace(
            self,
            weights=tuple(map(copy, self.weights)),
            biases=tuple(map(copy, self.biases)),
            normalization=scaling and InputNormalization(copy(scaling.mean), copy(scaling.scale), copy(scaling.clip)),
            bounds=bounds and replace(bounds, low=copy(bounds.low), high=copy(bounds.high)),
        )

    def __call__(self, inputs: AnyArray) -> AnyArray:
        """Return the outputs (n_outputs,) for inputs (n_inputs,), or (r, n_outputs) for r inputs (r, n_inputs).

        With NumPy arrays, a batch of r inputs gives bit-identical outputs to r calls with one input each.
        """
        xp = get_namespace(inputs)
        values = xp.astype(inputs, xp.float32) if self.normalization is None else self.normalization(inputs)
        activations = [self.activation] * (len(self.weights) - 1) + [self.output]
        for weight, bias, activation in zip(self.weights, self.biases, activations, strict=True):
            values = ACTIVATIONS[activation](xp, _multiply(weight, values) + bias)
        return values if self.bounds is None else self.bounds(values)


def _multiply(weight: AnyArray, values: AnyArray) -> AnyArray:
    """Return the products (..., n_outputs) of a matrix (n_outputs, n_inputs) and vectors (..., n_inputs)."""
    if is_tensor(values):
        return values @ weight.T
    # One product of matrix and vector per row: the rounding of a product of matrices depends on the number of rows.
    return np.matmul(weight, values[..., None])[..., 0]


@dataclass(frozen=True)
class PolicySpec:
    """Encoding of a policy's inputs and outputs, stored with the network in a policy file.

    Attributes:
        agent: Agent that the policy controls, "giver" or "receiver".
        features: Features that are the inputs, see `handover_marl.encode`, or `OBSERVATION`; always text in files.
        actions: Action scheme that decodes outputs, see `handover_marl.encode`; always text in files.
        control_period: Time between two decisions (s).
        origin: Command, seed and budget of the training, for human readers.
        obs_mode: Observation mode of a receiver, e.g. "state", see `handover_marl.parallel_env`.
    """

    agent: str
    features: Any
    actions: Any
    control_period: float = 0.1
    origin: str = ""
    obs_mode: str = STATE
