"""Rendered images with segmentation labels, and the training of the segmentation network of `vision`.

Frames come from recordings, and arm poses are on random ways to the object. Camera errors, colours, light and depth
noise are random in every image. The module needs the extra `train`.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as func
from scipy.spatial.transform import Rotation
from torch import Tensor

from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.panda import OPEN
from handover_marl.learning.imitation.run import ImitationLearner
from handover_marl.learning.imitation.samples import stack_samples
from handover_marl.learning.imitation.vision.views import RecordedViewRenderer, read_object_pose
from handover_marl.learning.networks.segmentation_network import N_CLASSES, SegmentationNetwork
from handover_marl.receivers.vision.mask_predictor import CLASS_LABELS
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.noise import CameraNoise, apply_camera_noise
from handover_marl.simulation.camera.optics import WRIST_CAMERA, deproject
from handover_marl.simulation.camera.randomization import CameraRandomization
from handover_marl.simulation.camera.ray_camera import RayCamera

Array = npt.NDArray[np.float64]
Rng = np.random.Generator

# Deviations of the cameras, about twice those of the camera noise "imperfect", and noise of every second image.
_RANDOMIZATION = CameraRandomization(
    color=0.3, brightness=0.3, position=0.02, rotation=0.07, focal=0.02, principal=4.0, depth_noise_std=0.004
)
_NOISE = CameraNoise(depth_noise_std=0.001, latency=0.0)
# Share of images of the last frame, in which the object is held out.
_LAST_FRAME_SHARE = 0.4
# Standard deviations of arm joints at a waiting pose (rad), of the direction to the object, and of the rotation about
# it (rad); distances of the hand link from the object (m); share of images that are taken at the end of a way.
_JOINT_STD, _DIRECTION_STD, _ROLL_STD, _DISTANCES, _END_SHARE = 0.15, 0.35, 1.0, (0.08, 0.6), 0.3
# Label of pixels without a depth, which have no class.
_IGNORED = 255
# Weights of the classes in the loss, since few pixels show object and hand.
_CLASS_WEIGHTS = (1.0, 2.0, 2.0, 3.0)
# Side of the sections of images in a batch (pixels), and share of those that are anywhere in the image.
_SECTION, _ANYWHERE_SHARE = 128, 0.25
_N_EVALUATED = 32


class SegmentationViews(NamedTuple):
    """Arrays of n images of h x w pixels.

    Attributes:
        rgb: (n, h, w, 3) colours.
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
        """Return random images of the scene with a number."""
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
        """Return random arm joints (7,) in rad on the way from a waiting pose to one that looks at a point (3,) (m)."""
        start = self.draw_waiting_joints(_JOINT_STD, rng)
        ahead = point - np.array(self._context.panda.base_position) - [0.0, 0.0, 0.333]
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


#: B images: colours, depths, heights and classes, as in `SegmentationViews`.
Batch = tuple[Tensor, ...]


class SegmentationBatches:
    """Data set of images, from which batches are selected."""

    def __init__(self, views: SegmentationViews) -> None:
        self._views = views

    def __len__(self) -> int:
        return len(self._views.rgb)

    def sample(self, count: int, rng: Rng) -> Batch:
        """Return a batch of `count` random sections of images, most of them around object or hand."""
        rows = []
        for number in rng.integers(len(self), size=count):
            classes = self._views.classes[number]
            shown = np.flatnonzero((classes > 0) & (classes != _IGNORED))
            is_any = not len(shown) or rng.random() < _ANYWHERE_SHARE
            center = rng.integers(classes.size) if is_any else shown[rng.integers(len(shown))]
            corner = np.array(np.unravel_index(center, classes.shape)) - rng.integers(_SECTION, size=2)
            row, column = np.clip(corner, 0, np.array(classes.shape) - _SECTION)
            rows.append([part[number, row : row + _SECTION, column : column + _SECTION] for part in self._views])
        return tuple(torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))

    def select(self, numbers: npt.NDArray[np.integer]) -> Batch:
        """Return the images with the given numbers (B,)."""
        return tuple(torch.from_numpy(part[numbers]) for part in self._views)


class SegmentationLearner(ImitationLearner[SegmentationNetwork, Batch]):
    """Trainer of the segmentation network; reproducible for a seed, a device and a number of threads."""

    learning_rate, warmup, averaging = 3e-3, 50, 0.99

    def compute_losses(self, network: SegmentationNetwork, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the weighted cross entropy of the classes, to minimize and to report."""
        *inputs, classes = (part.to(self._device) for part in batch)
        weights = torch.tensor(_CLASS_WEIGHTS, device=self._device)
        loss = func.cross_entropy(network(*inputs), classes.long(), weights, ignore_index=_IGNORED)
        return loss, {"cross_entropy": loss}

    def evaluate(self, held_out: SegmentationBatches) -> dict[str, float]:
        """Return the intersection over union of each class, over all pixels of the held-out images, by its name."""
        counts = np.zeros((N_CLASSES, N_CLASSES))
        with torch.inference_mode():
            for numbers in np.array_split(np.arange(len(held_out)), -(-len(held_out) // _N_EVALUATED)):
                *inputs, classes = (part.to(self._device) for part in held_out.select(numbers))
                has_class = classes != _IGNORED
                counts += count_pairs(classes[has_class], self.averaged_network(*inputs).argmax(dim=1)[has_class])
        return compute_shares(counts)


def count_pairs(classes: Tensor, predicted: Tensor) -> npt.NDArray[np.int64]:
    """Return how often each pair of a true and a predicted class occurs, (4, 4)."""
    found = (N_CLASSES * classes.long() + predicted).flatten().bincount(minlength=N_CLASSES**2)
    counts: npt.NDArray[np.int64] = found.reshape(N_CLASSES, N_CLASSES).cpu().numpy()
    return counts


def compute_shares(counts: Array) -> dict[str, float]:
    """Return the intersection over union of each class, by its name, from the sums (4, 4) of `count_pairs`."""
    union = counts.sum(axis=0) + counts.sum(axis=1) - counts.diagonal()
    shares = counts.diagonal() / np.maximum(union, 1.0)
    return {SegmentationLabel(label).name.lower(): share for label, share in zip(CLASS_LABELS, shares, strict=True)}


def _find_classes(segmentation: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the classes (h, w) of the network for segmentation labels (h, w)."""
    numbers = np.zeros(len(SegmentationLabel), dtype=np.uint8)
    numbers[CLASS_LABELS] = np.arange(N_CLASSES)
    return numbers[segmentation]
