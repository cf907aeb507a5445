"""Multilayer perceptrons in PyTorch, and networks that agents share."""

from dataclasses import replace

import numpy as np
from torch import nn

from handover_marl.envs.wrappers.homogeneous import HomogeneousEnv
from handover_marl.learning.policy_spec import DenseNetwork


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


def extract_agent_network(network: DenseNetwork, env: HomogeneousEnv, agent: str) -> DenseNetwork:
    """Extract one agent's policy from a network that all agents share.

    Args:
        network: Network from padded observations with an agent indicator to padded actions.
        env: Environment in which the network was trained.
        agent: Agent whose policy is extracted.

    Returns:
        The network from the agent's own observations to its own actions, with the same outputs.
    """
    n_inputs, n_outputs = env.get_sizes(agent)
    first = network.weights[0]
    # The indicator is constant, so its column is part of the bias; the padding is zero.
    indicator = first[:, env.possible_agents.index(agent) - len(env.possible_agents)]
    weights = [first[:, :n_inputs], *network.weights[1:]]
    biases = [network.biases[0] + indicator, *network.biases[1:]]
    weights[-1], biases[-1] = weights[-1][:n_outputs], biases[-1][:n_outputs]
    return replace(network, weights=tuple(weights), biases=tuple(biases))
