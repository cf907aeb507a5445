"""Grasps out of points by a grasp network. Needs PyTorch."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation

from handover_marl.networks.grasp_network import PADS, GraspNetwork, Views
from handover_marl.networks.one_thread import one_thread
from handover_marl.networks.own_weights import read_own_weights
from handover_marl.receivers.vision.percept import Told

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LookConfig:
    """What of a view is shown to the network: points of object and hand, and at how many points it tells grasps."""

    objects: int = 256
    hands: int = 64
    centers: int = 96


class GraspTeller:
    """Tells grasps.

    Args:
        network: What tells them.
        config: What it is shown.
    """

    def __init__(self, network: GraspNetwork, config: LookConfig | None = None) -> None:
        self._network, self._config = network.eval(), config or LookConfig()

    def __call__(self, item: Array, hand: Array, velocity: Array, rng: np.random.Generator) -> Told:
        """What is told of points of object (n, 3) and hand (m, 3), and the object's velocity (3,)."""
        config = self._config
        objects = item[rng.choice(len(item), config.objects, replace=len(item) < config.objects)]
        hands, count = np.zeros((config.hands, 3)), min(len(hand), config.hands)
        hands[:count] = hand[rng.choice(len(hand), count, replace=False)]
        seen, centers = np.arange(config.hands) < count, rng.permutation(config.objects)[: config.centers]
        values = (objects.astype(np.float32), hands.astype(np.float32), seen, centers, velocity.astype(np.float32))
        with one_thread():
            found = self._network(Views(*(torch.from_numpy(value)[None] for value in values)))
        turns = found.turns[0].numpy().astype(np.float64)
        places = found.places[0].numpy().astype(np.float64) - PADS * turns[:, :, 2]
        return Told(
            np.concatenate([places, Rotation.from_matrix(turns).as_quat()], axis=1),
            found.quality[0].sigmoid().numpy().astype(np.float64),
            found.middle[0].numpy().astype(np.float64),
        )


def grasp_teller(weights: str | Path) -> tuple[GraspTeller, str]:
    """What a file of weights tells, and a short hash of it.

    Raises:
        DataNotFoundError, DataFormatError: It cannot be read.
    """
    network, fingerprint = read_own_weights(weights, GraspNetwork)
    return GraspTeller(network), fingerprint
