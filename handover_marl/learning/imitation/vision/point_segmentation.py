"""Point clouds of object and hand with the classes of their points, and the training that separates them.

The clouds come from the images of `SegmentationViews`, as far as the image network finds object or hand in them. The
module needs the extra `train`.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as func
from scipy.spatial.transform import Rotation
from torch import Tensor

from handover_marl.learning.imitation.run import ImitationLearner
from handover_marl.learning.imitation.vision.segmentation import Batch, SegmentationViews, compute_shares, count_pairs
from handover_marl.learning.networks.point_segmentation_network import N_BODY_POINTS, PointSegmentationNetwork
from handover_marl.learning.networks.segmentation_network import N_CLASSES, SegmentationNetwork
from handover_marl.receivers.vision.mask_predictor import (
    HAND_CLASS,
    MIN_BODY_PIXELS,
    OBJECT_CLASS,
    choose_points,
    find_body_pixels,
)
from handover_marl.simulation.camera.optics import deproject

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Rng = np.random.Generator

# Number of points of a cloud in memory, and of those from which the vertical is computed.
_N_KEPT, _N_VERTICAL = 768, 400
# Augmentation: largest relative change of the size; standard deviations of a tilt (rad) and of the differences of
# logits; largest noise of points (m); share of clouds without differences of logits.
_SCALE, _TILT_STD, _MARGIN_STD, _MAX_NOISE, _UNKNOWN_SHARE = 0.07, 0.05, 0.7, 0.001, 0.3
_CLASS_WEIGHTS = (1.0, 1.0, 1.0, 1.5)
_N_EVALUATED = 32


class BodyClouds(NamedTuple):
    """Clouds of n points in each of v views, as inputs of `PointSegmentationNetwork`.

    Attributes:
        points: (v, n, 3) points in a frame with the world's z axis (m).
        margins: (v, n) differences of the logits of hand and object.
        hand_links: (v, 3) positions of the hand link in that frame (m).
        classes: (v, n) classes of the points.
    """

    points: Float32
    margins: Float32
    hand_links: Float32
    classes: npt.NDArray[np.uint8]


def collect_clouds(network: SegmentationNetwork, views: SegmentationViews, rng: Rng) -> BodyClouds | None:
    """Return the clouds of the views in which the network finds enough pixels of object or hand; None if there is none.

    The depths of a view give points in the hand link's frame, and their heights the direction of the world's z axis.
    """
    rows = []
    for image in zip(*views, strict=True):
        with torch.inference_mode():
            logits = network(*(torch.from_numpy(part)[None] for part in image[:3]))[0].numpy()
        depth, heights, classes = image[1].astype(np.float32), image[2].ravel(), image[3].ravel()
        pixels = find_body_pixels(logits, depth)
        if len(pixels) < MIN_BODY_PIXELS:
            continue
        points = deproject(depth, np.ones(depth.shape, dtype=np.bool_))
        rotation, hand_link = _fit_vertical(points, heights, rng.choice(pixels, _N_VERTICAL))
        chosen = pixels[choose_points(len(pixels), _N_KEPT, rng)]
        margins = (logits[HAND_CLASS] - logits[OBJECT_CLASS]).flat[chosen]
        rows.append((points[chosen] @ rotation.T + hand_link, margins, hand_link, classes[chosen]))
    if not rows:
        return None
    points, margins, hand_links, chosen_classes = map(np.stack, zip(*rows, strict=True))
    return BodyClouds(points.astype(np.float32), margins, hand_links.astype(np.float32), chosen_classes)


def _fit_vertical(
    points: Float32, heights: npt.NDArray[np.floating], rows: npt.NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return the rotation (3, 3) to a frame with the world's z axis, and the position (3,) of the origin in it.

    Points (n, 3) with the indices `rows` determine them, by their heights (n,) in the world.
    """
    equations = np.column_stack([points[rows], np.ones(len(rows))])
    *vertical, height = np.linalg.lstsq(equations, heights[rows].astype(np.float64), rcond=None)[0]
    up = np.array(vertical) / np.linalg.norm(vertical)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up]), np.array([0.0, 0.0, height])


class PointBatches:
    """Data set of clouds, from which batches are selected."""

    def __init__(self, clouds: BodyClouds) -> None:
        self._clouds = clouds

    def __len__(self) -> int:
        return len(self._clouds.points)

    def sample(self, count: int, rng: Rng) -> Batch:
        """Return a batch of `count` random clouds with random points, turned, tilted, mirrored, scaled and noisy."""
        rows = [self._augment(number, rng) for number in rng.integers(len(self), size=count)]
        return tuple(torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))

    def select(self, numbers: npt.NDArray[np.integer]) -> Batch:
        """Return the first 256 points of the clouds with the given numbers (B,)."""
        points, margins, hand_links, classes = (part[numbers] for part in self._clouds)
        parts = points[:, :N_BODY_POINTS], margins[:, :N_BODY_POINTS], hand_links, classes[:, :N_BODY_POINTS]
        return tuple(map(torch.from_numpy, parts))

    def _augment(self, number: int, rng: Rng) -> tuple[npt.NDArray[np.generic], ...]:
        points, margins, hand_link, classes = (part[number] for part in self._clouds)
        chosen = rng.permutation(_N_KEPT)[:N_BODY_POINTS]
        mean = points[chosen].mean(axis=0)
        turn = Rotation.from_euler("zxy", [rng.uniform(-np.pi, np.pi), *rng.normal(0.0, _TILT_STD, 2)]).as_matrix()
        turn[:, 1] *= rng.choice([-1.0, 1.0])
        turn *= rng.uniform(1.0 - _SCALE, 1.0 + _SCALE)
        moved = (points[chosen] - mean) @ turn.T + rng.normal(0.0, _MAX_NOISE * rng.random(), (N_BODY_POINTS, 3)) + mean
        known = 0.0 if rng.random() < _UNKNOWN_SHARE else margins[chosen] + rng.normal(0.0, _MARGIN_STD)
        return (
            moved.astype(np.float32),
            np.broadcast_to(known, N_BODY_POINTS).astype(np.float32),
            ((hand_link - mean) @ turn.T + mean).astype(np.float32),
            classes[chosen],
        )


class PointSegmentationLearner(ImitationLearner[PointSegmentationNetwork, Batch]):
    """Trainer of the network that classifies points of object and hand."""

    learning_rate, warmup, averaging = 2e-3, 100, 0.995

    def compute_losses(self, network: PointSegmentationNetwork, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the weighted cross entropy of the classes, to minimize and to report."""
        *inputs, classes = (part.to(self._device) for part in batch)
        weights = torch.tensor(_CLASS_WEIGHTS, device=self._device)
        loss = func.cross_entropy(network(*inputs).flatten(end_dim=1), classes.flatten().long(), weights)
        return loss, {"cross_entropy": loss}

    def evaluate(self, held_out: PointBatches) -> dict[str, float]:
        """Return the intersection over union of each class, over all points of the held-out clouds, by its name."""
        counts = np.zeros((N_CLASSES, N_CLASSES))
        with torch.inference_mode():
            for numbers in np.array_split(np.arange(len(held_out)), -(-len(held_out) // _N_EVALUATED)):
                *inputs, classes = (part.to(self._device) for part in held_out.select(numbers))
                counts += count_pairs(classes, self.averaged_network(*inputs).argmax(dim=-1))
        return compute_shares(counts)
