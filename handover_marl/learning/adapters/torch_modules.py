"""Conversion of PyTorch modules of linear layers to networks of policy files."""

import itertools
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.geometry.arrays import use_default_torch_settings
from handover_marl.learning.policy_spec import ACTIVATIONS, DenseNetwork

# Number and scale of the random inputs on which a converted network is compared with its module.
_N_TRIALS, _SCALE, _TOLERANCE = 8, 2.0, 1e-4


def dense_network_from_module(module: Any, activation: str | None = None) -> DenseNetwork:
    """Convert a PyTorch module of linear layers, in the order of registration, to a `DenseNetwork`.

    Outputs for random inputs are compared, which also finds the activation after the last layer.

    Args:
        module: Module from (n, n_inputs) to (n, n_outputs).
        activation: Activation between the layers; None finds it too.

    Raises:
        DataFormatError: The shapes of consecutive layers do not match, or no network of linear layers and one
            activation, or that with `activation`, has the same outputs.
    """
    bare = dense_network_from_layers(module, "identity" if activation is None else activation)
    inputs, expected = _evaluate(module, bare.n_inputs)
    candidates = ACTIVATIONS if activation is None else (activation,)
    # Identity first: for small outputs, as of networks at the start of a training, tanh is nearly the same.
    for between, after in itertools.product(candidates, ("identity", *ACTIVATIONS)):
        network = replace(bare, activation=between, output=after)
        found = np.stack([network(row) for row in inputs])
        if found.shape == expected.shape and np.allclose(found, expected, rtol=_TOLERANCE, atol=_TOLERANCE):
            return network
    raise DataFormatError(
        f"{type(module).__name__} must consist of linear layers with one activation between them "
        f"({', '.join(candidates)}); run other modules with handover_marl.as_receiver or handover_marl.as_giver"
    )


def dense_network_from_layers(
    module: Any, activation: str, output: str = "identity", n_outputs: int | None = None
) -> DenseNetwork:
    """Return a `DenseNetwork` of a PyTorch module's linear layers, in the order of registration.

    The module is not called, so that it may have inputs and outputs of any types; its outputs are not compared.

    Args:
        module: Module with linear layers.
        activation: Activation between the layers.
        output: Activation after the last layer.
        n_outputs: Number of leading outputs to keep, such as the means before standard deviations; None keeps all.

    Raises:
        DataFormatError: The shapes of consecutive layers do not match.
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


def _array(tensor: Any) -> npt.NDArray[np.float32]:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


def _evaluate(module: Any, n_inputs: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    torch, was_training = sys.modules["torch"], module.training
    values = (_SCALE * np.random.default_rng(0).standard_normal((_N_TRIALS, n_inputs))).astype(np.float32)
    parameter = next(module.parameters())
    try:
        with use_default_torch_settings(), torch.no_grad():
            outputs = module.eval()(torch.from_numpy(values).to(parameter))
    except Exception as error:  # code of the user
        raise DataFormatError(
            f"{type(module).__name__} must accept inputs of shape (n, {n_inputs}) ({type(error).__name__}: {error})"
        ) from error
    finally:
        module.train(was_training)
    if not isinstance(outputs, torch.Tensor):
        raise DataFormatError(f"{type(module).__name__} must return a tensor, got {type(outputs).__name__}")
    return values, outputs.float().cpu().numpy()
