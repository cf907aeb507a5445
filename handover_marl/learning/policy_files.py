"""Policies on disk.

| file | what it is | loaded |
|---|---|---|
| .npz | this library's: the weights of a `Network` and a `PolicySpec` as JSON | always |
| .zip | Stable-Baselines3's, trained on a frozen environment as it is | by its weights alone; extra `train` |
| .pt | TorchScript: all observations as one vector to an action | with `trust=True`: it is code; extra `train` |

Loading never runs code from the file unless it is trusted. A policy that the training scripts in experiments/ made
comes as .npz.
"""

import hashlib
import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, OptionError
from handover_marl.files import write_arrays
from handover_marl.learning.network import Network
from handover_marl.learning.policy_spec import Function, PolicySpec

_FORMAT = 1
_LARGEST = 500_000_000  # bytes
#: What foreign policies see and do: everything, and the agent's space as it is.
PLAIN = {"giver": ("flat_giver", "giver"), "receiver": ("flat_receiver", "receiver")}


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """What a policy file holds.

    Attributes:
        spec: How the function is used.
        function: From features to outputs.
        label: Name of the file and a hash of its content, by which results are filed.
    """

    spec: PolicySpec
    function: Function
    label: str


def write_policy(path: Path, spec: PolicySpec, network: Network) -> None:
    """Write a policy file (.npz).

    Raises:
        ResultsError: It cannot be written.
    """
    arrays = {f"weight_{number}": weight for number, weight in enumerate(network.weights)}
    arrays |= {f"bias_{number}": bias for number, bias in enumerate(network.biases)}
    about = {
        "format": _FORMAT,
        "spec": asdict(spec),
        "activation": network.activation,
        "output": network.output,
    }
    write_arrays(path, {"about": np.array(json.dumps(about)), **arrays})


def read_policy(path: Path, agent: str, trust: bool = False, control_period: float | None = None) -> PolicyFile:
    """Read a policy file of any kind.

    Args:
        path: The file.
        agent: Whose policy is wanted, "giver" or "receiver".
        trust: Whether code in the file may run.
        control_period: How often it was asked in training (s), for files that do not tell.

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: It is no policy, or one of another agent or other spaces.
        UnsafeFileError: It holds foreign Python objects or code and is not trusted.
        OptionError: Its kind is not known, or needs PyTorch, which is not installed; or the file says another
            control period than is asked for, or none and none is given.
    """
    content = _read_bytes(path)
    label = f"{path.stem}@{hashlib.sha256(content).hexdigest()[:8]}"
    function: Function
    if path.suffix == ".npz":
        spec, function = _read_own(path, content)
    elif path.suffix in (".zip", ".pt"):
        # Only who has such a file needs PyTorch.
        from handover_marl.learning.foreign_policies import read_stable_baselines, read_torch_script

        if path.suffix == ".zip":
            function, period = read_stable_baselines(path, content, agent)
        else:
            function, period = read_torch_script(path, content, agent, trust), None
        spec = PolicySpec(agent, *PLAIN[agent], _period(path, period, control_period), origin=path.name)
    else:
        raise OptionError(f"{path}: policy files are .npz, .zip (Stable-Baselines3) or .pt (TorchScript)")
    if spec.agent != agent:
        raise DataFormatError(f"{path}: this policy is a {spec.agent}'s; a {agent}'s is wanted")
    if control_period is not None and abs(control_period - spec.control_period) > 1e-9:
        raise OptionError(f"{path}: it was trained at {spec.control_period} s a decision, not {control_period}")
    return PolicyFile(spec, function, label)


def _read_bytes(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise DataNotFoundError(f"{path}: there is no such policy file")
        if path.stat().st_size > _LARGEST:
            raise DataFormatError(f"{path}: policy files have at most {_LARGEST // 1_000_000} MB")
        return path.read_bytes()
    except ValueError as error:
        if isinstance(error, HandoverError):
            raise
        raise DataNotFoundError(f"{path}: there is no such policy file") from error
    except DataNotFoundError:
        raise
    except OSError as error:
        raise DataNotFoundError(f"{path}: cannot read this policy file ({error.strerror or error})") from error


def _period(path: Path, found: float | None, asked: float | None) -> float:
    """The control period of a policy: what its file says, or what is asked for."""
    period = asked if found is None else found
    if period is None:
        raise OptionError(
            f"{path}: the file does not say how often the policy was asked in training; say so: "
            f"learned:{path}:control_period=0.1"
        )
    if isinstance(period, bool) or not isinstance(period, (int, float)) or not 0.001 <= period <= 60.0:
        raise OptionError(f"control_period={period!r} must be a time from 0.001 to 60 s")
    return float(period)


def _read_own(path: Path, content: bytes) -> tuple[PolicySpec, Network]:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            about = json.loads(str(archive["about"]))
            spec = _spec(about)
            count = sum(name.startswith("weight_") for name in archive.files)
            weights, biases = (
                tuple(archive[f"{part}_{number}"].astype(np.float32) for number in range(count))
                for part in ("weight", "bias")
            )
            return spec, Network(weights, biases, about["activation"], about["output"])
    except HandoverError as error:
        raise DataFormatError(f"{path}: {error}") from error
    except Exception as error:  # what NumPy and zipfile raise on damaged bytes has no end
        raise DataFormatError(
            f"{path}: no policy file of handover_marl ({type(error).__name__}: {error}); "
            "the scripts in experiments/ write them"
        ) from error


def _spec(about: dict[str, Any]) -> PolicySpec:
    if about["format"] != _FORMAT:
        raise DataFormatError(f"format {about['format']!r}, expected {_FORMAT}; update handover_marl")
    spec = PolicySpec(**about["spec"])
    for name, value in asdict(spec).items():
        kinds = (int, float) if name == "control_period" else (str,)
        if not isinstance(value, kinds):
            raise DataFormatError(f"{name} is {value!r}")
    if not 0.001 <= spec.control_period <= 60.0:
        raise DataFormatError(f"a control period of {spec.control_period} s")
    return spec
