"""Rollouts in GA-DDPG's protocol without physics, which generate imitation states.

The object rests, the arm lags behind its targets, and the wrist camera is rendered by ray casting.
The memory of point clouds, their resampling, the counter of decisions and the rule that ends an
approach are the same as in the receiver. The expert acts at first, in some decisions with noise,
and then the network acts (DAgger; Ross et al., AISTATS 2011). Every observation becomes a state
with the expert's goal as its label.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.geometry.panda import OPEN
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.learning.imitation.gaddpg.expert import ExpertPlan, GraspExpert, GraspExpertConfig, KinematicArm
from handover_marl.learning.imitation.gaddpg.scenarios import ImitationScenario, find_occluded_points
from handover_marl.learning.imitation.gaddpg.states import ImitationStates, StateRow, stack_states
from handover_marl.receivers.gaddpg import GRIPPER_POINTS, PointCloudMemory
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import CAMERA_POSITION_IN_HAND, deproject
from handover_marl.simulation.camera.ray_camera import RayCamera

Array = npt.NDArray[np.float64]
#: Function from clouds (n, 4, 1024) and numbers of remaining decisions (n,) to steps (n, 6).
StepPolicy = Callable[[Array, Array], npt.NDArray[np.floating]]


@dataclass(frozen=True)
class ImitationRolloutConfig:
    """Configuration of the imitation rollouts.

    Attributes:
        max_decisions: Largest number of decisions in a rollout.
        start_on_path_probability: Probability that the arm starts at a waypoint of the planned trajectory.
        expert_decisions: Largest number of the expert's decisions before the network acts.
        expert_start_probability: Probability that the expert makes the first decisions of a rollout of the network.
        noisy_step_probability: Probability that random noise is added to a step of the expert.
        position_noise_std: Standard deviation of this noise on the translation along each axis (m).
        rotation_noise_std: Standard deviation of this noise on the rotation about each axis (rad).
    """

    max_decisions: int = 24
    start_on_path_probability: float = 0.3
    expert_decisions: int = 10
    expert_start_probability: float = 0.5
    noisy_step_probability: float = 0.3
    position_noise_std: float = 0.025
    rotation_noise_std: float = 0.12


@dataclass(eq=False)
class _Rollout:
    """State of one rollout."""

    scenario: ImitationScenario
    plan: ExpertPlan
    rng: np.random.Generator
    joints: Array
    memory: PointCloudMemory
    n_expert_decisions: int
    camera: RayCamera
    is_over: bool = False


class ImitationRollouts:
    """Simulator of imitation rollouts in lockstep, so that the network is evaluated in batches.

    Args:
        arm: Model of the arm as the receiver `gaddpg` controls it.
        expert: Expert that labels states.
        physics: Poses of robot and table.
        load_assets: Function that returns the models to render for a YCB class name.
        config: Configuration of the rollouts.
        expert_config: Configuration of the expert's selection of grasps.
    """

    def __init__(
        self,
        arm: KinematicArm,
        expert: GraspExpert,
        physics: PhysicsConfig,
        load_assets: Callable[[str], SceneAssets],
        config: ImitationRolloutConfig,
        expert_config: GraspExpertConfig,
    ) -> None:
        self._arm, self._expert, self._physics, self._load_assets = arm, expert, physics, load_assets
        self._config, self._expert_config = config, expert_config

    def run(
        self, scenarios: Sequence[ImitationScenario], plans: Sequence[ExpertPlan], policy: StepPolicy | None, seed: int
    ) -> ImitationStates:
        """Return the imitation states of one rollout of each scenario.

        Args:
            scenarios: Initial states of the rollouts.
            plans: Plan of the expert in each scenario.
            policy: Policy of the network; None lets the expert act in all decisions.
            seed: Number that seeds the random numbers, together with the numbers of the scenarios.
        """
        rollouts = [
            self._start_rollout(scenario, plan, policy is not None, np.random.default_rng((seed, scenario.number)))
            for scenario, plan in zip(scenarios, plans, strict=True)
        ]
        states: list[StateRow] = []
        for number in range(self._config.max_decisions):
            running = [rollout for rollout in rollouts if not rollout.is_over]
            observed = [
                (rollout, cloud) for rollout in running if (cloud := self._observe(rollout, states)) is not None
            ]
            for (rollout, _), step in zip(observed, self._compute_steps(observed, policy, number), strict=True):
                rollout.memory.remaining -= 1
                rollout.joints = self._arm.move(rollout.joints, step)
                is_caged = rollout.memory.is_object_caged(self._base_from_hand(rollout))
                rollout.is_over = rollout.memory.remaining == 0 or is_caged
        return stack_states(states)

    def _start_rollout(
        self, scenario: ImitationScenario, plan: ExpertPlan, has_network: bool, rng: np.random.Generator
    ) -> _Rollout:
        config, joints = self._config, scenario.joints
        memory = PointCloudMemory(seed=int(rng.integers(2**31)))
        if rng.random() < config.start_on_path_probability:
            # At the last waypoints the fingers already enclose the object.
            first = int(rng.integers(max(1, len(plan.trajectory) - 3)))
            joints, memory.remaining = plan.trajectory[first], max(3, memory.remaining - first)
        n_expert = config.max_decisions
        if has_network:
            starts = rng.random() < config.expert_start_probability
            n_expert = int(rng.integers(config.expert_decisions + 1)) if starts else 0
        camera = RayCamera(self._load_assets(scenario.object_name), self._physics)
        return _Rollout(scenario, plan, rng, joints, memory, n_expert, camera)

    def _observe(self, rollout: _Rollout, states: list[StateRow]) -> Array | None:
        """Return the network's cloud (4, 1024) and append a state; None if the object was never visible."""
        scenario, memory = rollout.scenario, rollout.memory
        robot = np.array([*rollout.joints, OPEN, OPEN], dtype=np.float32)
        image = rollout.camera.render_targets(JointSnapshot(robot, None, scenario.dof[None]))
        points = deproject(image.depth, image.compute_mask(SegmentationLabel.TARGET))
        hand = self._arm.arm.compute_hand_pose(rollout.joints)
        if scenario.occluder[3] > 0.0 and len(points):
            camera = np.array(CAMERA_POSITION_IN_HAND)
            points = points[~find_occluded_points(points, hand, camera, scenario.occluder)]
        base_from_hand = self._base_from_hand(rollout)
        memory.update(points, base_from_hand)
        if memory.cloud.shape[1] == 0:
            rollout.is_over = True
            return None
        cloud = memory.make_network_input(base_from_hand)[:, GRIPPER_POINTS.shape[1] :]
        n_distinct = min(memory.cloud.shape[1], cloud.shape[1])
        goal = compose(invert_pose(hand), rollout.plan.choose_goal(hand, self._expert_config))
        states.append((cloud[:3, :n_distinct].T, goal, memory.remaining))
        return cloud

    def _compute_steps(
        self, observed: Sequence[tuple[_Rollout, Array]], policy: StepPolicy | None, number: int
    ) -> list[Array]:
        """Return the next step of every rollout, by the expert or by the network."""
        steps: list[Array | None] = [
            self._compute_expert_step(rollout) if number < rollout.n_expert_decisions else None
            for rollout, _ in observed
        ]
        missing = [index for index, step in enumerate(steps) if step is None]
        if missing and policy is not None:
            clouds = np.stack([observed[index][1] for index in missing])
            remaining = np.array([float(observed[index][0].memory.remaining) for index in missing])
            for index, step in zip(missing, policy(clouds, remaining), strict=True):
                steps[index] = np.asarray(step, dtype=np.float64)
        return [step for step in steps if step is not None]

    def _compute_expert_step(self, rollout: _Rollout) -> Array:
        """Return the expert's step, with a random disturbance in some decisions."""
        config, rng = self._config, rollout.rng
        hand = self._arm.arm.compute_hand_pose(rollout.joints)
        goal = rollout.plan.choose_goal(hand, self._expert_config)
        step = self._expert.compute_step(hand, goal, rollout.memory.remaining)
        noise = rng.standard_normal(6) * np.repeat([config.position_noise_std, config.rotation_noise_std], 3)
        disturbed: Array = step + noise * (rng.random() < config.noisy_step_probability)
        return disturbed

    def _base_from_hand(self, rollout: _Rollout) -> Array:
        """Return the pose (4, 4) of the hand in the robot's base frame."""
        hand = compose(invert_pose(self._arm.arm.base), self._arm.arm.compute_hand_pose(rollout.joints))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(hand[3:]).as_matrix(), hand[:3]
        return matrix
