"""Segmentation of wrist camera images by a neural network, which needs PyTorch, and segmented point clouds."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.camera_observations import CLOUDS, N_POINTS
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import DEPTH, POINT_MAP, RGB
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Array = npt.NDArray[np.float64]

#: Observation mode of a receiver that segments the images itself.
UNSEGMENTED = f"{RGB}+{DEPTH}+{POINT_MAP}"
#: Labels of the classes of `SegmentationNetwork`; robot and table are background.
CLASS_LABELS = np.array(
    [
        SegmentationLabel.BACKGROUND,
        SegmentationLabel.TARGET,
        SegmentationLabel.OTHER_OBJECT,
        SegmentationLabel.HAND,
    ],
    dtype=np.uint8,
)
# Reduction of the hand's logits: without it, the network takes too much of the object for the hand, and the receiver
# avoids grasps there. Chosen on held-out scenes of s0 train.
_HAND_REDUCTION = 2.0
# Largest distance of a point of the object from their median (m); points beyond it are wrongly segmented.
_MAX_OBJECT_RADIUS = 0.2
# Lower and upper corner of the volume of a finger of the open gripper, in the hand link's frame with |y| (m), with a
# margin for errors of the camera's pose; points in it show the robot.
_FINGER_LOWER, _FINGER_UPPER = (-0.02, 0.037, 0.0), (0.02, 0.075, 0.12)

#: Function that labels pixels (h, w) by their colours (h, w, 3), depth (h, w) and heights in the world (h, w), in m.
MaskPredictor = Callable[[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]], npt.NDArray[np.uint8]]


def load_mask_predictor(weights: str | Path) -> tuple[MaskPredictor, str]:
    """Load the segmentation network in a weight file; return its mask predictor and a short hash of the weights."""
    # Imported here since PyTorch is optional, and slow to import.
    import torch

    from handover_marl.learning.networks.segmentation_network import SegmentationNetwork
    from handover_marl.learning.networks.weights import read_network_weights, single_threaded_inference

    network, fingerprint = read_network_weights(weights, SegmentationNetwork)

    def predict(*image: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        with single_threaded_inference():
            logits = network(*(torch.from_numpy(np.ascontiguousarray(part))[None] for part in image))[0].numpy()
        logits[CLASS_LABELS == SegmentationLabel.HAND] -= _HAND_REDUCTION
        # NumPy takes an eighth of the time that PyTorch takes.
        labels: npt.NDArray[np.uint8] = CLASS_LABELS[logits.argmax(axis=0)]
        return labels

    return predict, fingerprint


def segment_clouds(observation: Observation, world_from_hand: Array, predict: MaskPredictor) -> Observation:
    """Return the point clouds of the mode "scene_pointcloud" for an observation of the mode `UNSEGMENTED`.

    Of a cloud with more than 1024 points, every n-th point is kept. The hand link has the pose (7,) `world_from_hand`
    (quaternion xyzw).
    """
    points, depth = observation["wrist_point_map"], observation["wrist_depth"][..., 0]
    up = Rotation.from_quat(world_from_hand[3:]).as_matrix()[2].astype(np.float32)
    labels = predict(observation["wrist_rgb"], depth, points @ up + np.float32(world_from_hand[2]))
    # Pixels without a depth have no point.
    labels[depth >= WRIST_CAMERA.empty_depth] = SegmentationLabel.BACKGROUND
    clouds, counts = dict[str, npt.NDArray[Any]](), []
    for key, label, _ in CLOUDS:
        cloud = points[labels == label]
        mirrored = np.stack([cloud[:, 0], np.abs(cloud[:, 1]), cloud[:, 2]], axis=1)
        cloud = cloud[~((mirrored > _FINGER_LOWER) & (mirrored < _FINGER_UPPER)).all(axis=1)]
        if label == SegmentationLabel.TARGET and len(cloud):
            cloud = cloud[np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1) < _MAX_OBJECT_RADIUS]
        thinned = cloud[:: max(1, -(-len(cloud) // N_POINTS))]
        clouds[f"wrist_{key}"] = thinned
        counts.append(len(thinned))
    return {**clouds, "wrist_point_counts": np.array(counts, dtype=np.float32)}
