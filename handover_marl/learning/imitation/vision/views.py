"""Rendered views of objects in persons' hands, with good grasps: training data of the receiver `vision`.

Objects and hands are posed as in a frame of a recording. The wrist camera is where receivers wait, or at a random pose
on the way to a grasp. Views are ray cast without physics. The quality of a grasp follows from the terms of the grasp
cost of the receiver `reactive` that do not depend on the arm: whether the grasp held in simulation, how well the pads
enclose the object, and the clearance to the person's hand. Next to a hand, copies of the grasps with small offsets are
candidates, too. Quaternions are xyzw.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_DOF
from handover_marl.datasets import Dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import OPEN, WAITING_JOINTS
from handover_marl.geometry.poses import compose, inverse_transform_points, invert_pose, transform_points
from handover_marl.geometry.rotations import quaternions_from_euler
from handover_marl.grasps.graspable_object import compute_hold_costs, find_offset_grasps, load_graspable_object
from handover_marl.learning.imitation.run import stack_samples
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.hand_tracker import HandTracker
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.controller import LIMIT_PADDING
from handover_marl.receivers.reactive.selector import FALLBACK_IK_SEEDS, IK_SEEDS
from handover_marl.receivers.vision.grasp_predictor import N_HAND_POINTS, N_OBJECT_POINTS, sample_points
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import deproject
from handover_marl.simulation.camera.ray_camera import RayCamera
from handover_marl.simulation.reference_tracking import select_keypoint_links

Array = npt.NDArray[np.float64]
Half = npt.NDArray[np.float16]
Rng = np.random.Generator

# Largest number of good grasps that a view stores.
_MAX_GRASPS = 96
# Cost of a grasp at which its quality is 1/e (s), and clearance to the hand below which its quality is 0 (m).
_COST_SCALE, _MIN_CLEARANCE = 3.0, 0.003
#: Quality up to which a grasp is not a target of the network.
MIN_QUALITY = 0.02
#: Largest number of offset copies of grasps that are added next to a hand.
MAX_OFFSET_GRASPS = 120
_IK_ITERATIONS = 12
# Smallest number of visible object points; views with fewer are discarded.
_MIN_POINTS = 30
# Shares of views of the last frame, in which the object is held out, and of frames before the object is picked up.
_LAST_FRAME_SHARE, _BEFORE_PICKUP_SHARE = 0.5, 0.05
# Shares of views for which the arm is near one of its two waiting poses, and for which it is between a waiting pose
# and a pose before a grasp; for the rest it is at a random pose before a grasp.
_WAITING_POSE_SHARE, _BETWEEN_SHARE = 0.1, 0.25
# Largest distance between a grasp and a pose before it, back along the hand's z axis (m).
_MAX_DISTANCE = 0.5
# Root mean square of the length (m) and angle (rad) of the random offset of such a pose at distance 0, and their
# increase per meter of distance from the grasp.
_LATERAL_RMS, _LATERAL_SLOPE, _ANGLE_RMS, _ANGLE_SLOPE = 0.015, 0.25, 0.1, 0.7
# Standard deviation of every arm joint near a waiting pose (rad).
_JOINT_NOISE_STD = 0.08
# Distance from its initial position at which the object counts as picked up (m).
_PICKUP_DISTANCE = 0.03
# Time before a frame over which the object's velocity is averaged, and after it over which its displacement is
# measured (ms).
_VELOCITY_WINDOW, _MOTION_WINDOW = 50, 500


class GraspViews(NamedTuple):
    """Arrays of n views, each in the frame of the Panda's hand link when the view was rendered.

    Attributes:
        object_points: (n, N, 3) points of the object, repeated if few are visible (m).
        hand_points: (n, M, 3) points of the person's hand, then zeros (m).
        n_hand_points: (n,) numbers of points of the person's hand.
        grasps: (n, K, 7) poses (quaternion xyzw) of the robot's hand link at good grasps, best first, then zeros.
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
class Grasps:
    """Grasps of one object with their costs, in the object's frame.

    Attributes:
        poses: (n, 7) poses of the Panda's hand link, quaternions xyzw.
        costs: (n,) costs of the grasps without a person's hand nearby (s); lower is better.
        object_center: (3,) center of the object's bounding box (m).
    """

    poses: Array
    costs: Array
    object_center: Array


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """Frame of a recording with the object's grasps and their qualities.

    Attributes:
        frame: Index of the frame in the recording, which has one every 1 ms.
        object_pose: (7,) pose of the object in the world, quaternion xyzw.
        grasps: Known grasps of the object and offset copies of them, n in number.
        quality: (n,) qualities of the grasps at this frame.
    """

    frame: int
    object_pose: Array
    grasps: Grasps
    quality: Array


