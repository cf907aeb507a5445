"""Multilayer perceptrons in PyTorch."""

import numpy as np
from torch import nn


def make_mlp(n_inputs: int, n_outputs: int, width: int = 64, gain: float = 1.0) -> nn.Sequential:
    """Make a network with two hidden tanh layers and orthogonal initialization.

    Args:
        n_inputs: Number of inputs.
        n_outputs: Number of outputs.
        width: Width of the hidden layers.
        gain: Gain of the last layer; a small one makes the first outputs nearly zero.
    """
    layers = [nn.Linear(n_inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, n_outputs)]
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else np.sqrt(2.0))
            nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)
