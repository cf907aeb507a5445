"""Conversion of PyTorch modules with linear layers to `DenseNetwork`, the network of policy files."""

import itertools
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.geometry.arrays import use_default_torch_settings
from handover_marl.learning.policy_files import ACTIVATIONS, DenseNetwork

Array = npt.NDArray[np.float32]
_TOLERANCE = 1e-4


def dense_network_from_layers(
    module: Any, activation: str, output: str = "identity", n_outputs: int | None = None
) -> DenseNetwork:
    """Return a `DenseNetwork` with the linear layers of a PyTorch module, in the order of registration.

    The module is not evaluated, so that it may have any inputs and outputs; nothing checks that the outputs are equal.

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

    The activation between all layers and the one after the last are found by comparison on pseudo-random inputs.

    Args:
        module: Module from (n, n_inputs) to (n, n_outputs).

    Raises:
        DataFormatError: No activations give the module's outputs, or the module fails.
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
    """Draw 8 input vectors (8, `count`) by a fixed seed, on which a converted network is compared with its source."""
    return (2.0 * np.random.default_rng(0).standard_normal((8, count))).astype(np.float32)


def is_close(network: DenseNetwork, inputs: Array, expected: Array) -> bool:
    """Return whether a network maps inputs (n, n_inputs) to the expected outputs (n, n_outputs), within 1e-4."""
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
