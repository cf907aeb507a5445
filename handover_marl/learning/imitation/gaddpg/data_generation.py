"""Data for imitation of a planning expert: the expert's plans, and observed states with its goals as labels.

Rollouts follow GA-DDPG's protocol without physics: the object rests, the arm lags behind its targets, and the wrist
camera is rendered by ray casting. The memory of point clouds, their resampling, the counter of decisions and the rule
that ends an approach are the same as in the receiver `gaddpg`. In the first round of the training the expert acts, in
some decisions with noise; later the network acts (DAgger; Ross et al., AISTATS 2011). Every observation becomes a state
with the expert's goal as label.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import Dataset
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import OptionError
from handover_marl.geometry.panda import OPEN
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.learning.imitation.gaddpg.expert import (
    ExpertPlan,
    GraspExpert,
    ImitationScenario,
    ImitationScenarios,
    find_occluded_points,
)
from handover_marl.learning.imitation.run import stack_samples
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.gaddpg import GRIPPER_POINTS, PointCloudMemory
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import deproject
from handover_marl.simulation.camera.ray_camera import RayCamera

Array = npt.NDArray[np.float64]
#: Function from a cloud (4, 1024) and the number of remaining decisions to the next motion (6,) in the hand link's
#: frame: translation (m) and extrinsic xyz Euler angles (rad).
StepPolicy = Callable[[Array, int], npt.NDArray[np.floating]]

# Largest number of decisions in a rollout.
_MAX_DECISIONS = 24
# Probability that the arm starts at a waypoint of the planned trajectory.
_START_ON_PATH_PROBABILITY = 0.3
# Probability that the expert makes the first decisions of a rollout of the network, and their largest number.
_EXPERT_START_PROBABILITY, _EXPERT_DECISIONS = 0.5, 10
# Probability of random noise on a step of the expert, and its standard deviation on translation (m) and rotation (rad).
_NOISY_STEP_PROBABILITY, _NOISE_STD = 0.3, np.repeat([0.025, 0.12], 3)
# Number of points of the network's input.
_N_POINTS = 1024


class ImitationStates(NamedTuple):
    """Arrays of S imitation states: observed point clouds, labelled with the grasps that the expert approaches.

    Attributes:
        points: (S, 1024, 3) points of the object in the hand link's frame (m); the last ones repeat others if the cloud
            has fewer points.
        goals: (S, 7) poses of the hand link at the grasp, in the present frame of the hand link, quaternions xyzw.
        remaining: (S,) numbers of decisions that remain in the approach.
    """

    points: npt.NDArray[np.float16]
    goals: npt.NDArray[np.float32]
    remaining: npt.NDArray[np.int32]


class DataGenerator:
    """Generator of the expert's plans and of imitation states in one process.

    Args:
        data: Data set of the scenes.
        scenes: Numbers of the training scenes.
        seed: Seed of all random numbers.
    """

    def __init__(self, data: Dataset, scenes: Sequence[int], seed: int) -> None:
        self._data, self._seed = data, seed
        context = make_policy_context(data)
        self._expert = GraspExpert(context)
        self._arm = self._expert.arm
        self._scenarios = ImitationScenarios(data, scenes, self._arm, context.panda, seed)
        self._scenes = {data.load_info(scene).target_name: scene for scene in reversed(scenes)}
        self._load_assets = functools.cache(self._read_assets)

    def plan(self, number: int) -> ExpertPlan:
        """Return the expert's plan in the scenario with the number `number`; it has no goals if planning fails."""
        return self._expert.plan(self._scenarios.sample(number))

    def collect_states(
        self, number: int, plan: ExpertPlan, repetition: int, policy: StepPolicy | None
    ) -> ImitationStates:
        """Return the imitation states of one rollout.

        Args:
            number: Number of the scenario.
            plan: Plan of the expert in the scenario.
            repetition: Index of the rollout among those of the scenario, which seeds its random numbers.
            policy: Function of the network that acts; in half of the rollouts the expert makes up to ten decisions
                before. None lets the expert act alone.
        """
        rng, scenario = np.random.default_rng((self._seed, repetition, number)), self._scenarios.sample(number)
        joints, memory = scenario.joints, PointCloudMemory(seed=int(rng.integers(2**31)))
        if rng.random() < _START_ON_PATH_PROBABILITY:
            # At the last waypoints the fingers already enclose the object.
            first = int(rng.integers(max(1, len(plan.trajectory) - 3)))
            joints, memory.remaining = plan.trajectory[first], max(3, memory.remaining - first)
        n_expert = _MAX_DECISIONS
        if policy is not None:
            starts = rng.random() < _EXPERT_START_PROBABILITY
            n_expert = int(rng.integers(_EXPERT_DECISIONS + 1)) if starts else 0
        camera = RayCamera(self._load_assets(scenario.object_name), OFFICIAL_CONFIG.physics)
        states: list[tuple[Any, ...]] = []
        for decision in range(_MAX_DECISIONS):
            hand, base_from_hand = self._arm.compute_hand_pose(joints), self._compute_base_from_hand(joints)
            memory.update(self._render_points(camera, scenario, joints, hand), base_from_hand)
            if memory.cloud.shape[1] == 0:  # the object was never visible
                break
            cloud = memory.make_network_input(base_from_hand)[:, GRIPPER_POINTS.shape[1] :]
            goal = plan.choose_goal(hand)
            states.append((cloud[:3].T, compose(invert_pose(hand), goal), memory.remaining))
            if policy is None or decision < n_expert:
                step = self._expert.compute_step(hand, goal, memory.remaining)
                step += rng.standard_normal(6) * _NOISE_STD * (rng.random() < _NOISY_STEP_PROBABILITY)
            else:
                step = np.asarray(policy(cloud, memory.remaining), dtype=np.float64)
            memory.remaining -= 1
            joints = self._expert.compute_next_joints(joints, step)
            if memory.remaining == 0 or memory.is_object_caged(self._compute_base_from_hand(joints)):
                break
        columns = [(np.float16, (_N_POINTS, 3)), (np.float32, (7,)), (np.int32, ())]
        return stack_samples(ImitationStates, states, columns)

    def _render_points(self, camera: RayCamera, scenario: ImitationScenario, joints: Array, hand: Array) -> Any:
        """Return the object's visible points (n, 3) in the frame of the hand link (m), whose world pose is `hand`."""
        robot = np.array([*joints, OPEN, OPEN], dtype=np.float32)
        image = camera.render_targets(JointSnapshot(robot, None, scenario.dof[None]))
        points = deproject(image.depth, image.compute_mask(SegmentationLabel.TARGET))
        return points[~find_occluded_points(points, hand, scenario.occluder)]

    def _compute_base_from_hand(self, joints: Array) -> Array:
        """Return the pose (4, 4) of the Panda's hand link in the frame of the robot's base (m) at arm joints (7,)."""
        hand = compose(invert_pose(self._arm.base), self._arm.compute_hand_pose(joints))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(hand[3:]).as_matrix(), hand[:3]
        return matrix

    def _read_assets(self, object_name: str) -> SceneAssets:
        """Return the model files of a scene in which an object is handed over, without the other objects."""
        assets = self._data.load_scene(self._scenes[object_name]).assets
        return replace(assets, objects=assets.objects[:1])


def list_shared_scenes(data: Dataset, setups: Sequence[str]) -> tuple[int, ...]:
    """Return scenes with known grasps in the training splits of all setups; raise OptionError if there are none."""
    common = set.intersection(*(set(data.list_scenes(setup, "train")) for setup in setups)) if setups else set[int]()
    scenes = tuple(scene for scene in sorted(common) if data.load_grasps(data.load_info(scene).target_name) is not None)
    if not scenes:
        raise OptionError(f"setups must share training scenes with known grasps, got {list(setups)}")
    return scenes
