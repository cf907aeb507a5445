"""Reader of policy files of Stable-Baselines3.

Such a file is a zip of weights and JSON with embedded pickles. The pickles are not loaded: the
network is built from names and shapes of the weights.
"""

import io
import json
import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.spaces import giver_action_space, receiver_action_space
from handover_marl.errors import DataFormatError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import MAX_FILE_BYTES, check_archive
from handover_marl.learning.adapters.torch_script import import_torch
from handover_marl.learning.encodings.choices import is_reference
from handover_marl.learning.features import count_features, list_features
from handover_marl.learning.policy_spec import DenseNetwork, OutputBounds, PolicyFunction
from handover_marl.learning.schemes import list_schemes
from handover_marl.learning.training_record import Sb3TrainingRecord, read_training_record

Array = npt.NDArray[np.float32]

#: Activation functions of policy files by the name of PyTorch's class, with its default parameters.
TORCH_ACTIVATIONS = {
    "Tanh": "tanh",
    "ReLU": "relu",
    "Identity": "identity",
    "ELU": "elu",
    "LeakyReLU": "leaky_relu",
    "SiLU": "silu",
    "Sigmoid": "sigmoid",
}
_WEIGHTS, _ABOUT = "policy.pth", "data"
_MAX_WEIGHTS = 100_000_000
_SPACES = {"giver": giver_action_space, "receiver": receiver_action_space}
# Prefix of hidden layers, last layer, default activation, whether outputs are squashed by tanh:
# on-policy methods, SAC, TD3 and DDPG.
_FAMILIES = (
    ("mlp_extractor.policy_net.", "action_net", "tanh", False),
    ("actor.latent_pi.", "actor.mu", "relu", True),
    ("actor.mu.", "", "relu", True),
)


@dataclass(frozen=True, eq=False)
class Sb3Policy:
    """Policy from a file of Stable-Baselines3.

    Attributes:
        function: Function from inputs to outputs.
        control_period: Time between two decisions in training (s), or None if not recorded.
        encoding: Names of features and action scheme that the file records, or None.
    """

    function: PolicyFunction
    control_period: float | None = None
    encoding: tuple[str, str] | None = None


def read_stable_baselines(
    path: Path, content: bytes, agent: str, encoding: tuple[object, object] | None = None
) -> Sb3Policy:
    """Read the deterministic policy of a Stable-Baselines3 file (PPO, A2C, SAC, TD3 or DDPG).

    Args:
        path: File, for error messages.
        content: Content of the file.
        agent: Agent that the policy must control.
        encoding: Features and action scheme of the training; default: those that the file records,
            else the flat observation and the action in physical units. Numbers of inputs and outputs
            are checked by default only.

    Raises:
        UnsafeFileError: The weights contain other Python objects.
        DataFormatError: The file is damaged, the network is not dense, or the policy was trained
            on other, normalized or rescaled spaces.
        OptionError: PyTorch is not installed.
    """
    state, metadata = _read_zip(path, content)
    network, squashed = dense_network_from_state(state, metadata, str(path))
    record = _read_record(path, metadata)
    recorded = _get_recorded_encoding(path, record, agent) if encoding is None else None
    chosen = encoding or recorded
    space = _SPACES[agent]()
    if chosen is None:
        _check_raw_sizes(path, agent, network)
    elif chosen[1] != agent:  # the scheme of actions in physical units has the name of the agent
        space = spaces.Box(-1.0, 1.0, (network.n_outputs,), np.float32)
    _check_record(path, record, agent, space)
    bounds = OutputBounds(space.low.astype(np.float32), space.high.astype(np.float32), is_scaled=squashed)
    network = replace(network, output="tanh" if squashed else network.output, bounds=bounds)
    return Sb3Policy(network, record.control_period, recorded)


def _check_raw_sizes(path: Path, agent: str, network: DenseNetwork) -> None:
    sizes = count_features(agent, f"flat_{agent}"), _SPACES[agent]().shape[0]
    if (network.n_inputs, network.n_outputs) != sizes:
        raise DataFormatError(
            f"{path}: a {agent}'s policy must have {sizes[0]} inputs and {sizes[1]} outputs, got {network.n_inputs} "
            f"and {network.n_outputs}; pass features and action scheme of its training to handover_marl.as_{agent}"
        )


