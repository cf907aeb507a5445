"""Policies that other libraries wrote: Stable-Baselines3 and TorchScript.

A Stable-Baselines3 file is a zip of JSON, in which Python objects stand as pickles, and of weights. The pickles
are left alone: the network is built from the weights' names and shapes. TorchScript is code; loading may run it.
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
from handover_marl.learning.network import Network
from handover_marl.learning.observing import n_features
from handover_marl.learning.policy_spec import Function
from handover_marl.learning.training_record import read_training

Array = npt.NDArray[np.float32]

_WEIGHTS, _ABOUT = "policy.pth", "data"
_SPACES = {"giver": giver_action_space, "receiver": receiver_action_space}
# Hidden layers, last layer, usual activation, whether outputs are squashed: on-policy methods, SAC, TD3 and DDPG.
_FAMILIES = (
    ("mlp_extractor.policy_net.", "action_net", "tanh", False),
    ("actor.latent_pi.", "actor.mu", "relu", True),
    ("actor.mu.", "", "relu", True),
)


class SquashedNetwork:
    """A network whose outputs, between -1 and 1, are scaled to a space's bounds (SAC, TD3, DDPG)."""

    def __init__(self, network: Network, space: spaces.Box) -> None:
        self._network, self._low, self._high = network, space.low, space.high
        self.n_inputs, self.n_outputs = network.n_inputs, network.n_outputs

    def __call__(self, inputs: Array) -> Array:
        """(n_outputs,) within the bounds."""
        shares = (self._network(inputs) + np.float32(1.0)) / np.float32(2.0)
        return np.asarray(self._low + shares * (self._high - self._low), dtype=np.float32)


class ClippedNetwork:
    """A network whose outputs are clipped to a space's bounds (PPO, A2C), in training as in `model.predict`."""

    def __init__(self, network: Network, space: spaces.Box) -> None:
        self._network, self._low, self._high = network, space.low, space.high
        self.n_inputs, self.n_outputs = network.n_inputs, network.n_outputs

    def __call__(self, inputs: Array) -> Array:
        """(n_outputs,) within the bounds."""
        return np.clip(self._network(inputs), self._low, self._high)