class RecordedViewRenderer:
    """Base class of renderers of wrist-camera views of recorded scenes.

    Args:
        data: Data set of the scenes, with the robot that carries the camera.
        count: Number of views to render per scene.
        seed: Seed of all random numbers.
    """

    def __init__(self, data: Dataset, count: int, seed: int) -> None:
        self._data, self._count, self._seed = data, count, seed
        self._context = make_policy_context(data)
        self._arm = ArmInWorld.for_panda(self._context.panda_urdf, self._context.panda, LIMIT_PADDING)

    def draw_waiting_joints(self, noise_std: float, rng: Rng) -> Array:
        """Return arm joints (7,) in rad: one of two waiting poses at random, with normal noise of `noise_std` (rad)."""
        waiting = (WAITING_JOINTS, self._context.panda.start_joints)[rng.integers(2)]
        joints: Array = np.array(waiting[:ARM_DOF]) + rng.normal(0.0, noise_std, ARM_DOF)
        return joints

    def find_joints(self, hand_pose: Array, start: Array) -> Array | None:
        """Return arm joints (7,) in rad for a pose (7,) of the hand link in the world; None if none are found.

        The quaternion is xyzw. Inverse kinematics starts at the joints `start` (7,) and, if that fails, at fixed ones.
        """
        seeds = np.concatenate([start[None], IK_SEEDS, FALLBACK_IK_SEEDS])
        solutions, converged = self._arm.solve(np.tile(hand_pose, (len(seeds), 1)), seeds, _IK_ITERATIONS)
        return solutions[int(np.argmax(converged))] if converged.any() else None