def dense_network_from_state(
    state: Mapping[str, Array], metadata: Mapping[str, Any], where: str
) -> tuple[DenseNetwork, bool]:
    """Build the deterministic policy from the weights of a Stable-Baselines3 model.

    Args:
        state: Weights of the model's policy by name.
        metadata: JSON of the model, with `policy_kwargs` as text.
        where: Name of the model in error messages.

    Returns:
        The network, and whether its outputs have to be squashed by tanh.

    Raises:
        DataFormatError: The policy contains layers that are not dense.
    """
    if any(key.startswith(("features_extractor.", "actor.features_extractor.")) for key in state):
        raise DataFormatError(f"{where}: features extractors with weights are not supported")
    for hidden, last, default, squashed in _FAMILIES:
        layers = _collect_layers(state, hidden, last)
        if layers:
            weights, biases = zip(*layers, strict=True)
            try:
                return DenseNetwork(weights, biases, _parse_activation(metadata) or default), squashed
            except DataFormatError as error:
                raise DataFormatError(f"{where}: {error}") from error
    raise DataFormatError(f"{where}: no dense policy of PPO, A2C, SAC, TD3 or DDPG found")


def _get_recorded_encoding(path: Path, record: Sb3TrainingRecord, agent: str) -> tuple[str, str] | None:
    if record.encoding is None:
        return None
    owner, features, actions = record.encoding
    if owner != agent:
        raise DataFormatError(f"{path}: policy must be for the {agent}, got one for the {owner}")
    known = (features, list_features(agent)), (actions, list_schemes(agent))
    own = [name for name, names in known if name not in names and not is_reference(name)]
    if own:
        raise DataFormatError(
            f"{path}: the policy was trained with {own[0]!r}, which is not in this library; pass its features and "
            f"action scheme to handover_marl.as_{agent}, or train with their names as text, 'module:name', and read "
            "the file with trust=True (--trust)"
        )
    return features, actions


def _read_zip(path: Path, content: bytes) -> tuple[dict[str, Array], dict[str, Any]]:
    import_torch()
    # Imports PyTorch, too.
    from handover_marl.learning.networks.weights import load_tensors

    try:
        check_archive(content, MAX_FILE_BYTES)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            metadata = json.loads(archive.read(_ABOUT), parse_constant=float)
            state = load_tensors(archive.read(_WEIGHTS))
        # Tensors may repeat the few numbers that are stored.
        if sum(value.numel() for value in state.values()) > _MAX_WEIGHTS:
            raise ValueError(f"it has more than {_MAX_WEIGHTS} weights")
        arrays = {str(name): np.asarray(value.numpy(), dtype=np.float32) for name, value in state.items()}
    except pickle.UnpicklingError as error:
        raise UnsafeFileError(f"{path}: {_WEIGHTS} holds more than weights and was not loaded") from error
    except Exception as error:  # Damaged archives, JSON and tensors raise exceptions of many types.
        raise DataFormatError(f"{path}: not a policy file of Stable-Baselines3 ({shorten_text(error)})") from error
    return arrays, metadata if isinstance(metadata, dict) else {}


def _read_record(path: Path, metadata: Mapping[str, Any]) -> Sb3TrainingRecord:
    try:
        return read_training_record(metadata)
    except Exception as error:  # arrays of any shape and type
        raise DataFormatError(f"{path}: not a record of a training ({shorten_text(error)})") from error


def _check_record(path: Path, record: Sb3TrainingRecord, agent: str, space: spaces.Box) -> None:
    try:
        record.check(path, agent, space)
    except DataFormatError:
        raise
    except Exception as error:  # arrays of any shape and type
        raise DataFormatError(f"{path}: not a record of a training ({shorten_text(error)})") from error


def _collect_layers(state: Mapping[str, Array], hidden: str, last: str) -> list[tuple[Array, Array]]:
    """Return weights and biases of hidden and last layers; [] if a layer is missing."""
    pattern = re.compile(re.escape(hidden) + r"(\d+)\.(?:.*\.)?weight")
    numbers = sorted(int(match[1]) for name in state if (match := pattern.fullmatch(name)))
    names = [f"{hidden}{number}" for number in numbers] + ([last] if last else [])
    if not all(f"{name}.weight" in state and f"{name}.bias" in state for name in names):
        return []
    return [(state[f"{name}.weight"], state[f"{name}.bias"]) for name in names]


def _parse_activation(metadata: Mapping[str, Any]) -> str | None:
    """Return the activation that the model's JSON records, or None for the default activation.

    Raises:
        DataFormatError: `DenseNetwork` does not support the activation.
    """
    arguments = metadata.get("policy_kwargs")
    named = arguments.get("activation_fn") if isinstance(arguments, dict) else None
    if named is None:
        return None
    # Stable-Baselines3 writes "<class 'torch.nn.modules.activation.ReLU'>".
    words = re.findall(r"\w+", str(named))
    activation = TORCH_ACTIVATIONS.get(words[-1] if words else "")
    if activation is None:
        raise DataFormatError(f"activation must be one of {', '.join(TORCH_ACTIVATIONS)}, got {named}")
    return activation
