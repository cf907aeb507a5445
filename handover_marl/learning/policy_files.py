"""Reader and writer of policy files (.npz): the weights of a `DenseNetwork`, and a `PolicySpec` as JSON."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import MAX_CONTROL_PERIOD
from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, OptionError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.learning.policy_spec import DenseNetwork, InputNormalization, OutputBounds, PolicySpec
from handover_marl.policies.registry import check_stored_reference

_FORMAT = 1
_DEFAULT_PERIOD = 0.1  # s, as that of environments


def check_policy_path(path: Path) -> None:
    """Check that a path ends in .npz, as policy files do, so that a training does not fail at its end."""
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
    """Read a policy file, without running code; raise DataNotFoundError or DataFormatError if that fails.

    Args:
        path: Policy file; another suffix than .npz raises OptionError.
        agent: Agent that the policy must control, "giver" or "receiver".
        trust: Whether modules that the file names may be imported; else such a file raises UnsafeFileError.
        **overrides: Fields of `PolicySpec` that replace those in the file; None keeps a field, see `complete_spec`.

    Returns:
        Encoding, network from features to outputs, and unique label of the policy in result files: file name and a
        hash of the content.
    """
    if path.suffix != ".npz":
        raise OptionError(
            f"{path}: a policy file must end in .npz; load the network by its own library, such as PPO.load, and pass "
            f"it to handover_marl.as_{agent}, or write it by handover_marl.export_policy"
        )
    try:
        content = read_plain_file(path)
    except OSError as error:
        raise DataNotFoundError(
            f"{path}: cannot read this policy file ({error.strerror or error}); give the path of one that "
            "handover_marl.export_policy or a training script wrote"
        ) from error
    except ValueError as error:
        raise DataFormatError(f"{path}: cannot read this policy file ({error})") from error
    recorded, network = _read_npz(path, content)
    for key, kind in (("features", "features"), ("actions", "action scheme")):
        if key in recorded and overrides.get(key) is None:
            check_stored_reference(path, kind, recorded[key], trust)
    digest = hashlib.sha256(content).hexdigest()[:8]
    return complete_spec(path, agent, recorded, overrides), network, f"{path.stem}@{digest}"


def complete_spec(
    source: object, agent: str | None, recorded: Mapping[str, Any], overrides: Mapping[str, Any]
) -> PolicySpec:
    """Return the encoding of a policy: each field as the caller gives it, else as the training recorded it.

    Args:
        source: File or name of the policy, for errors.
        agent: Agent that the policy must control; None for the recorded one.
        recorded: Fields of `PolicySpec` by name that the training recorded.
        overrides: Fields of `PolicySpec` by name that the caller chooses; None as a value means not chosen. A chosen
            control period must equal the recorded one, else OptionError is raised; without either, it is 0.1 s.
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


def _read_npz(path: Path, content: bytes) -> tuple[dict[str, Any], DenseNetwork]:
    try:
        arrays = read_arrays(content)
        about = json.loads(str(arrays["about"]))
        if about["format"] != _FORMAT:
            raise DataFormatError(f"format must be {_FORMAT}, got {about['format']!r}; write the file again")
        spec = PolicySpec(**about["spec"])
        if not all(isinstance(value, str) for key, value in vars(spec).items() if key != "control_period"):
            raise DataFormatError("names must be text")
        count = sum(name.startswith("weight_") for name in arrays)
        weights, biases = (
            tuple(arrays[f"{part}_{number}"].astype(np.float32) for number in range(count))
            for part in ("weight", "bias")
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
    except HandoverError as error:
        raise DataFormatError(f"{path}: {error}") from error
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(
            f"{path}: not a policy file of handover_marl, or damaged ({shorten_text(error)}); copy it again, or give a "
            "file of handover_marl.export_policy or of a training script"
        ) from error
