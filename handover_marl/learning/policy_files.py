"""Reader and writer of policy files (.npz): the weights of a `DenseNetwork`, and a `PolicySpec` as JSON."""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import MAX_CONTROL_PERIOD
from handover_marl.episode.spaces import STATE
from handover_marl.errors import DataFormatError, OptionError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.reading import read_arrays, read_plain_file, report_damage
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, get_namespace, is_tensor
from handover_marl.policies.registry import check_stored_reference

Array = npt.NDArray[np.float32]

#: Names of features and action scheme by agent for policies from other libraries: flat observations, physical units.
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
        DataFormatError: A number in `scale` or `clip` is not greater than 0.
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
    """Bounds of an action space, and the way in which outputs are mapped to them, as by Stable-Baselines3's `predict`.

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
    """Multilayer perceptron in NumPy, or on PyTorch tensors (`copy_to`).

    Attributes:
        weights: Weight matrix (n_outputs, n_inputs) of each layer.
        biases: Bias vector (n_outputs,) of each layer.
        activation: Activation between layers, a key of `ACTIVATIONS`.
        output: Activation after the last layer, a key of `ACTIVATIONS`.
        normalization: Normalization of the inputs, or None.
        bounds: Bounds to which the outputs are mapped, or None.

    Raises:
        DataFormatError: Shapes do not fit together, an activation is unknown, or a weight is not finite.
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
        """Return a copy that has, takes and returns arrays of a factory, e.g. PyTorch tensors on a GPU."""
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
        features: Features that are the inputs: a name, `module:name`, or `OBSERVATION`; outside of files also a class
            or function, see `handover_marl.encode`.
        actions: Action scheme that decodes the outputs, in the same forms except `OBSERVATION`.
        control_period: Time between two decisions (s).
        origin: Description of the training, such as script and arguments, for human readers.
        obs_mode: Observation mode of a receiver, e.g. "state", see `handover_marl.parallel_env`.
    """

    agent: str
    features: Any
    actions: Any
    control_period: float = 0.1
    origin: str = ""
    obs_mode: str = STATE


_FORMAT = 1
_DEFAULT_PERIOD = 0.1  # s, as that of environments


def check_policy_path(path: Path) -> None:
    """Raise OptionError unless a path ends in .npz; call it first, so that a long training does not fail at its end."""
    if path.suffix != ".npz":
        raise OptionError(f"a policy file to write must end in .npz, got {path}; choose another name")


def write_policy(path: Path, spec: PolicySpec, network: DenseNetwork) -> None:
    """Write a network and the names (or `module:name`) of its features and action scheme to a policy file (.npz)."""
    check_policy_path(path)
    arrays: dict[str, npt.NDArray[Any]] = {f"weight_{number}": weight for number, weight in enumerate(network.weights)}
    arrays |= {f"bias_{number}": bias for number, bias in enumerate(network.biases)}
    about: dict[str, Any] = {"format": _FORMAT, "spec": asdict(spec)}
    about |= {"activation": network.activation, "output": network.output}
    if network.normalization is not None:
        arrays |= {f"input_{name}": values for name, values in vars(network.normalization).items()}
    if network.bounds is not None:
        arrays |= {"output_low": network.bounds.low, "output_high": network.bounds.high}
        about["is_scaled"] = network.bounds.is_scaled
    write_arrays(path, {"about": np.array(json.dumps(about)), **arrays})


def read_policy(path: Path, agent: str, trust: bool = False, **overrides: Any) -> tuple[PolicySpec, DenseNetwork, str]:
    """Read a policy file without running or importing code; raise DataNotFoundError or DataFormatError if that fails.

    Args:
        path: Policy file; another suffix than .npz raises OptionError.
        agent: Agent that the policy must control, "giver" or "receiver".
        trust: Whether modules that the file names may be imported later; if not, such a file raises UnsafeFileError.
        **overrides: Fields of `PolicySpec` that replace those in the file; None keeps a field, see `complete_spec`.

    Returns:
        Encoding, network from features to outputs, and unique label of the policy in result files: `NAME@HASH`, with
        the file name without suffix and a hash of the content.
    """
    if path.suffix != ".npz":
        raise OptionError(
            f"{path}: a policy file must end in .npz; load the network by its own library, such as PPO.load, and pass "
            f"it to handover_marl.as_{agent}, or write it by handover_marl.export_policy"
        )
    with report_damage(path, "policy file", "give one that handover_marl.export_policy or a training script wrote"):
        content = read_plain_file(path)
        recorded, network = _decode_policy(content)
    for key, kind in (("features", "features"), ("actions", "action scheme")):
        if key in recorded and overrides.get(key) is None:
            check_stored_reference(path, kind, recorded[key], trust)
    digest = hashlib.sha256(content).hexdigest()[:8]
    return complete_spec(path, agent, recorded, overrides), network, f"{path.stem}@{digest}"


def complete_spec(
    source: object, agent: str | None, recorded: Mapping[str, Any], overrides: Mapping[str, Any]
) -> PolicySpec:
    """Return the encoding of a policy: each field as the caller chooses it, else as the training recorded it.

    Args:
        source: File or name of the policy, for errors.
        agent: Agent that the policy must control; None for the recorded one.
        recorded: Fields of `PolicySpec` by name that the training recorded.
        overrides: Fields of `PolicySpec` by name that the caller chooses; None as a value means not chosen. If the
            control period is neither chosen nor recorded, it is 0.1 s.

    Raises:
        DataFormatError: The recorded agent is not `agent`.
        OptionError: Agent, features or action scheme are missing, or the control period is out of range or not the
            recorded one.
    """
    if agent is not None and recorded.get("agent", agent) != agent:
        raise DataFormatError(f"{source}: policy must be for the {agent}, got one for the {recorded['agent']}")
    chosen = {key: value for key, value in overrides.items() if value is not None}
    fields = {"agent": agent, "control_period": _DEFAULT_PERIOD} | dict(recorded) | chosen
    period = fields["control_period"]
    before = recorded.get("control_period", period)
    for value in (before, period):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.001 <= value <= MAX_CONTROL_PERIOD:
            rule = f"control_period must be a time from 0.001 to {MAX_CONTROL_PERIOD:g} s"
            raise OptionError(f"{source}: {rule}, got {shorten_text(repr(value))}; for 100 ms pass 0.1")
    if abs(before - period) > 1e-9:
        raise OptionError(f"{source}: control_period must be {before} as in training, got {period}")
    for key, name in (("agent", "agent"), ("features", "features"), ("actions", "action_scheme")):
        if fields.get(key) is None:
            raise OptionError(f"{source}: {name} must be given, because the model does not record it")
    return PolicySpec(**fields | {"control_period": float(period)})


def _decode_policy(content: bytes) -> tuple[dict[str, Any], DenseNetwork]:
    """Decode the content of a policy file: return the fields of `PolicySpec` by name, and the network."""
    arrays = read_arrays(content)
    about = json.loads(str(arrays["about"]))
    if about["format"] != _FORMAT:
        raise DataFormatError(f"format must be {_FORMAT}, got {about['format']!r}")
    spec = PolicySpec(**about["spec"])
    if not all(isinstance(value, str) for key, value in vars(spec).items() if key != "control_period"):
        raise DataFormatError("names must be text")
    count = sum(name.startswith("weight_") for name in arrays)
    weights, biases = (
        tuple(arrays[f"{part}_{number}"].astype(np.float32) for number in range(count)) for part in ("weight", "bias")
    )
    normalization = bounds = None
    if "input_mean" in arrays:
        parts = (arrays[f"input_{part}"].astype(np.float64) for part in ("mean", "scale", "clip"))
        normalization = InputNormalization(*parts)
    if "output_low" in arrays:
        low, high = (arrays[f"output_{part}"].astype(np.float32) for part in ("low", "high"))
        bounds = OutputBounds(low, high, bool(about["is_scaled"]))
    network = DenseNetwork(weights, biases, about["activation"], about["output"], normalization, bounds)
    return asdict(spec), network
