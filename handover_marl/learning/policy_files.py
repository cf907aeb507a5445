"""Reader and writer of policy files.

| suffix | content | loading |
|---|---|---|
| .npz | weights of a `DenseNetwork`, and a `PolicySpec` as JSON; written by `export_policy` | always safe |
| .zip | Stable-Baselines3 model, trained on a frozen environment, encoded or not | weights only; extra `train` |
| .pt | TorchScript module from flat observations to actions | code, needs `trust=True`; extra `train` |
| .onnx | ONNX graph from flat observations to actions | always safe; extra `onnx` |
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, OptionError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.learning.features import count_features
from handover_marl.learning.policy_spec import (
    DenseNetwork,
    InputNormalization,
    OutputBounds,
    PolicyFunction,
    PolicySpec,
)
from handover_marl.learning.schemes import count_outputs
from handover_marl.policies.registry import check_stored_reference

# Format 2 has normalized inputs or bounded outputs; versions before 0.8 read format 1 only.
_FORMAT, _EXTENDED_FORMAT = 1, 2
#: Features and action scheme of policies from other libraries: flat observations, physical units.
RAW_ENCODINGS = {"giver": ("flat_giver", "giver"), "receiver": ("flat_receiver", "receiver")}


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """Content of a policy file: network, encoding and label.

    Attributes:
        spec: Encoding of inputs and outputs.
        function: Function from features to outputs.
        label: Unique label of the policy in result files: file name and a hash of the content.
    """

    spec: PolicySpec
    function: PolicyFunction
    label: str


def check_policy_path(path: Path) -> None:
    """Check the path of a policy file to write, before a training.

    Raises:
        OptionError: The path does not end in .npz.
    """
    if path.suffix != ".npz":
        raise OptionError(f"a policy file to write must end in .npz, got {path}; choose another name")


def write_policy(path: Path, spec: PolicySpec, network: DenseNetwork) -> None:
    """Write a policy file (.npz).

    Raises:
        OptionError: The path does not end in .npz.
        ResultsError: The file cannot be written.
    """
    check_policy_path(path)
    arrays: dict[str, npt.NDArray[Any]] = {f"weight_{number}": weight for number, weight in enumerate(network.weights)}
    arrays |= {f"bias_{number}": bias for number, bias in enumerate(network.biases)}
    about: dict[str, Any] = {
        "format": _FORMAT,
        "spec": asdict(spec),
        "activation": network.activation,
        "output": network.output,
    }
    if network.normalization is not None:
        normalization = network.normalization
        arrays |= {"input_mean": normalization.mean, "input_scale": normalization.scale}
        arrays["input_clip"] = normalization.clip
    if network.bounds is not None:
        arrays |= {"output_low": network.bounds.low, "output_high": network.bounds.high}
        about["is_scaled"] = network.bounds.is_scaled
    if network.normalization is not None or network.bounds is not None:
        about["format"] = _EXTENDED_FORMAT
    write_arrays(path, {"about": np.array(json.dumps(about)), **arrays})


def read_policy(
    path: Path,
    agent: str,
    trust: bool = False,
    control_period: float | None = None,
) -> PolicyFile:
    """Read a policy file of any kind.

    Args:
        path: Policy file.
        agent: Agent that the policy must control, "giver" or "receiver".
        trust: Whether code in the file may run, and modules that it names may be imported.
        control_period: Time between two decisions in training (s), for files that do not record it.

    Raises:
        DataNotFoundError: The file does not exist or cannot be read.
        DataFormatError: The file is damaged, or the policy is for another agent or other spaces.
        UnsafeFileError: The file contains Python objects or code, or names a module, and is not trusted.
        OptionError: The suffix is unknown, a package is missing, or `control_period` is missing or
            contradicts the file.
    """
    content = read_file(path)
    label = f"{path.stem}@{hashlib.sha256(content).hexdigest()[:8]}"
    function: PolicyFunction
    if path.suffix == ".npz":
        spec, function = _read_npz(path, content)
    elif path.suffix in (".zip", ".pt", ".onnx"):
        function, recorded, encoding = _read_other_format(path, content, agent, trust)
        period = _resolve_control_period(path, recorded, control_period)
        spec = PolicySpec(agent, *encoding, period, origin=path.name)
    else:
        raise OptionError(f"{path}: policy files are .npz, .zip (Stable-Baselines3), .pt (TorchScript) or .onnx (ONNX)")
    if spec.agent != agent:
        raise DataFormatError(f"{path}: policy must be for the {agent}, got one for the {spec.agent}")
    if control_period is not None and abs(control_period - spec.control_period) > 1e-9:
        raise OptionError(f"{path}: control_period must be {spec.control_period} as in training, got {control_period}")
    check_stored_encoding(path, (spec.features, spec.actions), trust)
    return PolicyFile(spec, function, label)


def check_stored_encoding(path: Path, encoding: tuple[str, str], trust: bool) -> None:
    """Check the names of features and action scheme that a policy file records.

    Raises:
        UnsafeFileError: One is `module:name`, and the file is not trusted.
    """
    for kind, name in zip(("features", "action scheme"), encoding, strict=True):
        check_stored_reference(path, kind, name, trust)


def _read_other_format(
    path: Path, content: bytes, agent: str, trust: bool
) -> tuple[PolicyFunction, float | None, tuple[str, str]]:
    """Return the function of another library's file, its control period if recorded, and its encoding."""
    # Readers are imported here, because .npz files need neither PyTorch nor ONNX Runtime.
    features, actions = RAW_ENCODINGS[agent]
    if path.suffix == ".zip":
        from handover_marl.learning.stable_baselines_files import read_stable_baselines

        found = read_stable_baselines(path, content, agent)
        return found.function, found.control_period, found.encoding or (features, actions)
    sizes = count_features(agent, features), count_outputs(agent, actions)
    if path.suffix == ".onnx":
        from handover_marl.learning.adapters.onnx_files import read_onnx

        return read_onnx(path, content, sizes), None, (features, actions)
    from handover_marl.learning.adapters.torch_script import read_torch_script

    return read_torch_script(path, content, agent, trust, sizes), None, (features, actions)


