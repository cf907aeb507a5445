"""Rendered views of objects in persons' hands with good grasps: training data of `vision`.

Frames come from recordings. The camera is where receivers wait, or on the way to a grasp with
random offsets. Views are ray cast without physics. Quaternions are xyzw.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import OPEN, WAITING_JOINTS
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose, transform_points
from handover_marl.learning.imitation.samples import stack_samples
from handover_marl.learning.imitation.vision.grasp_labels import GraspLabeller, LabelledGrasps
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.clearance import Spheres
from handover_marl.planning.hand_tracker import HandTracker
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.reactive.selector import FALLBACK_IK_SEEDS, IK_SEEDS
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import deproject
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.reference_tracking import select_keypoint_links

Array = npt.NDArray[np.float64]
Half = npt.NDArray[np.float16]
Rng = np.random.Generator

_IK_ITERATIONS = 12


@dataclass(frozen=True)
class GraspViewConfig:
    """Distribution and size of the rendered views for the grasp network.

    Attributes:
        n_object_points: Number of the object's points that a view stores.
        max_hand_points: Largest number of the person's hand's points that a view stores.
        max_grasps: Largest number of good grasps that a view stores, the best ones.
        min_points: Smallest number of visible object points; views with fewer are discarded.
        last_frame_share: Share of views of the last frame of a recording, in which the object is held out.
        before_pickup_share: Share of views of frames before the object is picked up.
        waiting_pose_share: Share of views for which the arm is near one of its two waiting poses.
        between_share: Share of views for which the arm is between a waiting pose and a pose before a
            grasp; for the rest it is at a random pose before a grasp.
        max_distance: Largest distance of such a pose from the grasp, back along the hand's z axis (m).
        lateral_rms: Root mean square of the length of the random displacement that is added to the pose,
            at distance 0 from the grasp (m).
        lateral_slope: Increase of `lateral_rms` per metre of distance from the grasp (m/m).
        angle_rms: Root mean square of the angle of the random rotation that is added to the pose, at
            distance 0 from the grasp (rad).
        angle_slope: Increase of `angle_rms` per metre of distance from the grasp (rad/m).
        joint_noise_std: Standard deviation of every arm joint near a waiting pose (rad).
        pickup_distance: Distance from its initial position at which the object counts as picked up (m).
        velocity_window: Time before a frame over which the object's velocity is averaged (ms).
        motion_window: Time after a frame over which the object's displacement is measured (ms).
    """

    n_object_points: int = 256
    max_hand_points: int = 64
    max_grasps: int = 96
    min_points: int = 30
    last_frame_share: float = 0.5
    before_pickup_share: float = 0.05
    waiting_pose_share: float = 0.1
    between_share: float = 0.25
    max_distance: float = 0.5
    lateral_rms: float = 0.015
    lateral_slope: float = 0.25
    angle_rms: float = 0.1
    angle_slope: float = 0.7
    joint_noise_std: float = 0.08
    pickup_distance: float = 0.03
    velocity_window: int = 50
    motion_window: int = 500


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
        object_motion: (n, 3) displacements of the objects in the coming `motion_window` (m).
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
        context: Robot, objects and their known grasps.
        arm: Kinematics of the robot's arm.
        labels: Labeller that rates the grasps of the objects.
        config: Distribution and size of the views.
    """

    def __init__(
        self,
        context: PolicyContext,
        arm: ArmInWorld,
        labels: GraspLabeller,
        config: GraspViewConfig = GraspViewConfig(),
    ) -> None:
        self._context, self._arm, self._labels, self.config = context, arm, labels, config

    def render_random(self, scene: Scene, count: int, rng: Rng) -> GraspViews:
        """Return up to `count` random views of a scene; views with few object points are discarded.

        Raises:
            SimulationError: A model cannot be loaded.
            DataFormatError: A mesh of a model cannot be read.
        """
        frames, known = self._sample_frames(scene, count, rng).tolist(), self._load_grasps(scene)
        labelled = {frame: self._label_frame(scene, known, frame) for frame in sorted(set(frames))}
        poses = ((labelled[frame], self._sample_joints(labelled[frame], rng)) for frame in frames)
        return self._render(scene, poses, rng)

    def render_poses(self, scene: Scene, poses: Iterable[tuple[int, Array]], rng: Rng) -> GraspViews:
        """Return views of a scene at given times, rendered with the arm at given joints.

        Args:
            scene: Recorded scene.
            poses: Pairs of the index of a frame (1 ms) and the arm joints (7,) (rad).
            rng: Random generator that selects the points to keep.
        """
        known = self._load_grasps(scene)
        return self._render(scene, ((self._label_frame(scene, known, frame), joints) for frame, joints in poses), rng)

    def _render(self, scene: Scene, poses: Iterable[tuple[LabelledFrame, Array]], rng: Rng) -> GraspViews:
        camera = RayCamera(scene.assets, self._context.config.physics)
        rendered = [self._render_view(scene, camera, frame, joints, rng) for frame, joints in poses]
        views = [view for view in rendered if view is not None]
        config, half = self.config, np.float16
        hands = [(half, (config.max_hand_points, 3)), (np.uint8, ())]
        grasps = [(half, (config.max_grasps, 7)), (half, (config.max_grasps,))]
        columns = [(half, (config.n_object_points, 3)), *hands, *grasps, *[(half, (3,))] * 3]
        return stack_samples(GraspViews, views, columns)

    def _load_grasps(self, scene: Scene) -> LabelledGrasps:
        """Return the grasps of the object, with offset ones for its final pose in the recording."""
        last = scene.n_frames - 1
        return self._labels.load_grasps_near_hand(
            scene.info.target_name, read_hand_spheres(scene, last), read_object_pose(scene, last)
        )

    def _label_frame(self, scene: Scene, known: LabelledGrasps, frame: int) -> LabelledFrame:
        pose, hand = read_object_pose(scene, frame), read_hand_spheres(scene, frame)
        return LabelledFrame(frame, pose, known, self._labels.compute_qualities(known, hand, pose))

    def _render_view(
        self, scene: Scene, camera: RayCamera, labelled: LabelledFrame, joints: Array, rng: Rng
    ) -> tuple[Any, ...] | None:
        """Return the fields of `GraspViews` for one view, or None if too little of the object is visible."""
        config, frame, known = self.config, labelled.frame, labelled.known
        has_hand = bool(scene.is_hand_present(np.array([frame]))[0])
        robot = np.array([*joints, OPEN, OPEN], dtype=np.float32)
        snapshot = JointSnapshot(robot, scene.hand_dof[frame] if has_hand else None, scene.object_dof[frame])
        image = camera.render_targets(snapshot)
        object_points, hand_points = (
            deproject(image.depth, image.compute_mask(label))
            for label in (SegmentationLabel.TARGET, SegmentationLabel.HAND)
        )
        if len(object_points) < config.min_points:
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
        velocity, motion = (to_link.apply(vector) for vector in self._read_motion(scene, frame))
        wanted = config.n_object_points
        chosen = rng.choice(len(object_points), wanted, replace=len(object_points) < wanted)
        return object_points[chosen], hands, n_hands, grasps, quality, center, velocity, motion

    def _read_motion(self, scene: Scene, frame: int) -> tuple[Array, Array]:
        """Return velocity (m/s) and coming displacement (m) of the object in the world, both (3,)."""
        config, path = self.config, scene.object_dof[:, 0, :3].astype(np.float64)
        before, after = max(frame - config.velocity_window, 0), min(frame + config.motion_window, len(path) - 1)
        return (path[frame] - path[before]) / (0.001 * config.velocity_window), path[after] - path[frame]

    def _sample_frames(self, scene: Scene, count: int, rng: Rng) -> npt.NDArray[np.int_]:
        config, path = self.config, scene.object_dof[:, 0, :3]
        picked = int(np.argmax(np.linalg.norm(path - path[0], axis=1) > config.pickup_distance))
        kinds = rng.random(count)
        moving = rng.integers(picked, len(path), count)
        lying = rng.integers(0, max(picked, 1), count)
        frames: npt.NDArray[np.int_] = np.where(kinds < config.last_frame_share, len(path) - 1, moving)
        return np.where(kinds > 1.0 - config.before_pickup_share, lying, frames)

    def _sample_joints(self, labelled: LabelledFrame, rng: Rng) -> Array:
        """Return random arm joints (7,) from which to render (rad)."""
        config, kind = self.config, rng.random()
        waiting = (WAITING_JOINTS, self._context.panda.start_joints)[rng.integers(2)]
        start = np.array(waiting[:ARM_DOF]) + rng.normal(0.0, config.joint_noise_std, ARM_DOF)
        good = labelled.quality > self._labels.config.min_quality
        if kind < config.waiting_pose_share or not good.any():
            return start
        goal = self._sample_pose(labelled, int(rng.choice(np.flatnonzero(good))), rng)
        seeds = np.concatenate([start[None], IK_SEEDS, FALLBACK_IK_SEEDS])
        solutions, converged = self._arm.solve(np.tile(goal, (len(seeds), 1)), seeds, _IK_ITERATIONS)
        if not converged.any():
            return start
        joints: Array = solutions[int(np.argmax(converged))]
        is_between = kind < config.waiting_pose_share + config.between_share
        return start + rng.random() * (joints - start) if is_between else joints

    def _sample_pose(self, labelled: LabelledFrame, number: int, rng: Rng) -> Array:
        """Return a random world pose (7,) of the hand link on the way to a grasp."""
        config = self.config
        distance = config.max_distance * rng.random() ** 1.5
        lateral = (config.lateral_rms + config.lateral_slope * distance) * rng.normal(size=3) / np.sqrt(3.0)
        angle = (config.angle_rms + config.angle_slope * distance) * rng.normal(size=3) / np.sqrt(3.0)
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
