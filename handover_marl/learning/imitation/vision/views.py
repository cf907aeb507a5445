"""Rendered views of objects in persons' hands with good grasps: training data of `vision`.

Frames come from recordings. The camera is where receivers wait, or on the way to a grasp with
random offsets. Views are ray cast without physics. Quaternions are xyzw.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import OPEN, WAITING_JOINTS
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose, transform_points
from handover_marl.learning.imitation.samples import generate_samples, join_samples, stack_samples
from handover_marl.learning.imitation.vision.grasp_labels import GraspLabelConfig, GraspLabeller, LabelledGrasps
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.clearance import Spheres
from handover_marl.planning.hand_tracker import HandTracker
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive.controller import LIMIT_PADDING
from handover_marl.receivers.reactive.selector import FALLBACK_IK_SEEDS, IK_SEEDS
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import deproject
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.reference_tracking import select_keypoint_links

Array = npt.NDArray[np.float64]
Half = npt.NDArray[np.float16]
Rng = np.random.Generator

_IK_ITERATIONS = 12
# Smallest number of visible object points; views with fewer are discarded.
_MIN_POINTS = 30
# Shares of views of the last frame, in which the object is held out, and of frames before the object is picked up.
_LAST_FRAME_SHARE, _BEFORE_PICKUP_SHARE = 0.5, 0.05
# Shares of views for which the arm is near one of its two waiting poses, and for which it is between a waiting pose
# and a pose before a grasp; for the rest it is at a random pose before a grasp.
_WAITING_POSE_SHARE, _BETWEEN_SHARE = 0.1, 0.25
# Largest distance of a pose before a grasp from it, back along the hand's z axis (m).
_MAX_DISTANCE = 0.5
# Root mean square of the length (m) and angle (rad) of the random offset of such a pose at distance 0, and their
# increase per metre of distance from the grasp.
_LATERAL_RMS, _LATERAL_SLOPE, _ANGLE_RMS, _ANGLE_SLOPE = 0.015, 0.25, 0.1, 0.7
# Standard deviation of every arm joint near a waiting pose (rad).
_JOINT_NOISE_STD = 0.08
# Distance from its initial position at which the object counts as picked up (m).
_PICKUP_DISTANCE = 0.03
# Time before a frame over which the object's velocity is averaged, and after it over which its displacement is
# measured (ms).
_VELOCITY_WINDOW, _MOTION_WINDOW = 50, 500


@dataclass(frozen=True)
class GraspViewConfig:
    """Configuration of the rendered views of a set of scenes.

    Attributes:
        dataset: Dataset: dexycb, synthetic, or auto.
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        robot: Robot model that carries the camera: panda or panda_camera.
        count: Number of views per scene.
        seed: Seed of all random numbers.
        n_object_points: Number of the object's points that a view stores.
        max_hand_points: Largest number of the person's hand's points that a view stores.
        max_grasps: Largest number of good grasps that a view stores, the best ones.
        labels: Configuration of the qualities of grasps.
    """

    dataset: str = "auto"
    data_dir: str | None = None
    robot: str = "panda_camera"
    count: int = 100
    seed: int = 0
    n_object_points: int = 256
    max_hand_points: int = 64
    max_grasps: int = 96
    labels: GraspLabelConfig = field(default_factory=GraspLabelConfig)


class GraspViews(NamedTuple):
    """Arrays of n views, each in the frame of the robot's hand link when it was rendered.

    Attributes:
        object_points: (n, N, 3) points of the object, repeated if few are visible (m).
        hand_points: (n, M, 3) points of the person's hand, then zeros (m).
        n_hand_points: (n,) numbers of points of the person's hand.
        grasps: (n, K, 7) poses of the robot's hand link at good grasps, best first, then zeros.
        quality: (n, K) qualities of the grasps from 0 to 1, then zeros.
        object_center: (n, 3) centers of the objects (m).
        object_velocity: (n, 3) velocities of the objects (m/s).
        object_motion: (n, 3) displacements of the objects in the coming 0.5 s (m).
    """

    object_points: Half
    hand_points: Half
    n_hand_points: npt.NDArray[np.uint8]
    grasps: Half
    quality: Half
    object_center: Half
    object_velocity: Half
    object_motion: Half


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """Frame of a recording with the object's grasps and their qualities.

    Attributes:
        frame: Index of the frame in the recording (1 ms).
        object_pose: (7,) pose of the object in the world.
        known: Known grasps of the object.
        quality: (n,) qualities of the grasps at this frame.
    """

    frame: int
    object_pose: Array
    known: LabelledGrasps
    quality: Array


class ViewRenderer:
    """Renderer of wrist-camera views of recorded scenes, labelled with good grasps.

    Args:
        config: Data set, number and size of the views.

    Raises:
        HandoverError: The dataset cannot be opened.
    """

    def __init__(self, config: GraspViewConfig) -> None:
        self._config = config
        self._data = open_dataset(config.dataset, config.data_dir, config.robot)
        self._context = make_policy_context(self._data)
        self._arm = ArmInWorld.for_panda(self._context.panda_urdf, self._context.panda, LIMIT_PADDING)
        self._labels = GraspLabeller(self._context, config.labels)

    def render_scene(self, number: int) -> GraspViews:
        """Return up to `count` random views of a scene; views with few object points are discarded.

        Raises:
            SimulationError: A model cannot be loaded.
            DataFormatError: A mesh of a model cannot be read.
        """
        # Seeded by the scene, so that files do not depend on the number of processes.
        rng, scene = np.random.default_rng((self._config.seed, number)), self._data.load_scene(number)
        frames = _sample_frames(scene, self._config.count, rng).tolist()
        labelled = self.label_frames(scene, frames)
        poses = ((labelled[frame], self._sample_joints(labelled[frame], rng)) for frame in frames)
        return self.render(scene, poses, rng)

    def label_frames(self, scene: Scene, frames: Sequence[int]) -> dict[int, LabelledFrame]:
        """Return frames with the grasps of the object; those beside its final pose are offset ones, too."""
        name, last = scene.info.target_name, scene.n_frames - 1
        known = self._labels.load_grasps_near_hand(name, read_hand_spheres(scene, last), read_object_pose(scene, last))
        labelled = {}
        for frame in sorted(set(frames)):
            pose, hand = read_object_pose(scene, frame), read_hand_spheres(scene, frame)
            quality = self._labels.compute_qualities(known, hand, pose)
            labelled[frame] = LabelledFrame(frame, pose, known, quality)
        return labelled

    def render(self, scene: Scene, poses: Iterable[tuple[LabelledFrame, Array]], rng: Rng) -> GraspViews:
        """Return views of frames of a scene, rendered with the arm at given joints (7,) in rad."""
        camera = RayCamera(scene.assets, self._context.config.physics)
        rendered = [self._render_view(scene, camera, frame, joints, rng) for frame, joints in poses]
        views = [view for view in rendered if view is not None]
        config, half = self._config, np.float16
        hands = [(half, (config.max_hand_points, 3)), (np.uint8, ())]
        grasps = [(half, (config.max_grasps, 7)), (half, (config.max_grasps,))]
        columns = [(half, (config.n_object_points, 3)), *hands, *grasps, *[(half, (3,))] * 3]
        return stack_samples(GraspViews, views, columns)

    def _render_view(
        self, scene: Scene, camera: RayCamera, labelled: LabelledFrame, joints: Array, rng: Rng
    ) -> tuple[Any, ...] | None:
        """Return the fields of `GraspViews` for one view, or None if too little of the object is visible."""
        config, frame, known = self._config, labelled.frame, labelled.known
        has_hand = bool(scene.is_hand_present(np.array([frame]))[0])
        robot = np.array([*joints, OPEN, OPEN], dtype=np.float32)
        snapshot = JointSnapshot(robot, scene.hand_dof[frame] if has_hand else None, scene.object_dof[frame])
        image = camera.render_targets(snapshot)
        object_points, hand_points = (
            deproject(image.depth, image.compute_mask(label))
            for label in (SegmentationLabel.TARGET, SegmentationLabel.HAND)
        )
        if len(object_points) < _MIN_POINTS:
            return None
        world_from_link = self._arm.compute_hand_pose(np.asarray(joints, dtype=np.float64))
        hands, n_hands = np.zeros((config.max_hand_points, 3)), min(len(hand_points), config.max_hand_points)
        hands[:n_hands] = hand_points[rng.choice(len(hand_points), n_hands, replace=False)]
        best = np.argsort(-labelled.quality, kind="stable")[: config.max_grasps]
        best = best[labelled.quality[best] > self._labels.config.min_quality]
        grasps, quality = np.zeros((config.max_grasps, 7)), np.zeros(config.max_grasps)
        link_from_object = compose(invert_pose(world_from_link), labelled.object_pose)
        grasps[: len(best)] = compose(link_from_object, known.poses[best])
        quality[: len(best)] = labelled.quality[best]
        center = transform_points(labelled.object_pose, known.object_center)
        center = inverse_transform_points(world_from_link, center[None])[0]
        to_link = Rotation.from_quat(world_from_link[3:]).inv()
        velocity, motion = (to_link.apply(vector) for vector in _read_motion(scene, frame))
        wanted = config.n_object_points
        chosen = rng.choice(len(object_points), wanted, replace=len(object_points) < wanted)
        return object_points[chosen], hands, n_hands, grasps, quality, center, velocity, motion

    def _sample_joints(self, labelled: LabelledFrame, rng: Rng) -> Array:
        """Return random arm joints (7,) from which to render (rad)."""
        kind = rng.random()
        waiting = (WAITING_JOINTS, self._context.panda.start_joints)[rng.integers(2)]
        start = np.array(waiting[:ARM_DOF]) + rng.normal(0.0, _JOINT_NOISE_STD, ARM_DOF)
        good = labelled.quality > self._labels.config.min_quality
        if kind < _WAITING_POSE_SHARE or not good.any():
            return start
        goal = _sample_pose(labelled, int(rng.choice(np.flatnonzero(good))), rng)
        seeds = np.concatenate([start[None], IK_SEEDS, FALLBACK_IK_SEEDS])
        solutions, converged = self._arm.solve(np.tile(goal, (len(seeds), 1)), seeds, _IK_ITERATIONS)
        if not converged.any():
            return start
        joints: Array = solutions[int(np.argmax(converged))]
        is_between = kind < _WAITING_POSE_SHARE + _BETWEEN_SHARE
        return start + rng.random() * (joints - start) if is_between else joints


def generate_views(config: GraspViewConfig, scenes: Sequence[int], folder: Path, workers: int | None) -> GraspViews:
    """Return the views of scenes in the order of the scenes; render those of scenes that have no file yet.

    Args:
        config: Configuration of the views.
        scenes: Numbers of the scenes.
        folder: Folder of the files, one per scene, for one configuration only.
        workers: Number of processes, on which the views do not depend; default: one per core.

    Raises:
        DataNotFoundError: `scenes` is empty.
        ResultsError: The folder cannot be written, or a file is damaged.
        HandoverError: A scene cannot be read.
    """

    def make_renderer() -> Callable[[int], GraspViews]:
        return ViewRenderer(config).render_scene

    return join_samples(generate_samples(GraspViews, folder, scenes, make_renderer, "rendering views", workers))


def _read_motion(scene: Scene, frame: int) -> tuple[Array, Array]:
    """Return velocity (m/s) and coming displacement (m) of the object in the world, both (3,)."""
    path = scene.object_dof[:, 0, :3].astype(np.float64)
    before, after = max(frame - _VELOCITY_WINDOW, 0), min(frame + _MOTION_WINDOW, len(path) - 1)
    return (path[frame] - path[before]) / (0.001 * _VELOCITY_WINDOW), path[after] - path[frame]


def _sample_frames(scene: Scene, count: int, rng: Rng) -> npt.NDArray[np.int_]:
    path = scene.object_dof[:, 0, :3]
    picked = int(np.argmax(np.linalg.norm(path - path[0], axis=1) > _PICKUP_DISTANCE))
    kinds = rng.random(count)
    moving = rng.integers(picked, len(path), count)
    lying = rng.integers(0, max(picked, 1), count)
    frames: npt.NDArray[np.int_] = np.where(kinds < _LAST_FRAME_SHARE, len(path) - 1, moving)
    return np.where(kinds > 1.0 - _BEFORE_PICKUP_SHARE, lying, frames)


def _sample_pose(labelled: LabelledFrame, number: int, rng: Rng) -> Array:
    """Return a random world pose (7,) of the hand link on the way to a grasp."""
    distance = _MAX_DISTANCE * rng.random() ** 1.5
    lateral = (_LATERAL_RMS + _LATERAL_SLOPE * distance) * rng.normal(size=3) / np.sqrt(3.0)
    angle = (_ANGLE_RMS + _ANGLE_SLOPE * distance) * rng.normal(size=3) / np.sqrt(3.0)
    offset = np.concatenate([lateral - [0.0, 0.0, distance], Rotation.from_rotvec(angle).as_quat()])
    pose: Array = compose(compose(labelled.object_pose, labelled.known.poses[number]), offset)
    return pose


def read_object_pose(scene: Scene, frame: int) -> Array:
    """Return the world pose (7,) of the handed-over object in a frame (1 ms) of a recording."""
    dof = scene.object_dof[frame, 0].astype(np.float64)
    return np.concatenate([dof[:3], Rotation.from_euler("XYZ", dof[3:]).as_quat()])


def read_hand_spheres(scene: Scene, frame: int) -> Spheres | None:
    """Return spheres in the world that cover the recorded hand in a frame; None without a hand.

    Raises:
        SimulationError: The model of the hand cannot be read.
    """
    if not scene.is_hand_present(np.array([frame]))[0]:
        return None
    tree = read_tree(scene.assets.hand)
    dof = scene.hand_dof[frame]
    origins, _ = tree.compute_link_frames(dof[None])
    tracker = HandTracker()
    tracker.update(
        0.0,
        {
            "hand_present": np.ones(1, dtype=np.int8),
            "hand_keypoints": origins[0, select_keypoint_links(tree.moving_links)].astype(np.float32),
            "hand_dof_position": dof,
        },
    )
    return tracker.spheres
