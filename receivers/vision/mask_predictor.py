"""Segmentation of images and point clouds of the wrist camera by neural networks, which need PyTorch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from handover_marl.episode.camera_observations import CLOUDS, N_POINTS
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import DEPTH, POINT_MAP, RGB
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA

Array = npt.NDArray[np.float64]

#: Observation mode of a receiver that segments the images itself.
UNSEGMENTED = f"{RGB}+{DEPTH}+{POINT_MAP}"
#: Segmentation labels by class number of `SegmentationNetwork`; robot and table are background.
CLASS_LABELS = np.array(
    [
        SegmentationLabel.BACKGROUND,
        SegmentationLabel.TARGET,
        SegmentationLabel.OTHER_OBJECT,
        SegmentationLabel.HAND,
    ],
    dtype=np.uint8,
)
#: Class numbers of object and hand; the network's part for points, `SegmentationNetwork.points`, separates the two.
OBJECT_CLASS, HAND_CLASS = 1, 3
#: Number of such pixels below which that part is not used, and number above which it gets only every n-th pixel.
MIN_BODY_PIXELS, _MAX_BODY_PIXELS = 40, 2048
# Largest distance of an object point from the median of all (m); points beyond it are removed as wrongly segmented.
_MAX_OBJECT_RADIUS = 0.2
# Lower and upper corner of the volume of an open finger in the hand link's frame, with |y| in place of y (m), with a
# margin for errors of the camera's pose. Points in this volume show the robot.
_FINGER_LOWER, _FINGER_UPPER = (-0.02, 0.037, 0.0), (0.02, 0.075, 0.12)

#: Function that labels pixels (h, w) from four arguments: colors (h, w, 3), depth (h, w), points in the world (h, w, 3)
#: and position of the robot's hand link (3,), in m.
MaskPredictor = Callable[
    [npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]], npt.NDArray[np.uint8]
]


def load_mask_predictor(weights: str | Path) -> tuple[MaskPredictor, str]:
    """Load a segmentation network from a weight file; return its mask predictor and a short hash of the weights."""
    # Imported here since PyTorch is optional, and slow to import.
    import torch

    from handover_marl.learning.networks.point_segmentation_network import N_BODY_POINTS
    from handover_marl.learning.networks.segmentation_network import SegmentationNetwork
    from handover_marl.learning.networks.weights import read_network_weights, single_threaded_inference

    network, fingerprint = read_network_weights(weights, SegmentationNetwork)

    def compute(module: Callable[..., Any], *inputs: npt.NDArray[Any]) -> npt.NDArray[Any]:
        with single_threaded_inference():
            outputs = module(*(torch.from_numpy(np.ascontiguousarray(part, np.float32))[None] for part in inputs))
        logits: npt.NDArray[Any] = outputs[0].numpy()
        return logits

    def predict(
        rgb: npt.NDArray[Any], depth: npt.NDArray[Any], points: npt.NDArray[Any], hand_link: npt.NDArray[Any]
    ) -> npt.NDArray[np.uint8]:
        logits = compute(network, rgb, depth, points[..., 2])
        # NumPy takes an eighth of the time that PyTorch takes.
        labels: npt.NDArray[np.uint8] = CLASS_LABELS[logits.argmax(axis=0)]
        pixels = find_body_pixels(logits, depth)
        if len(pixels) < MIN_BODY_PIXELS:
            return labels
        labels.flat[pixels] = SegmentationLabel.BACKGROUND
        pixels = pixels[:: -(-len(pixels) // _MAX_BODY_PIXELS)]
        bodies, margins = points.reshape(-1, 3)[pixels], (logits[HAND_CLASS] - logits[OBJECT_CLASS]).flat[pixels]
        chosen = choose_points(len(pixels), N_BODY_POINTS, np.random.default_rng(0))
        classes = compute(network.points, bodies[chosen], margins[chosen], hand_link).argmax(axis=1)
        # Each of the other pixels has the class of the nearest point.
        labels.flat[pixels] = CLASS_LABELS[classes[cKDTree(bodies[chosen]).query(bodies)[1]]]
        return labels

    return predict, fingerprint


def find_body_pixels(logits: npt.NDArray[Any], depth: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return flat indices of the pixels with a valid depth (h, w) whose logits (4, h, w) show object or hand."""
    is_body = np.isin(logits.argmax(axis=0), (OBJECT_CLASS, HAND_CLASS)) & (depth < WRIST_CAMERA.empty_depth)
    return np.flatnonzero(is_body)


def choose_points(available: int, count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return `count` random indices below `available` in random order; they repeat only if `available` < `count`."""
    return np.resize(rng.permutation(available), count)


def segment_clouds(observation: Observation, world_from_hand: Array, predict: MaskPredictor) -> Observation:
    """Segment an observation of the mode `UNSEGMENTED`; return point clouds with the keys of "scene_pointcloud".

    Of a cloud with more than 1024 points, only every n-th point is kept. Clouds are not padded, and the counts are
    their numbers of points. `world_from_hand` (7,) is the hand link's pose (quaternion xyzw).
    """
    points, depth = observation["wrist_point_map"], observation["wrist_depth"][..., 0]
    pose = world_from_hand.astype(np.float32)
    in_world = points @ Rotation.from_quat(pose[3:]).as_matrix().T.astype(np.float32) + pose[:3]
    labels = predict(observation["wrist_rgb"], depth, in_world, pose[:3])
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