class ScriptedFunction:
    """A TorchScript module of one vector."""

    def __init__(self, module: Any, n_inputs: int, n_outputs: int) -> None:
        self._module, self.n_inputs, self.n_outputs = module, n_inputs, n_outputs

    def __call__(self, inputs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(n_outputs,) for (n_inputs,)."""
        torch = _torch()
        with torch.no_grad():
            return np.asarray(self._module(torch.from_numpy(inputs)[None])[0].numpy(), dtype=np.float32)


def read_stable_baselines(path: Path, content: bytes, agent: str) -> tuple[Function, float | None]:
    """The deterministic policy in a Stable-Baselines3 file (PPO, A2C, SAC, TD3, DDPG with dense layers).

    Returns:
        The policy, and the control period (s) that it was trained at, if the file says so.

    Raises:
        UnsafeFileError: Its weights come with foreign Python objects.
        DataFormatError: It is damaged, of a kind not known, or was trained on other observations or actions than
            the plain environment's: encoded, normalised or rescaled ones.
        OptionError: PyTorch is not installed.
    """
    state, about = _read_zip(path, content)
    network, squashed = dense_network(state, about, str(path))
    space = _SPACES[agent]()
    wanted = (n_features(agent, f"flat_{agent}"), space.shape[0])
    if (network.n_inputs, network.n_outputs) != wanted:
        raise DataFormatError(
            f"{path}: the policy takes {network.n_inputs} numbers and gives {network.n_outputs}, a {agent}'s "
            f"takes {wanted[0]} and gives {wanted[1]}; one trained on an encoded environment is exported as .npz"
        )
    training = read_training(path, about)
    training.check(path, agent, space)
    if squashed:
        return SquashedNetwork(replace(network, output="tanh"), space), training.control_period
    return ClippedNetwork(network, space), training.control_period


def dense_network(
    state: Mapping[str, npt.NDArray[np.float32]], about: Mapping[str, Any], where: str
) -> tuple[Network, bool]:
    """The deterministic policy among a Stable-Baselines3 model's weights.

    Args:
        state: The policy's weights by name.
        about: The model's `policy_kwargs`, classes in words.
        where: What to call it in errors.

    Returns:
        The network, and whether its outputs are to be squashed by a tanh.

    Raises:
        DataFormatError: It is not made of dense layers only.
    """
    if any(key.startswith(("features_extractor.", "actor.features_extractor.")) for key in state):
        raise DataFormatError(f"{where}: its features extractor has weights of its own, which is not supported")
    for hidden, last, usual, squashed in _FAMILIES:
        layers = _layers(state, hidden, last)
        if layers:
            weights, biases = zip(*layers, strict=True)
            return Network(weights, biases, _activation(about) or usual), squashed
    raise DataFormatError(f"{where}: no dense policy of PPO, A2C, SAC, TD3 or DDPG in it")


def read_torch_script(path: Path, content: bytes, agent: str, trust: bool) -> Function:
    """The policy in a TorchScript file: a module from (1, n) flat observations to (1, m) actions.

    Raises:
        UnsafeFileError: It is not trusted.
        DataFormatError: It cannot be loaded, or is of other spaces.
        OptionError: PyTorch is not installed.
    """
    if not trust:
        raise UnsafeFileError(
            f"{path}: a TorchScript file is code; pass trust=True (--trust) if you know where it comes from, or "
            "export the policy as .npz"
        )
    torch = _torch()
    n_inputs, n_outputs = n_features(agent, f"flat_{agent}"), _SPACES[agent]().shape[0]
    try:
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
        with torch.no_grad():
            shape = tuple(module(torch.zeros(1, n_inputs)).shape)
    except Exception as error:  # whatever the file's code raises
        raise DataFormatError(
            f"{path}: no TorchScript policy that takes the {n_inputs} numbers that a {agent} observes "
            f"({type(error).__name__}: {str(error).strip().splitlines()[-1] if str(error).strip() else ''})"
        ) from error
    if shape != (1, n_outputs):
        raise DataFormatError(f"{path}: the policy gives {shape}, a {agent}'s action is (1, {n_outputs})")
    return ScriptedFunction(module, n_inputs, n_outputs)


def _read_zip(path: Path, content: bytes) -> tuple[dict[str, npt.NDArray[np.float32]], dict[str, Any]]:
    torch = _torch()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            about = json.loads(archive.read(_ABOUT), parse_constant=float)
            state = torch.load(io.BytesIO(archive.read(_WEIGHTS)), map_location="cpu", weights_only=True)
        arrays = {str(name): np.asarray(value.numpy(), dtype=np.float32) for name, value in state.items()}
    except pickle.UnpicklingError as error:
        raise UnsafeFileError(f"{path}: {_WEIGHTS} holds more than weights and was not loaded") from error
    except Exception as error:  # damaged zips, JSON and tensors raise all kinds
        raise DataFormatError(
            f"{path}: no policy file of Stable-Baselines3 ({type(error).__name__}: {error})"
        ) from error
    return arrays, about if isinstance(about, dict) else {}


def _layers(
    state: Mapping[str, npt.NDArray[np.float32]], hidden: str, last: str
) -> list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]:
    """Weights and biases of numbered dense layers and of the last one."""
    numbers = sorted(
        int(name[len(hidden) :].split(".")[0])
        for name in state
        if name.startswith(hidden) and name.endswith(".weight") and name[len(hidden) :].split(".")[0].isdigit()
    )
    names = [f"{hidden}{number}" for number in numbers] + ([last] if last else [])
    if not all(f"{name}.weight" in state and f"{name}.bias" in state for name in names):
        return []
    return [(state[f"{name}.weight"], state[f"{name}.bias"]) for name in names]


def _activation(about: Mapping[str, Any]) -> str | None:
    """The activation that the file names in words, or None if it keeps to the usual one.

    Raises:
        DataFormatError: It is one that `Network` does not know.
    """
    arguments = about.get("policy_kwargs")
    named = arguments.get("activation_fn") if isinstance(arguments, dict) else None
    if named is None:
        return None
    # As Stable-Baselines3 writes it: "<class 'torch.nn.modules.activation.ReLU'>".
    words = re.findall(r"\w+", str(named))
    for word, activation in (("Tanh", "tanh"), ("ReLU", "relu")):
        if words and words[-1] == word:
            return activation
    raise DataFormatError(f"its activation is {named}; only Tanh and ReLU are supported")


def _torch() -> ModuleType:
    try:
        import torch
    except ImportError as error:
        raise OptionError("this policy file needs PyTorch: pip install 'handover-marl[train]'") from error
    return torch
