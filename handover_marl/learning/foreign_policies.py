"""Reader of policy files of Stable-Baselines3 and TorchScript.

A Stable-Baselines3 file is a zip of weights and JSON with embedded pickles. The pickles are not
loaded: the network is built from names and shapes of the weights. TorchScript is code.
"""

import io
import json
import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from handover_marl.episode.spaces import giver_action_space, receiver_action_space
from handover_marl.errors import DataFormatError, OptionError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import MAX_FILE_BYTES, check_archive
from handover_marl.learning.features import n_features
from handover_marl.learning.policy_spec import DenseNetwork, PolicyFunction
from handover_marl.learning.training_record import Sb3TrainingRecord, read_training_record

Array = npt.NDArray[np.float32]

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


class BoundedNetwork:
    """Network whose outputs are mapped to an action space as in Stable-Baselines3's `predict`.

    Args:
        network: Network from flat observations to outputs.
        space: Action space.
        squashed: Whether outputs in [-1, 1] are scaled to the bounds (SAC, TD3, DDPG) rather than
            clipped to them (PPO, A2C).
    """

    def __init__(self, network: DenseNetwork, space: spaces.Box, squashed: bool) -> None:
        self._network, self._low, self._high, self._squashed = network, space.low, space.high, squashed
        self.n_inputs, self.n_outputs = network.n_inputs, network.n_outputs

    def __call__(self, inputs: Array) -> Array:
        """Return the action (n_outputs,) within the bounds."""
        if not self._squashed:
            return np.clip(self._network(inputs), self._low, self._high)
        shares = (self._network(inputs) + np.float32(1.0)) / np.float32(2.0)
        return np.asarray(self._low + shares * (self._high - self._low), dtype=np.float32)


class TorchScriptFunction:
    """TorchScript module that is evaluated for one observation at a time.

    Args:
        module: Loaded module from (1, n_inputs) to (1, n_outputs).
        n_inputs: Length of a flat observation.
        n_outputs: Length of an action.
    """

    def __init__(self, module: Any, n_inputs: int, n_outputs: int) -> None:
        self._module, self.n_inputs, self.n_outputs = module, n_inputs, n_outputs

    def __call__(self, inputs: Array) -> Array:
        """Return the action (n_outputs,) for a flat observation (n_inputs,)."""
        torch = _import_torch()
        with torch.no_grad():
            return np.asarray(self._module(torch.from_numpy(inputs)[None])[0].numpy(), dtype=np.float32)


def read_stable_baselines(path: Path, content: bytes, agent: str) -> tuple[PolicyFunction, float | None]:
    """Read the deterministic policy of a Stable-Baselines3 file (PPO, A2C, SAC, TD3 or DDPG).

    Returns:
        The policy, and its control period in training (s) if the file records it.

    Raises:
        UnsafeFileError: The weights contain other Python objects.
        DataFormatError: The file is damaged, the network is not dense, or the policy was trained
            on encoded, normalized or rescaled spaces.
        OptionError: PyTorch is not installed.
    """
    state, about = _read_zip(path, content)
    network, squashed = dense_network_from_state(state, about, str(path))
    space = _SPACES[agent]()
    sizes = n_features(agent, f"flat_{agent}"), space.shape[0]
    if (network.n_inputs, network.n_outputs) != sizes:
        raise DataFormatError(
            f"{path}: a {agent}'s policy must have {sizes[0]} inputs and {sizes[1]} outputs, got {network.n_inputs} "
            f"and {network.n_outputs}; export one trained on an encoded environment as .npz"
        )
    record = _read_record(path, about, agent, space)
    network = replace(network, output="tanh") if squashed else network
    return BoundedNetwork(network, space, squashed), record.control_period


def dense_network_from_state(
    state: Mapping[str, Array], about: Mapping[str, Any], where: str
) -> tuple[DenseNetwork, bool]:
    """Build the deterministic policy from the weights of a Stable-Baselines3 model.

    Args:
        state: Weights of the model's policy by name.
        about: JSON of the model, with `policy_kwargs` as text.
        where: Name of the model in error messages.

    Returns:
        The network, and whether its outputs have to be squashed by tanh.

    Raises:
        DataFormatError: The policy contains other than dense layers.
    """
    if any(key.startswith(("features_extractor.", "actor.features_extractor.")) for key in state):
        raise DataFormatError(f"{where}: features extractors with weights are not supported")
    for hidden, last, default, squashed in _FAMILIES:
        layers = _collect_layers(state, hidden, last)
        if layers:
            weights, biases = zip(*layers, strict=True)
            try:
                return DenseNetwork(weights, biases, _parse_activation(about) or default), squashed
            except DataFormatError as error:
                raise DataFormatError(f"{where}: {error}") from error
    raise DataFormatError(f"{where}: no dense policy of PPO, A2C, SAC, TD3 or DDPG found")


