"""Grasp prediction from point clouds by a neural network, which needs PyTorch."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig
from handover_marl.geometry.panda import PAD_DISTANCE

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GraspPrediction:
    """Grasps predicted from one point cloud, in the hand link's frame.

    Attributes:
        grasps: (C, 7) poses of the hand link at the predicted grasps.
        quality: (C,) predicted quality of each grasp, 0 to 1.
        center: (3,) predicted center of the object (m).
    """

    grasps: Array
    quality: Array
    center: Array


#: Function from points of the object (n, 3) and of the person's hand (m, 3) in the hand link's frame
#: (m), the object's velocity (3,) in that frame (m/s) and a random generator to a prediction.
GraspPredictor = Callable[[Array, Array, Array, np.random.Generator], GraspPrediction]


@dataclass(frozen=True)
class GraspPredictorConfig(CheckedConfig):
    """Numbers of points in the input of the grasp network.

    Attributes:
        n_object_points: Number of points of the object.
        n_hand_points: Number of points of the person's hand.
        n_grasps: Number of object points at which a grasp is predicted.
    """

    default_limits: ClassVar[tuple[float, float]] = (1, math.inf)

    n_object_points: int = 256
    n_hand_points: int = 64
    n_grasps: int = 96


def load_grasp_predictor(weights: str | Path, config: GraspPredictorConfig | None = None) -> tuple[GraspPredictor, str]:
    """Load the grasp predictor in the weight file of a `GraspNetwork`; return it with a short hash of its weights.

    Raises:
        DataNotFoundError, DataFormatError: The file does not exist, is damaged or holds another network.
    """
    # Imported here since PyTorch is optional, and slow to import.
    import torch

    from handover_marl.learning.networks.grasp_network import GraspNetwork, PointCloudBatch
    from handover_marl.learning.networks.weights import read_network_weights, single_threaded_inference

    trained, fingerprint = read_network_weights(weights, GraspNetwork)
    network, counts = trained.eval(), config or GraspPredictorConfig()

    def predict(object_points: Array, hand_points: Array, velocity: Array, rng: np.random.Generator) -> GraspPrediction:
        inputs = (*_sample_points(object_points, hand_points, counts, rng), velocity.astype(np.float32))
        with single_threaded_inference():
            output = network(PointCloudBatch(*(torch.from_numpy(value)[None] for value in inputs)))
        rotations = output.rotations[0].numpy().astype(np.float64)
        positions = output.positions[0].numpy().astype(np.float64) - PAD_DISTANCE * rotations[:, :, 2]
        return GraspPrediction(
            np.concatenate([positions, Rotation.from_matrix(rotations).as_quat()], axis=1),
            output.quality[0].sigmoid().numpy().astype(np.float64),
            output.object_center[0].numpy().astype(np.float64),
        )

    return predict, fingerprint


def _sample_points(
    object_points: Array, hand_points: Array, config: GraspPredictorConfig, rng: np.random.Generator
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], npt.NDArray[np.int_]]:
    """Return object points, hand points, the mask of valid hand points, and grasp indices."""
    n_object, n_hand = config.n_object_points, config.n_hand_points
    objects = object_points[rng.choice(len(object_points), n_object, replace=len(object_points) < n_object)]
    hands, count = np.zeros((n_hand, 3)), min(len(hand_points), n_hand)
    hands[:count] = hand_points[rng.choice(len(hand_points), count, replace=False)]
    centers = rng.permutation(n_object)[: config.n_grasps]
    return objects.astype(np.float32), hands.astype(np.float32), np.arange(n_hand) < count, centers
