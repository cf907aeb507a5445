"""Reader and writer of policy files.

| suffix | content | loading |
|---|---|---|
| .npz | weights of a `DenseNetwork`, and a `PolicySpec` as JSON; written by the training scripts | always safe |
| .zip | Stable-Baselines3 model, trained on a frozen environment without encoding | weights only; extra `train` |
| .pt | TorchScript module from flat observations to actions | code, needs `trust=True`; extra `train` |
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, OptionError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.learning.policy_spec import DenseNetwork, PolicyFunction, PolicySpec

_FORMAT = 1
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


def write_policy(path: Path, spec: PolicySpec, network: DenseNetwork) -> None:
    """Write a policy file (.npz).

    Raises:
        ResultsError: The file cannot be written.
    """
    arrays = {f"weight_{number}": weight for number, weight in enumerate(network.weights)}
    arrays |= {f"bias_{number}": bias for number, bias in enumerate(network.biases)}
    about = {"format": _FORMAT, "spec": asdict(spec), "activation": network.activation, "output": network.output}
    write_arrays(path, {"about": np.array(json.dumps(about)), **arrays})


def read_policy(path: Path, agent: str, trust: bool = False, control_period: float | None = None) -> PolicyFile:
    """Read a policy file of any kind.

    Args:
        path: Policy file.
        agent: Agent that the policy must control, "giver" or "receiver".
        trust: Whether code in the file may run.
        control_period: Time between two decisions in training (s), for files that do not record it.

    Raises:
        DataNotFoundError: The file does not exist or cannot be read.
        DataFormatError: The file is damaged, or the policy is for another agent or other spaces.
        UnsafeFileError: The file contains Python objects or code and is not trusted.
        OptionError: The suffix is unknown, PyTorch is missing, or `control_period` is missing or
            contradicts the file.
    """
    content = _read_bytes(path)
    label = f"{path.stem}@{hashlib.sha256(content).hexdigest()[:8]}"
    function: PolicyFunction
    if path.suffix == ".npz":
        spec, function = _read_npz(path, content)
    elif path.suffix in (".zip", ".pt"):
        # Imports PyTorch, which .npz files do not need.
        from handover_marl.learning.foreign_policies import read_stable_baselines, read_torch_script

        if path.suffix == ".zip":
            function, period = read_stable_baselines(path, content, agent)
        else:
            function, period = read_torch_script(path, content, agent, trust), None
        period = _resolve_control_period(path, period, control_period)
        spec = PolicySpec(agent, *RAW_ENCODINGS[agent], period, origin=path.name)
    else:
        raise OptionError(f"{path}: policy files are .npz, .zip (Stable-Baselines3) or .pt (TorchScript)")
    if spec.agent != agent:
        raise DataFormatError(f"{path}: policy must be for the {agent}, got one for the {spec.agent}")
    if control_period is not None and abs(control_period - spec.control_period) > 1e-9:
        raise OptionError(f"{path}: control_period must be {spec.control_period} as in training, got {control_period}")
    return PolicyFile(spec, function, label)


def _read_bytes(path: Path) -> bytes:
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
    if isinstance(period, bool) or not isinstance(period, (int, float)) or not 0.001 <= period <= 60.0:
        raise OptionError(f"{path}: control_period must be a time from 0.001 to 60 s, got {shorten_text(repr(period))}")
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
        return spec, DenseNetwork(weights, biases, about["activation"], about["output"])
    except HandoverError as error:
        raise DataFormatError(f"{path}: {error}") from error
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(
            f"{path}: not a policy file of handover_marl ({shorten_text(error)}); "
            "the scripts in experiments/ write them"
        ) from error


def _parse_spec(about: dict[str, Any]) -> PolicySpec:
    if about["format"] != _FORMAT:
        raise DataFormatError(f"format must be {_FORMAT}, got {about['format']!r}; update handover_marl")
    spec = PolicySpec(**about["spec"])
    for name, value in asdict(spec).items():
        if not isinstance(value, (int, float) if name == "control_period" else str):
            raise DataFormatError(f"{name} has the wrong type: {shorten_text(repr(value))}")
    if not 0.001 <= spec.control_period <= 60.0:
        raise DataFormatError(f"control_period must be from 0.001 to 60 s, got {spec.control_period}")
    return spec
