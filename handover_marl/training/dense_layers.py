"""Small networks in PyTorch, and what they learned as the policy files' own."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from handover_marl.envs.homogeneous import HomogeneousEnv
from handover_marl.learning.network import Network


def mlp(n_inputs: int, n_outputs: int, width: int = 64, gain: float = 1.0) -> nn.Sequential:
    """Two hidden layers with tanh, orthogonal at first; a small `gain` makes the first outputs nearly zero."""
    parts = [nn.Linear(n_inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, n_outputs)]
    for part in parts:
        if isinstance(part, nn.Linear):
            nn.init.orthogonal_(part.weight, gain if part is parts[-1] else np.sqrt(2.0))
            nn.init.zeros_(part.bias)
    return nn.Sequential(*parts)


def dense_layers(module: nn.Module, output: str = "identity", n_outputs: int | None = None) -> Network:
    """The network that a module's linear layers make, tanh between them.

    Args:
        module: It applies its linear layers one after the other, in the order in which it holds them.
        output: Activation after the last layer, "identity" or "tanh".
        n_outputs: Only the first so many outputs, such as means that spreads follow; None: all.

    Raises:
        DataFormatError: Its layers do not fit one after the other.
    """
    dense = [part for part in module.modules() if isinstance(part, nn.Linear)]
    weights, biases = _arrays(part.weight for part in dense), _arrays(part.bias for part in dense)
    return Network((*weights[:-1], weights[-1][:n_outputs]), (*biases[:-1], biases[-1][:n_outputs]), "tanh", output)


def own_part(network: Network, env: HomogeneousEnv, agent: str) -> Network:
    """One agent's policy out of a network that all agents share: the same outputs for its own vectors alone.

    Args:
        network: From observations that all agents have to actions that all have.
        env: Where it learned.
        agent: Whose part.
    """
    seen, done = env.sizes(agent)
    first = network.weights[0]
    # Who one is does not change: it is a part of the bias. Padding is zero.
    hot = first[:, env.possible_agents.index(agent) - len(env.possible_agents)]
    weights = [first[:, :seen], *network.weights[1:]]
    biases = [network.biases[0] + hot, *network.biases[1:]]
    weights[-1], biases[-1] = weights[-1][:done], biases[-1][:done]
    return replace(network, weights=tuple(weights), biases=tuple(biases))


def _arrays(tensors: Iterable[torch.Tensor]) -> tuple[npt.NDArray[np.float32], ...]:
    return tuple(np.array(tensor.detach().cpu().numpy(), dtype=np.float32) for tensor in tensors)