def read_torch_script(path: Path, content: bytes, agent: str, trust: bool) -> PolicyFunction:
    """Read a TorchScript module from (1, n) flat observations to (1, m) actions.

    Raises:
        UnsafeFileError: The file is not trusted.
        DataFormatError: The file cannot be loaded, or its spaces do not fit.
        OptionError: PyTorch is not installed.
    """
    if not trust:
        raise UnsafeFileError(
            f"{path}: a TorchScript file is code; pass trust=True (--trust) if you know where it comes from, or "
            "export the policy as .npz"
        )
    torch = _import_torch()
    n_inputs, n_outputs = n_features(agent, f"flat_{agent}"), _SPACES[agent]().shape[0]
    try:
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
        with torch.no_grad():
            shape = tuple(module(torch.zeros(1, n_inputs)).shape)
    except Exception as error:  # the file's code may raise anything
        lines = str(error).strip().splitlines() or [""]
        raise DataFormatError(
            f"{path}: not a TorchScript policy with the {agent}'s {n_inputs} inputs "
            f"({type(error).__name__}: {lines[-1]})"
        ) from error
    if shape != (1, n_outputs):
        raise DataFormatError(f"{path}: a {agent}'s action must have shape (1, {n_outputs}), got {shape}")
    return TorchScriptFunction(module, n_inputs, n_outputs)


def _read_zip(path: Path, content: bytes) -> tuple[dict[str, Array], dict[str, Any]]:
    _import_torch()
    # Imports PyTorch, too.
    from handover_marl.learning.networks.weights import load_tensors

    try:
        check_archive(content, MAX_FILE_BYTES)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            about = json.loads(archive.read(_ABOUT), parse_constant=float)
            state = load_tensors(archive.read(_WEIGHTS))
        # Tensors may repeat the few numbers that are stored.
        if sum(value.numel() for value in state.values()) > _MAX_WEIGHTS:
            raise ValueError(f"it has more than {_MAX_WEIGHTS} weights")
        arrays = {str(name): np.asarray(value.numpy(), dtype=np.float32) for name, value in state.items()}
    except pickle.UnpicklingError as error:
        raise UnsafeFileError(f"{path}: {_WEIGHTS} holds more than weights and was not loaded") from error
    except Exception as error:  # Damaged archives, JSON and tensors raise exceptions of many types.
        raise DataFormatError(f"{path}: not a policy file of Stable-Baselines3 ({shorten_text(error)})") from error
    return arrays, about if isinstance(about, dict) else {}


def _read_record(path: Path, about: Mapping[str, Any], agent: str, space: spaces.Box) -> Sb3TrainingRecord:
    try:
        record = read_training_record(about)
        record.check(path, agent, space)
    except DataFormatError:
        raise
    except Exception as error:  # arrays of any shape and type
        raise DataFormatError(f"{path}: not a record of a training ({shorten_text(error)})") from error
    return record


def _collect_layers(state: Mapping[str, Array], hidden: str, last: str) -> list[tuple[Array, Array]]:
    """Return weights and biases of hidden and last layers; [] if a layer is missing."""
    pattern = re.compile(re.escape(hidden) + r"(\d+)\.(?:.*\.)?weight")
    numbers = sorted(int(match[1]) for name in state if (match := pattern.fullmatch(name)))
    names = [f"{hidden}{number}" for number in numbers] + ([last] if last else [])
    if not all(f"{name}.weight" in state and f"{name}.bias" in state for name in names):
        return []
    return [(state[f"{name}.weight"], state[f"{name}.bias"]) for name in names]


def _parse_activation(about: Mapping[str, Any]) -> str | None:
    """Return the activation that the model's JSON records, or None for the default activation.

    Raises:
        DataFormatError: `DenseNetwork` does not support the activation.
    """
    arguments = about.get("policy_kwargs")
    named = arguments.get("activation_fn") if isinstance(arguments, dict) else None
    if named is None:
        return None
    # Stable-Baselines3 writes "<class 'torch.nn.modules.activation.ReLU'>".
    words = re.findall(r"\w+", str(named))
    activation = {"Tanh": "tanh", "ReLU": "relu"}.get(words[-1] if words else "")
    if activation is None:
        raise DataFormatError(f"activation must be Tanh or ReLU, got {named}")
    return activation


def _import_torch() -> ModuleType:
    try:
        import torch
    except ImportError as error:
        raise OptionError("this policy file needs PyTorch: pip install 'handover-marl[train]'") from error
    return torch
