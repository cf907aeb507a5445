"""Base class of the trainings of networks by imitation: optimizer, learning rates, averaged weights."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from handover_marl.learning.networks.weights import SavedNetwork

Network = TypeVar("Network", bound=SavedNetwork)
Batch = TypeVar("Batch")
_WEIGHT_DECAY = 1e-4


class Batches(Protocol):
    """Data set of samples from which random batches are drawn."""

    def sample(self, count: int, rng: np.random.Generator) -> Any:
        """Return a batch of `count` randomly drawn and augmented samples."""


class ImitationLearner(ABC, Generic[Network, Batch]):
    """Base class of trainers of a network, with AdamW as optimizer and exponentially averaged weights.

    Args:
        network: Network to train.
        updates: Number of updates of the whole training, over which the learning rate decays.
        device: Device to train on.

    Attributes:
        learning_rate: Largest learning rate of AdamW.
        final_share: Learning rate at the end of its cosine decay, as fraction of the largest.
        warmup: Number of updates at the start in which the learning rate rises.
        epsilon: Number that AdamW adds to denominators.
        max_gradient_norm: Largest norm of the gradient; longer gradients are scaled down.
        averaging: Decay of the exponential average of the weights; with 0 the weights are not averaged.
        use_bfloat16: Whether matrix products are computed in bfloat16.
        done: Number of updates so far.
        averaged: Network with the averaged weights, for use after training.
    """

    learning_rate, final_share, warmup, epsilon = 1e-3, 0.0, 1, 1e-8
    max_gradient_norm, averaging, use_bfloat16 = 5.0, 0.0, True

    def __init__(self, network: Network, updates: int, device: torch.device) -> None:
        self._updates, self._device = updates, device
        self._network = network.to(device)
        self._averages = AveragedModel(self._network, avg_fn=self._average, use_buffers=True)
        self.averaged: Network = self._averages.module.eval()  # type: ignore[assignment]
        groups = [
            {"params": list(parameters), "rate": rate} for parameters, rate in self.list_parameter_groups(network)
        ]
        self._optimizer = torch.optim.AdamW(groups, lr=self.learning_rate, weight_decay=_WEIGHT_DECAY, eps=self.epsilon)
        self.done = 0

    @abstractmethod
    def compute_losses(self, network: Network, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a network to minimize, and its losses to report by name, for a batch on any device."""

    @abstractmethod
    def evaluate(self, held_out: Any) -> dict[str, float]:
        """Return metrics by name of the network with averaged weights, on held-out samples."""

    def list_parameter_groups(self, network: Network) -> list[tuple[Iterable[nn.Parameter], float]]:
        """Return groups of the network's parameters, each with its largest learning rate; by default one group."""
        return [(network.parameters(), self.learning_rate)]

    def update(self, batch: Batch) -> dict[str, float]:
        """Update the network by one gradient step on a batch; return the losses before the update, by name."""
        self._network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = group["rate"] * self._compute_rate_share()
        loss, losses = self.compute_losses(self._network, batch)
        self._optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), self.max_gradient_norm)
        self._optimizer.step()
        self.done += 1
        self._averages.update_parameters(self._network)
        return {name: float(value.detach()) for name, value in losses.items()}

    def get_state(self) -> dict[str, Any]:
        """Return a dict with weights, averaged weights, optimizer state and number of updates, for a checkpoint."""
        return {
            "done": self.done,
            "network": self._network.state_dict(),
            "averaged": self._averages.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore weights, averaged weights, optimizer state and number of updates from a dict of `get_state`."""
        self._network.load_state_dict(state["network"])
        self._averages.load_state_dict(state["averaged"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.done = int(state["done"])

    def _compute_rate_share(self) -> float:
        """Return the present learning rates as fraction of the largest ones."""
        rise = min(1.0, (self.done + 1) / max(1, self.warmup))
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.done / max(1, self._updates))))
        return rise * (self.final_share + (1.0 - self.final_share) * fall)

    def _average(self, averaged: Tensor, current: Tensor, _: Tensor | int) -> Tensor:
        """Return the new average of a parameter or buffer, from its last average and its present value."""
        # Averages over few updates at first, so that the initial weights are soon forgotten.
        decay = min(self.averaging, (1.0 + self.done) / (10.0 + self.done))
        return decay * averaged + (1.0 - decay) * current
