"""Grasp prediction from point clouds by a neural network, which needs PyTorch."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.panda import PAD_DISTANCE

Array = npt.NDArray[np.float64]

#: Numbers of object points and of hand points in the input of the network.
N_OBJECT_POINTS, N_HAND_POINTS = 256, 64
# Number of object points at which the network predicts a grasp.
_N_GRASPS = 96


@dataclass(frozen=True, eq=False)
class GraspPrediction:
    """Grasps predicted from one point cloud, in the hand link's frame.

    Attributes:
        grasps: (C, 7) poses of the hand link at the predicted grasps, xyz (m) and quaternion xyzw.
        quality: (C,) predicted quality of each grasp, 0 to 1.
        center: (3,) predicted center of the object (m).
    """

    grasps: Array
    quality: Array
    center: Array


#: Function that predicts grasps from four arguments: object points (n, 3), points of the person's hand (m, 3) and the
#: object's velocity (3,), in the hand link's frame (m, m/s), and a random generator.
GraspPredictor = Callable[[Array, Array, Array, np.random.Generator], GraspPrediction]


def load_grasp_predictor(weights: str | Path) -> tuple[GraspPredictor, str]:
    """Load the grasp predictor in the weight file of a `GraspNetwork`; return it with a short hash of its weights."""
    # Imported here since PyTorch is optional, and slow to import.
    import torch

    from handover_marl.learning.networks.grasp_network import GraspNetwork, PointCloudBatch
    from handover_marl.learning.networks.weights import read_network_weights, single_threaded_inference

    network, fingerprint = read_network_weights(weights, GraspNetwork)

    def predict(object_points: Array, hand_points: Array, velocity: Array, rng: np.random.Generator) -> GraspPrediction:
        objects, hands, n_hands = sample_points(object_points, hand_points, rng)
        centers, mask = rng.permutation(N_OBJECT_POINTS)[:_N_GRASPS], np.arange(N_HAND_POINTS) < n_hands
        inputs = (objects.astype(np.float32), hands.astype(np.float32), mask, centers, velocity.astype(np.float32))
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


def sample_points(
    object_points: npt.NDArray[np.floating], hand_points: npt.NDArray[np.floating], rng: np.random.Generator
) -> tuple[npt.NDArray[np.floating], Array, int]:
    """Draw 256 of n object points, repeated if n is smaller, and at most 64 of m points of the person's hand.

    Returns:
        Points (256, 3) of the object, points (64, 3) of the hand, padded with zeros, and the number of the hand's
        points.
    """
    repeat = len(object_points) < N_OBJECT_POINTS
    objects = object_points[rng.choice(len(object_points), N_OBJECT_POINTS, replace=repeat)]
    hands, count = np.zeros((N_HAND_POINTS, 3)), min(len(hand_points), N_HAND_POINTS)
    hands[:count] = hand_points[rng.choice(len(hand_points), count, replace=False)]
    return objects, hands, count