def read_file(path: Path) -> bytes:
    """Return the content of a policy file.

    Raises:
        DataNotFoundError: The file does not exist or cannot be read.
        DataFormatError: The path is a folder, pipe or device, or the file is too large.
    """
    try:
        return read_plain_file(path)
    except FileNotFoundError as error:
        raise DataNotFoundError(f"{path}: no such policy file") from error
    except OSError as error:
        raise DataNotFoundError(f"{path}: cannot read this policy file ({error.strerror or error})") from error
    except ValueError as error:
        raise DataFormatError(f"{path}: cannot read this policy file ({error})") from error


def _resolve_control_period(path: Path, recorded: float | None, requested: float | None) -> float:
    period = requested if recorded is None else recorded
    if period is None:
        raise OptionError(
            f"{path}: the file does not record the control period of the training; pass it: "
            f"learned:{path}:control_period=0.1"
        )
    return check_control_period(period, f"{path}: ")


def check_control_period(period: object, where: str = "") -> float:
    """Check the time between two decisions (s) and return it.

    Args:
        period: Value to check.
        where: Beginning of the error message, such as the name of a file.

    Raises:
        OptionError: The value is not a number from 0.001 to 60.
    """
    if isinstance(period, bool) or not isinstance(period, (int, float)) or not 0.001 <= period <= 60.0:
        raise OptionError(f"{where}control_period must be a time from 0.001 to 60 s, got {shorten_text(repr(period))}")
    return float(period)


def _read_npz(path: Path, content: bytes) -> tuple[PolicySpec, DenseNetwork]:
    try:
        arrays = read_arrays(content)
        about = json.loads(str(arrays["about"]))
        spec = _parse_spec(about)
        count = sum(name.startswith("weight_") for name in arrays)
        weights, biases = (
            tuple(arrays[f"{part}_{number}"].astype(np.float32) for number in range(count))
            for part in ("weight", "bias")
        )
        normalization, bounds = _parse_normalization(arrays), _parse_bounds(arrays, about)
        return spec, DenseNetwork(weights, biases, about["activation"], about["output"], normalization, bounds)
    except HandoverError as error:
        raise DataFormatError(f"{path}: {error}") from error
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(
            f"{path}: not a policy file of handover_marl ({shorten_text(error)}); "
            "the scripts in experiments/ write them"
        ) from error


def _parse_normalization(arrays: Mapping[str, npt.NDArray[Any]]) -> InputNormalization | None:
    if "input_mean" not in arrays:
        return None
    mean, scale, clip = (arrays[f"input_{part}"].astype(np.float64) for part in ("mean", "scale", "clip"))
    return InputNormalization(mean, scale, clip)


def _parse_bounds(arrays: Mapping[str, npt.NDArray[Any]], about: Mapping[str, Any]) -> OutputBounds | None:
    if "output_low" not in arrays:
        return None
    low, high = (arrays[f"output_{part}"].astype(np.float32) for part in ("low", "high"))
    return OutputBounds(low, high, bool(about["is_scaled"]))


def _parse_spec(about: dict[str, Any]) -> PolicySpec:
    if about["format"] not in (_FORMAT, _EXTENDED_FORMAT):
        raise DataFormatError(
            f"format must be {_FORMAT} or {_EXTENDED_FORMAT}, got {about['format']!r}; update handover_marl"
        )
    spec = PolicySpec(**about["spec"])
    for name, value in asdict(spec).items():
        if not isinstance(value, (int, float) if name == "control_period" else str):
            raise DataFormatError(f"{name} has the wrong type: {shorten_text(repr(value))}")
    if not 0.001 <= spec.control_period <= 60.0:
        raise DataFormatError(f"control_period must be from 0.001 to 60 s, got {spec.control_period}")
    return spec
