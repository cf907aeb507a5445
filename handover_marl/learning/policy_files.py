"""Policies on disk.

| file | what it is | loaded |
|---|---|---|
| .npz | this library's: the weights of a `Network` and a `PolicySpec` as JSON | always |
| .zip | Stable-Baselines3's, trained on the single-agent views as they are | by its weights alone; extra `train` |
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
from handover_marl.files import write_atomically
from handover_marl.learning.network import Network
from handover_marl.learning.policy import Function, PolicySpec

_FORMAT = 1
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
    stream = io.BytesIO()
    np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]
    write_atomically(path, stream.getvalue())


def read_policy(path: Path, agent: str, trust: bool = False) -> PolicyFile:
    """Read a policy file of any kind.

    Args:
        path: The file.
        agent: Whose policy is wanted, "giver" or "receiver".
        trust: Whether code in the file may run.

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: It is no policy, or one of another agent or other spaces.
        UnsafeFileError: It holds foreign Python objects or code and is not trusted.
        OptionError: Its kind is not known, or needs PyTorch, which is not installed.
    """
    if not path.is_file():
        raise DataNotFoundError(f"{path}: there is no such policy file")
    content = path.read_bytes()
    label = f"{path.stem}@{hashlib.sha256(content).hexdigest()[:8]}"
    function: Function
    if path.suffix == ".npz":
        spec, function = _read_own(path, content)
    elif path.suffix in (".zip", ".pt"):
        # Only who has such a file needs PyTorch.
        from handover_marl.learning.foreign_policies import read_stable_baselines, read_torch_script

        read = read_stable_baselines if path.suffix == ".zip" else read_torch_script
        spec = PolicySpec(agent, *PLAIN[agent], origin=path.name)
        function = read(path, content, agent, trust)
    else:
        raise OptionError(f"{path}: policy files are .npz, .zip (Stable-Baselines3) or .pt (TorchScript)")
    if spec.agent != agent:
        raise DataFormatError(f"{path}: this policy is a {spec.agent}'s; a {agent}'s is wanted")
    return PolicyFile(spec, function, label)


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
