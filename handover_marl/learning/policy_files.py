"""Reader and writer of policy files: a network and its encoding.

| suffix | content | loading |
|---|---|---|
| .npz | weights of a `DenseNetwork`, and a `PolicySpec` as JSON; written by `export_policy` | always safe |
| .zip | Stable-Baselines3 model, trained on a frozen environment, encoded or not | code: needs trust, extra `train` |
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, OptionError, UnsafeFileError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.learning.policy_spec import DenseNetwork, InputNormalization, OutputBounds, PolicySpec
from handover_marl.policies.registry import check_stored_reference

_FORMAT = 1
_DEFAULT_PERIOD = 0.1  # s, as that of environments


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """Content of a policy file: network, encoding and label.

    Attributes:
        spec: Encoding of inputs and outputs.
        function: Network from features to outputs.
        label: Unique label of the policy in result files: file name and a hash of the content.
    """

    spec: PolicySpec
    function: DenseNetwork
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
        control_period: Time between two decisions in training (s), for files that do not record it; default: 0.1 s.

    Raises:
        DataNotFoundError: The file does not exist or cannot be read.
        DataFormatError: The file is damaged, or the policy is for another agent or other spaces.
        UnsafeFileError: The file contains Python objects or code, or names a module, and is not trusted.
        OptionError: The suffix is unknown, a package is missing, or `control_period` contradicts the file.
    """
    content = read_file(path)
    if path.suffix == ".npz":
        spec, function = _read_npz(path, content)
    elif path.suffix == ".zip":
        spec, function = _read_zip(path, content, agent, trust)
    else:
        raise OptionError(f"{path}: policy files are .npz or .zip (Stable-Baselines3); run others with as_{agent}")
    if spec.agent != agent:
        raise DataFormatError(f"{path}: policy must be for the {agent}, got one for the {spec.agent}")
    for kind, name in (("features", spec.features), ("action scheme", spec.actions)):
        check_stored_reference(path, kind, name, trust)
    period = match_control_period(path, spec.control_period, control_period)
    label = f"{path.stem}@{hashlib.sha256(content).hexdigest()[:8]}"
    return PolicyFile(replace(spec, control_period=period), function, label)


def _read_zip(path: Path, content: bytes, agent: str, trust: bool) -> tuple[PolicySpec, DenseNetwork]:
    # Imports Stable-Baselines3, which policies in .npz files do not need.
    from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3, get_recorded_encoding

    model = load_sb3_file(path, content, trust)
    owner, features, actions, period = get_recorded_encoding(model)
    if owner is None or features is None or actions is None:
        raise DataFormatError(
            f"{path}: the file does not record features and action scheme of its training; pass them to as_{agent}"
        )
    spec = PolicySpec(owner, features, actions, _DEFAULT_PERIOD if period is None else period, path.name)
    return spec, dense_network_from_sb3(model)


def load_sb3_file(path: Path, content: bytes, trust: bool) -> Any:
    """Load a model of Stable-Baselines3 from the content of a file, which contains pickles.

    Raises:
        UnsafeFileError: The file is not trusted.
        DataFormatError: The file contains no such model.
        OptionError: Stable-Baselines3 is not installed.
    """
    if not trust:
        raise UnsafeFileError(
            f"{path}: a file of Stable-Baselines3 can run code; pass trust=True (--trust) if you know where it comes "
            "from, or write the policy as .npz with handover_marl.export_policy"
        )
    try:
        from handover_marl.learning.adapters.sb3_models import load_sb3_model
    except ImportError as error:
        raise OptionError(f"{path} needs Stable-Baselines3: pip install 'handover-marl[train]'") from error
    try:
        return load_sb3_model(content)
    except Exception as error:  # unpickling may raise anything
        raise DataFormatError(f"{path}: not a model of Stable-Baselines3 ({shorten_text(error)})") from error


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


def match_control_period(where: object, recorded: float | None, requested: float | None) -> float:
    """Return the time between two decisions (s): as recorded, else as requested, else 0.1 s.

    Args:
        where: Policy, for errors.
        recorded: Time that is recorded for the policy, or None.
        requested: Time that the caller passes, or None.

    Raises:
        OptionError: The times differ, or one is out of range.
    """
    if recorded is not None and requested is not None and abs(recorded - requested) > 1e-9:
        raise OptionError(f"{where}: control_period must be {recorded} as in training, got {requested}")
    found = requested if recorded is None else recorded
    return _DEFAULT_PERIOD if found is None else check_control_period(found, f"{where}: ")


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
    if about["format"] != _FORMAT:
        raise DataFormatError(f"format must be {_FORMAT}, got {about['format']!r}; write the file again")
    spec = PolicySpec(**about["spec"])
    check_control_period(spec.control_period)
    for name, value in asdict(spec).items():
        if name != "control_period" and not isinstance(value, str):
            raise DataFormatError(f"{name} has the wrong type: {shorten_text(repr(value))}")
    return spec
