"""Conversion of trained networks to `DenseNetwork`, the network of policy files, and their export."""

import itertools
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, OptionError
from handover_marl.geometry.arrays import use_default_torch_settings
from handover_marl.learning.custom_encodings import is_reference
from handover_marl.learning.encodings import count_features, count_outputs
from handover_marl.learning.policy_files import ACTIVATIONS, DenseNetwork, complete_spec, write_policy

Array = npt.NDArray[np.float32]
_TOLERANCE = 1e-4


def dense_network_from_layers(
    module: Any, activation: str, output: str = "identity", n_outputs: int | None = None
) -> DenseNetwork:
    """Return a `DenseNetwork` of a PyTorch module's linear layers, in the order of registration.

    The module is not called, so that it may have any inputs and outputs; the network is not compared with it.

    Args:
        module: Module with linear layers.
        activation: Activation between the layers, a key of `ACTIVATIONS`.
        output: Activation after the last layer, a key of `ACTIVATIONS`.
        n_outputs: Number of leading outputs to keep, such as the means before standard deviations; None keeps all.
    """
    linear = sys.modules["torch"].nn.Linear  # a module can exist only if PyTorch was imported
    layers = [part for part in module.modules() if isinstance(part, linear)]
    weights = [_array(layer.weight) for layer in layers]
    biases = [
        np.zeros(len(weight), dtype=np.float32) if layer.bias is None else _array(layer.bias)
        for layer, weight in zip(layers, weights, strict=True)
    ]
    if n_outputs is not None:
        weights[-1], biases[-1] = weights[-1][:n_outputs], biases[-1][:n_outputs]
    return DenseNetwork(tuple(weights), tuple(biases), activation, output)


def _array(tensor: Any) -> Array:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


def dense_network_from_module(module: Any) -> DenseNetwork:
    """Convert a PyTorch module of linear layers, in the order of registration, to a `DenseNetwork`.

    The activations, one between the layers and one after the last, are found by comparison on pseudo-random inputs.
    Raises DataFormatError if no activations give the module's outputs, or if the module fails.

    Args:
        module: Module from (n, n_inputs) to (n, n_outputs).
    """
    bare = dense_network_from_layers(module, "identity")
    inputs = draw_inputs(bare.n_inputs)
    expected = _evaluate(module, inputs)
    # Identity first: for small outputs, as of networks at the start of a training, tanh is nearly the same.
    for between, after in itertools.product(ACTIVATIONS, ("identity", *ACTIVATIONS)):
        network = replace(bare, activation=between, output=after)
        if is_close(network, inputs, expected):
            return network
    raise DataFormatError(
        f"{type(module).__name__} must consist of linear layers with one activation between them "
        f"({', '.join(ACTIVATIONS)}); run other modules with handover_marl.as_receiver or handover_marl.as_giver"
    )


def draw_inputs(count: int) -> Array:
    """Draw 8 random inputs (8, `count`), always the same, on which a converted network is compared with its module."""
    return (2.0 * np.random.default_rng(0).standard_normal((8, count))).astype(np.float32)


def is_close(network: DenseNetwork, inputs: Array, expected: Array) -> bool:
    """Return whether a network maps inputs (n, n_inputs) to the expected outputs (n, n_outputs), up to rounding."""
    found = network(inputs)
    return found.shape == expected.shape and np.allclose(found, expected, rtol=_TOLERANCE, atol=_TOLERANCE)


def _evaluate(module: Any, inputs: Array) -> Array:
    torch, was_training = sys.modules["torch"], module.training
    parameter = next(module.parameters())
    try:
        with use_default_torch_settings(), torch.no_grad():
            outputs: Array = module.eval()(torch.from_numpy(inputs).to(parameter)).float().cpu().numpy()
    except Exception as error:  # code of the user
        raise DataFormatError(
            f"{type(module).__name__} must return a tensor for inputs of shape (n, {inputs.shape[1]}) "
            f"({type(error).__name__}: {error})"
        ) from error
    finally:
        module.train(was_training)
    return outputs


def export_policy(
    model: Any,
    path: str | os.PathLike[str],
    *,
    agent: str | None = None,
    features: str | None = None,
    action_scheme: str | None = None,
    control_period: float | None = None,
    normalization: Any = None,
    origin: str = "",
) -> Path:
    """Write a trained network to a policy file (.npz), which `learned:FILE` loads without PyTorch.

    A file contains weights and the encoding, and no code. Before it is written, the network is compared with
    the model on pseudo-random inputs.

    Args:
        model: Model of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG) with dense layers; or PyTorch module of
            linear layers with one activation between them.
        path: File to write; its suffix is .npz.
        agent: Agent that the policy controls, "giver" or "receiver"; default: as in training.
        features: Name of the features that are the inputs, or `module:name`; default: as in training.
        action_scheme: Name of the action scheme that decodes the outputs, or `module:name`; default: as in training.
        control_period: Time between two decisions (s); default: as in training if that is recorded, else 0.1 s.
        normalization: Normalization of the inputs: a `VecNormalize` of Stable-Baselines3 or an
            `InputNormalization`; default: the normalization in the model's environment, or none.
        origin: Description of the training, for human readers.

    Models of Stable-Baselines3 record agent, features, action scheme and control period. For a PyTorch
    module the first three must be passed.

    Returns:
        Path of the file.

    Raises:
        OptionError: An argument is missing or contradicts the training.
        UnknownNameError: There is no such agent, or it has no such features or action scheme.
        DataFormatError: The model contains other layers, or its sizes do not fit the encoding.
        ResultsError: The file cannot be written.
    """
    file, recorded = Path(path).expanduser(), {}
    if is_sb3_model(model):
        # Imports Stable-Baselines3, which made the model.
        from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3, get_recorded_encoding

        recorded, network = get_recorded_encoding(model), dense_network_from_sb3(model, normalization)
    else:
        torch = sys.modules.get("torch")  # a module can exist only if PyTorch was imported
        if torch is None or not isinstance(model, torch.nn.Module):
            raise OptionError(
                f"model must be a model of Stable-Baselines3 or a PyTorch module, got {type(model).__name__}"
            )
        network = replace(dense_network_from_module(model), normalization=normalization)
    overrides = {"features": features, "actions": action_scheme, "control_period": control_period, "origin": origin}
    spec = complete_spec("model", agent, recorded, overrides)
    for value in (spec.features, spec.actions):
        if not isinstance(value, str):
            raise OptionError(f"features and action_scheme must be names or text module:name, got {value!r}")
    n_inputs = network.n_inputs if is_reference(spec.features) else count_features(spec.agent, spec.features)
    n_outputs = network.n_outputs if is_reference(spec.actions) else count_outputs(spec.agent, spec.actions)
    if (network.n_inputs, network.n_outputs) != (n_inputs, n_outputs):
        raise DataFormatError(
            f"the model must have {n_inputs} inputs for features {spec.features!r} and {n_outputs} outputs for action "
            f"scheme {spec.actions!r}, got {network.n_inputs} and {network.n_outputs}"
        )
    write_policy(file, spec, network)
    return file


def is_sb3_model(model: object) -> bool:
    """Return whether an object is a model of Stable-Baselines3."""
    # A model can exist only if the package was imported.
    module = sys.modules.get("stable_baselines3.common.base_class")
    return module is not None and isinstance(model, module.BaseAlgorithm)