class ViewRenderer(RecordedViewRenderer):
    """Renderer of wrist-camera views of recorded scenes, labelled with good grasps.

    Grasps are validated in simulation at first use.

    Args:
        data: Data set of the scenes, with the robot that carries the camera.
        count: Number of views to render per scene; those that show too little of the object are discarded.
        seed: Seed of all random numbers.
        reactive: Configuration of the receiver `reactive`, whose costs of grasps are used.
    """

    def __init__(self, data: Dataset, count: int, seed: int, reactive: ReactiveConfig | None = None) -> None:
        super().__init__(data, count, seed)
        self._reactive = reactive or ReactiveConfig()

    def render_scene(self, number: int) -> GraspViews:
        """Return random views of the scene `number`; views with fewer than 30 object points are discarded."""
        # Seeded by the scene, so that files do not depend on the number of processes.
        rng, scene = np.random.default_rng((self._seed, number)), self._data.load_scene(number)
        frames = _sample_frames(scene, self._count, rng).tolist()
        labelled = self.label_frames(scene, frames)
        poses = ((labelled[frame], self._sample_joints(labelled[frame], rng)) for frame in frames)
        return self.render(scene, poses, rng)

    def label_frames(self, scene: Scene, frames: Sequence[int]) -> dict[int, LabelledFrame]:
        """Return frames of a scene, by index, with the object's grasps and the qualities that these have in the frames.

        The grasps include offset copies that are clear of the person's hand in the last frame.
        """
        name, last = scene.info.target_name, scene.n_frames - 1
        grasps = self.load_grasps(name, read_hand_spheres(scene, last), read_object_pose(scene, last))
        labelled = {}
        for frame in sorted(set(frames)):
            pose, hand = read_object_pose(scene, frame), read_hand_spheres(scene, frame)
            labelled[frame] = LabelledFrame(frame, pose, grasps, self.compute_qualities(grasps, hand, pose))
        return labelled

    def load_grasps(self, object_name: str, hand: Spheres | None, object_pose: Array) -> Grasps:
        """Return an object's known grasps, and offset copies of them that are clear of the person's hand.

        Args:
            object_name: Class name of the object.
            hand: Spheres that cover the person's hand in the world; None adds no copies.
            object_pose: (7,) pose of the object in the world, quaternion xyzw.
        """
        config = self._reactive
        found = load_graspable_object(self._context, object_name)
        poses, costs = found.grasps.poses, compute_hold_costs(found.grasps, found.pad_margins)
        if hand is None or not len(poses):
            return Grasps(poses, costs, found.center)
        offset, margins = find_offset_grasps(found, hand.transform_to_frame(object_pose), config.approach.standoff)
        offset_costs = config.selection.offset_cost + compute_hold_costs(offset, margins)
        qualities = self.compute_qualities(Grasps(offset.poses, offset_costs, found.center), hand, object_pose)
        kept = np.flatnonzero(qualities > MIN_QUALITY)
        kept = kept[:: max(1, -(-len(kept) // MAX_OFFSET_GRASPS))]
        poses, costs = np.concatenate([poses, offset.poses[kept]]), np.concatenate([costs, offset_costs[kept]])
        return Grasps(poses, costs, found.center)

    def compute_qualities(self, grasps: Grasps, hand: Spheres | None, object_pose: Array) -> Array:
        """Return the qualities (n,) of an object's grasps: exp(-cost / 3 s), from 0 (bad) to 1 (good).

        Args:
            grasps: Grasps of the object.
            hand: Spheres that cover the person's hand in the world; None if there is no hand. A clearance to the hand
                below the desired one adds to the cost; below 3 mm, the quality is 0.
            object_pose: (7,) pose of the object in the world, quaternion xyzw.
        """
        config, costs = self._reactive, grasps.costs
        if hand is None or not len(costs):
            return np.exp(-costs / _COST_SCALE)
        in_object = hand.transform_to_frame(object_pose)
        clearances = compute_grasp_clearances(grasps.poses, in_object, config.approach.standoff)
        lack = np.maximum(0.0, config.selection.desired_clearance - clearances)
        qualities = np.exp(-(costs + config.selection.clearance_cost * lack) / _COST_SCALE)
        return np.where(clearances < _MIN_CLEARANCE, 0.0, qualities)

    def render(self, scene: Scene, poses: Iterable[tuple[LabelledFrame, Array]], rng: Rng) -> GraspViews:
        """Return views of a scene, each of a frame with arm joints (7,) in rad; skip views with few object points."""
        camera = RayCamera(scene.assets, self._context.config.physics)
        rendered = [self._render_view(scene, camera, frame, joints, rng) for frame, joints in poses]
        views = [view for view in rendered if view is not None]
        shapes = ((N_OBJECT_POINTS, 3), (N_HAND_POINTS, 3), (), (_MAX_GRASPS, 7), (_MAX_GRASPS,), (3,), (3,), (3,))
        columns = [(np.float16 if shape else np.uint8, shape) for shape in shapes]
        return stack_samples(GraspViews, views, columns)

    def _render_view(
        self, scene: Scene, camera: RayCamera, labelled: LabelledFrame, joints: Array, rng: Rng
    ) -> tuple[Any, ...] | None:
        """Return the fields of `GraspViews` for one view, or None if too little of the object is visible."""
        frame, object_grasps = labelled.frame, labelled.grasps
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
        best = np.argsort(-labelled.quality, kind="stable")[:_MAX_GRASPS]
        best = best[labelled.quality[best] > MIN_QUALITY]
        grasps, quality = np.zeros((_MAX_GRASPS, 7)), np.zeros(_MAX_GRASPS)
        link_from_object = compose(invert_pose(world_from_link), labelled.object_pose)
        grasps[: len(best)] = compose(link_from_object, object_grasps.poses[best])
        quality[: len(best)] = labelled.quality[best]
        center = transform_points(labelled.object_pose, object_grasps.object_center)
        center = inverse_transform_points(world_from_link, center[None])[0]
        to_link = Rotation.from_quat(world_from_link[3:]).inv()
        velocity, motion = (to_link.apply(vector) for vector in _read_motion(scene, frame))
        points = sample_points(object_points, hand_points, rng)
        return *points, grasps, quality, center, velocity, motion

    def _sample_joints(self, labelled: LabelledFrame, rng: Rng) -> Array:
        """Return random arm joints (7,) in rad for a view: before a good, reachable grasp, waiting, or between."""
        kind = rng.random()
        start = self.draw_waiting_joints(_JOINT_NOISE_STD, rng)
        good = labelled.quality > MIN_QUALITY
        if kind < _WAITING_POSE_SHARE or not good.any():
            return start
        goal = _sample_pose(labelled, int(rng.choice(np.flatnonzero(good))), rng)
        joints = self.find_joints(goal, start)
        if joints is None:
            return start
        is_between = kind < _WAITING_POSE_SHARE + _BETWEEN_SHARE
        return start + rng.random() * (joints - start) if is_between else joints


def _read_motion(scene: Scene, frame: int) -> tuple[Array, Array]:
    """Return the object's velocity (3,) in m/s and displacement (3,) in m in the coming 0.5 s, in the world frame."""
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
    """Return a random world pose (7,) of the hand link on the way to the grasp with index `number`."""
    distance = _MAX_DISTANCE * rng.random() ** 1.5
    lateral = (_LATERAL_RMS + _LATERAL_SLOPE * distance) * rng.normal(size=3) / np.sqrt(3.0)
    angle = (_ANGLE_RMS + _ANGLE_SLOPE * distance) * rng.normal(size=3) / np.sqrt(3.0)
    offset = np.concatenate([lateral - [0.0, 0.0, distance], Rotation.from_rotvec(angle).as_quat()])
    pose: Array = compose(compose(labelled.object_pose, labelled.grasps.poses[number]), offset)
    return pose


def read_object_pose(scene: Scene, frame: int) -> Array:
    """Return the handed-over object's world pose (7,), quaternion xyzw, in the frame with index `frame`."""
    dof = scene.object_dof[frame, 0]
    return np.concatenate([dof[:3], quaternions_from_euler(dof[3:])])


def read_hand_spheres(scene: Scene, frame: int) -> Spheres | None:
    """Return spheres in the world that cover the recorded hand in a frame; None if there is no hand."""
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
