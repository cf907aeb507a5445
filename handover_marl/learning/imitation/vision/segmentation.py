"""Rendered images and point clouds with classes, and the training of the segmentation network of `vision`.

Object and hand are posed as in a frame of a recording, and the arm is on a random path to the object. Camera errors,
colors, light and depth noise are random in every image. The clouds train the part of the network that separates the
points of object and hand; they come from images in which the image part finds object or hand. The module needs the
extra `train`.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as func
from scipy.spatial.transform import Rotation
from torch import Tensor

from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.panda import OPEN, SHOULDER_HEIGHT
from handover_marl.learning.imitation.run import Batches, ImitationLearner, Network, stack_samples
from handover_marl.learning.imitation.vision.views import RecordedViewRenderer, read_object_pose
from handover_marl.learning.networks.point_segmentation_network import N_BODY_POINTS, PointSegmentationNetwork
from handover_marl.learning.networks.segmentation_network import N_CLASSES, SegmentationNetwork
from handover_marl.receivers.vision.mask_predictor import (
    CLASS_LABELS,
    HAND_CLASS,
    MIN_BODY_PIXELS,
    OBJECT_CLASS,
    choose_points,
    find_body_pixels,
)
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.noise import CameraNoise, apply_camera_noise
from handover_marl.simulation.camera.optics import WRIST_CAMERA, deproject
from handover_marl.simulation.camera.randomization import CameraRandomization
from handover_marl.simulation.camera.ray_camera import RayCamera

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Rng = np.random.Generator

# Deviations of the cameras, about twice those of the camera noise "imperfect", and more noise for half of the images.
_RANDOMIZATION = CameraRandomization(
    color=0.3, brightness=0.3, position=0.02, rotation=0.07, focal=0.02, principal=4.0, depth_noise_std=0.004
)
_NOISE = CameraNoise(depth_noise_std=0.001, latency=0.0)
# Share of images of the last frame, in which the object is held out.
_LAST_FRAME_SHARE = 0.4
# Standard deviations of arm joints at a waiting pose (rad), of the direction to the object, and of the rotation about
# it (rad); distances of the hand link from the object (m); share of images that are taken at the end of a path.
_JOINT_STD, _DIRECTION_STD, _ROLL_STD, _DISTANCES, _END_SHARE = 0.15, 0.35, 1.0, (0.08, 0.6), 0.3
# Label of pixels without a depth, which have no class.
_IGNORED = 255
# Side of the sections of images in a batch (pixels), and share of those that are anywhere in the image.
_SECTION, _ANYWHERE_SHARE = 128, 0.25
# Number of points of a cloud in memory, and of those from which the vertical is computed.
_N_KEPT, _N_VERTICAL = 768, 400
# Augmentation of clouds: largest relative change of the size; standard deviations of a tilt (rad) and of the
# differences of logits; largest one of noise on points (m); share of clouds without differences of logits.
_SCALE, _TILT_STD, _MARGIN_STD, _MAX_NOISE, _UNKNOWN_SHARE = 0.07, 0.05, 0.7, 0.001, 0.3
_N_EVALUATED = 32


class SegmentationViews(NamedTuple):
    """Arrays of n images of h x w pixels.

    Attributes:
        rgb: (n, h, w, 3) red, green and blue from 0 to 255.
        depth: (n, h, w) depth along the viewing axis (m).
        height: (n, h, w) heights in the world of the pixels' points, for a camera without errors (m).
        classes: (n, h, w) classes of `SegmentationNetwork`, or 255 for pixels without a depth.
    """

    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float16]
    height: npt.NDArray[np.float16]
    classes: npt.NDArray[np.uint8]


class SegmentationRenderer(RecordedViewRenderer):
    """Renderer of images of recorded scenes with their segmentation."""

    def render_scene(self, number: int) -> SegmentationViews:
        """Return random images of the scene `number`; their number is the constructor's argument `count`."""
        rng, scene = np.random.default_rng((self._seed, number)), self._data.load_scene(number)
        camera = RayCamera(scene.assets, self._context.config.physics)
        views = [self._render_view(scene, camera, rng) for _ in range(self._count)]
        shape = (WRIST_CAMERA.height, WRIST_CAMERA.width)
        columns = [(np.uint8, (*shape, 3)), (np.float16, shape), (np.float16, shape), (np.uint8, shape)]
        return stack_samples(SegmentationViews, views, columns)

    def _render_view(self, scene: Scene, camera: RayCamera, rng: Rng) -> tuple[Any, ...]:
        """Return the fields of `SegmentationViews` for one random image."""
        is_last = rng.random() < _LAST_FRAME_SHARE
        frame = scene.n_frames - 1 if is_last else int(rng.integers(scene.n_frames))
        joints = self._sample_joints(read_object_pose(scene, frame)[:3], rng)
        hand = scene.hand_dof[frame] if scene.is_hand_present(np.array([frame]))[0] else None
        robot = np.array([*joints, OPEN, OPEN], dtype=np.float32)
        drawn = _RANDOMIZATION.draw(WRIST_CAMERA, _NOISE if rng.random() < 0.5 else None, rng)
        snapshot = JointSnapshot(robot, hand, scene.object_dof[frame])
        image = drawn.change_colors(camera.render(snapshot, True, drawn.camera))
        if drawn.noise is not None:
            image = apply_camera_noise(image, drawn.noise, rng, drawn.camera)
        has_depth = image.depth < WRIST_CAMERA.empty_depth
        pose = self._arm.compute_hand_pose(joints)
        up = Rotation.from_quat(pose[3:]).as_matrix()[2]
        height = deproject(image.depth, np.ones_like(has_depth)) @ up + pose[2]
        classes = _find_classes(image.segmentation)
        return image.rgb, image.depth, height.reshape(has_depth.shape), np.where(has_depth, classes, _IGNORED)

    def _sample_joints(self, point: Array, rng: Rng) -> Array:
        """Return random arm joints (7,) in rad between a waiting pose and a pose that looks at a world point (3,)."""
        start = self.draw_waiting_joints(_JOINT_STD, rng)
        ahead = point - np.array(self._context.panda.base_position) - [0.0, 0.0, SHOULDER_HEIGHT]
        ahead = ahead / np.linalg.norm(ahead) + rng.normal(0.0, _DIRECTION_STD, 3)
        ahead /= np.linalg.norm(ahead)
        side = np.cross(ahead, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        axes = np.stack([np.cross(side, ahead), side, ahead], axis=1)
        rotation = Rotation.from_matrix(axes) * Rotation.from_rotvec([0.0, 0.0, rng.normal(0.0, _ROLL_STD)])
        distance = rng.uniform(*_DISTANCES)
        position = point - distance * ahead + 0.15 * distance * rng.normal(size=3)
        goal = self.find_joints(np.concatenate([position, rotation.as_quat()]), start)
        if goal is None:
            return start
        joints: Array = start + (goal - start) * min(1.0, rng.random() / (1.0 - _END_SHARE))
        return joints


def _find_classes(segmentation: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Convert segmentation labels (h, w), values of `SegmentationLabel`, to class numbers of the network (h, w)."""
    numbers = np.zeros(len(SegmentationLabel), dtype=np.uint8)
    numbers[CLASS_LABELS] = np.arange(N_CLASSES)
    return numbers[segmentation]


class ObjectHandClouds(NamedTuple):
    """Clouds of n points in each of v views, as inputs of `PointSegmentationNetwork`.

    Attributes:
        points: (v, n, 3) points in a frame whose z coordinate is the height in the world (m).
        margins: (v, n) logit of the hand minus logit of the object that the image part predicts.
        hand_links: (v, 3) positions of the hand link in that frame (m).
        classes: (v, n) classes of the points.
    """

    points: Float32
    margins: Float32
    hand_links: Float32
    classes: npt.NDArray[np.uint8]


def collect_clouds(network: SegmentationNetwork, views: SegmentationViews, rng: Rng) -> ObjectHandClouds | None:
    """Return clouds of the views in which the network finds enough pixels of object or hand; None without such a view.

    The depths of a view give points in the hand link's frame. The direction of the world's z axis in this frame is
    fitted to the heights of these points, which the view stores.
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
    return ObjectHandClouds(points.astype(np.float32), margins, hand_links.astype(np.float32), chosen_classes)


def _fit_vertical(
    points: Float32, heights: npt.NDArray[np.floating], rows: npt.NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return rotation (3, 3) and translation (3,) (m) from the points' frame to one whose z is the height in the world.

    They are fitted to the heights (n,) in the world of the points (n, 3) with the indices `rows` (m).
    """
    equations = np.column_stack([points[rows], np.ones(len(rows))])
    *vertical, height = np.linalg.lstsq(equations, heights[rows].astype(np.float64), rcond=None)[0]
    up = np.array(vertical) / np.linalg.norm(vertical)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up]), np.array([0.0, 0.0, height])


#: Fields of `SegmentationViews` or `ObjectHandClouds` for a batch of images or clouds; the last field has the classes.
Batch = tuple[Tensor, ...]


class LabelledBatches(Batches):
    """Data set of images or clouds with classes, from which batches are selected."""

    @abstractmethod
    def augment(self, number: int, rng: Rng) -> Sequence[npt.NDArray[Any]]:
        """Return all fields for a random part of the image or cloud with the index `number`, with random changes."""

    def sample(self, count: int, rng: Rng) -> Batch:
        """Return a batch of `count` results of `augment` for random images or clouds."""
        rows = [self.augment(number, rng) for number in rng.integers(len(self), size=count)]
        return tuple(torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))

    def select(self, numbers: npt.NDArray[np.integer]) -> Batch:
        """Return the images or clouds with the indices `numbers` (B,)."""
        return tuple(torch.from_numpy(part[numbers]) for part in self._samples)


class SegmentationBatches(LabelledBatches):
    """Data set of `SegmentationViews`."""

    def augment(self, number: int, rng: Rng) -> Sequence[npt.NDArray[Any]]:
        """Return a random section (128 x 128 pixels) of an image, in most cases around a pixel of an object or hand."""
        classes = self._samples[-1][number]
        shown = np.flatnonzero((classes > 0) & (classes != _IGNORED))
        is_any = not len(shown) or rng.random() < _ANYWHERE_SHARE
        center = rng.integers(classes.size) if is_any else shown[rng.integers(len(shown))]
        corner = np.array(np.unravel_index(center, classes.shape)) - rng.integers(_SECTION, size=2)
        row, column = np.clip(corner, 0, np.array(classes.shape) - _SECTION)
        return [part[number, row : row + _SECTION, column : column + _SECTION] for part in self._samples]


class PointBatches(LabelledBatches):
    """Data set of `ObjectHandClouds`."""

    def augment(self, number: int, rng: Rng) -> Sequence[npt.NDArray[Any]]:
        """Return 256 random points of a cloud, turned, tilted, mirrored and scaled at random, with noise."""
        points, margins, hand_link, classes = (part[number] for part in self._samples)
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

    def select(self, numbers: npt.NDArray[np.integer]) -> Batch:
        """Return the first 256 points of the clouds with the indices `numbers` (B,)."""
        points, margins, hand_links, classes = super().select(numbers)
        return points[:, :N_BODY_POINTS], margins[:, :N_BODY_POINTS], hand_links, classes[:, :N_BODY_POINTS]


class LabelLearner(ImitationLearner[Network, Batch]):
    """Base class of trainers of networks that classify pixels or points; `class_weights` are factors in the loss."""

    class_weights: ClassVar[tuple[float, ...]]

    def compute_logits(self, network: Network, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return logits (B, 4, h, w) of the classes, or (n, 4) of n points, and true classes (B, h, w) or (n,)."""
        *inputs, classes = (part.to(self._device) for part in batch)
        return network(*inputs), classes.long()

    def compute_losses(self, network: Network, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the weighted cross entropy of the classes, to minimize and to report."""
        weights = torch.tensor(self.class_weights, device=self._device)
        loss = func.cross_entropy(*self.compute_logits(network, batch), weights, ignore_index=_IGNORED)
        return loss, {"cross_entropy": loss}

    def evaluate(self, held_out: LabelledBatches) -> dict[str, float]:
        """Return the intersection over union of each class on all held-out images or clouds, by class name."""
        counts = np.zeros((N_CLASSES, N_CLASSES))  # of pairs of a true and a predicted class
        with torch.inference_mode():
            for numbers in np.array_split(np.arange(len(held_out)), -(-len(held_out) // _N_EVALUATED)):
                logits, classes = self.compute_logits(self.averaged_network, held_out.select(numbers))
                pairs = (N_CLASSES * classes + logits.argmax(dim=1))[classes != _IGNORED]
                counts += pairs.bincount(minlength=N_CLASSES**2).reshape(N_CLASSES, N_CLASSES).cpu().numpy()
        union = counts.sum(axis=0) + counts.sum(axis=1) - counts.diagonal()
        shares = counts.diagonal() / np.maximum(union, 1.0)
        return {SegmentationLabel(label).name.lower(): share for label, share in zip(CLASS_LABELS, shares, strict=True)}


class SegmentationLearner(LabelLearner[SegmentationNetwork]):
    """Trainer of the segmentation network; reproducible for a seed, a device and a number of threads."""

    learning_rate, warmup, averaging = 3e-3, 50, 0.99
    class_weights = (1.0, 2.0, 2.0, 3.0)  # few pixels show object and hand


class PointSegmentationLearner(LabelLearner[PointSegmentationNetwork]):
    """Trainer of the network that classifies points of object and hand."""

    learning_rate, warmup, averaging = 2e-3, 100, 0.995
    class_weights = (1.0, 1.0, 1.0, 1.5)

    def compute_logits(self, network: PointSegmentationNetwork, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return logits (n, 4) and true classes (n,) of the n points of a batch."""
        logits, classes = super().compute_logits(network, batch)
        return logits.flatten(end_dim=1), classes.flatten()
