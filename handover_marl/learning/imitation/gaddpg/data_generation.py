"""Data for imitation of a planning expert: its plans, and observed states with its goals as labels.

Plans and states are generated in parallel processes and kept in files.

Rollouts follow GA-DDPG's protocol without physics: the object rests, the arm lags behind its targets, and the wrist
camera is rendered by ray casting. The memory of point clouds, their resampling, the counter of decisions and the rule
that ends an approach are the same as in the receiver. The expert acts at first, in some decisions with noise, and then
the network acts (DAgger; Ross et al., AISTATS 2011). Every observation becomes a state with the expert's goal as its
label. Results do not depend on the number of processes.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import OptionError
from handover_marl.geometry.panda import OPEN, PANDA_CAMERA
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.learning.imitation.gaddpg.expert import ExpertPlan, GraspExpert, KinematicArm
from handover_marl.learning.imitation.gaddpg.scenarios import (
    ImitationScenario,
    ImitationScenarios,
    find_occluded_points,
)
from handover_marl.learning.imitation.samples import generate_samples, join_samples, stack_samples
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.gaddpg import GRIPPER_POINTS, PointCloudMemory
from handover_marl.simulation.camera.images import JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA, deproject
from handover_marl.simulation.camera.ray_camera import RayCamera

Array = npt.NDArray[np.float64]
#: Function from clouds (n, 4, 1024) and numbers of remaining decisions (n,) to motions (n, 6) in the hand link's frame:
#: translations (m) and extrinsic xyz Euler angles (rad).
StepPolicy = Callable[[Array, Array], npt.NDArray[np.floating]]
ExpertPlans = dict[int, ExpertPlan]

#: Number of scenarios in the task of a worker, and in a file of states.
CHUNK_SIZE = 16
# Largest number of decisions in a rollout.
_MAX_DECISIONS = 24
# Probability that the arm starts at a waypoint of the planned trajectory.
_START_ON_PATH_PROBABILITY = 0.3
# Probability that the expert makes the first decisions of a rollout of the network, and their largest number.
_EXPERT_START_PROBABILITY, _EXPERT_DECISIONS = 0.5, 10
# Probability of random noise on a step of the expert, and its standard deviation on translation (m) and rotation (rad).
_NOISY_STEP_PROBABILITY, _POSITION_NOISE_STD, _ROTATION_NOISE_STD = 0.3, 0.025, 0.12
# Number of points of a stored cloud: that of the network's input.
_N_POINTS = 1024


class ImitationStates(NamedTuple):
    """Arrays of S imitation states: observed point clouds, labelled with the grasps that the expert approaches.

    Repeated points do not change the network's output and are not stored.

    Attributes:
        points: (S, 1024, 3) distinct points in the hand link's frame, in the network's order, then zeros (m).
        n_points: (S,) numbers of distinct points.
        goals: (S, 7) poses of the hand link at the grasp, in the present frame of the hand link, quaternions xyzw.
        remaining: (S,) numbers of decisions that remain in the approach.
    """

    points: npt.NDArray[np.float16]
    n_points: npt.NDArray[np.int32]
    goals: npt.NDArray[np.float32]
    remaining: npt.NDArray[np.int32]


#: Values of one state: points (n, 3), goal (7,) and the number of remaining decisions.
StateRow = tuple[npt.NDArray[np.floating], npt.NDArray[np.floating], int]


def stack_states(rows: list[StateRow]) -> ImitationStates:
    """Stack states (points (n, 3), goal (7,), remaining decisions) in the hand link's frame (m), padded with zeros."""
    columns: list[tuple[npt.DTypeLike, tuple[int, ...]]]
    columns = [(np.float16, (_N_POINTS, 3)), (np.int32, ()), (np.float32, (7,)), (np.int32, ())]
    padded: list[tuple[Any, ...]] = [
        (np.pad(points, ((0, _N_POINTS - len(points)), (0, 0))), len(points), goal, remaining)
        for points, goal, remaining in rows
    ]
    return stack_samples(ImitationStates, padded, columns)


@dataclass(eq=False)
class _Rollout:
    """State of one rollout, with the present arm joints (7,) in rad and the number of the expert's first decisions."""

    scenario: ImitationScenario
    plan: ExpertPlan
    rng: np.random.Generator
    joints: Array
    memory: PointCloudMemory
    n_expert_decisions: int
    camera: RayCamera
    is_over: bool = False


@dataclass(frozen=True)
class DataGeneratorConfig:
    """Configuration of the generation of imitation data.

    Attributes:
        scenes: Numbers of the training scenes.
        dataset: Dataset: dexycb, synthetic, or auto.
        data_dir: Folder in HandoverSim's layout.
        seed: Seed of all random numbers.
    """

    scenes: tuple[int, ...]
    dataset: str = "auto"
    data_dir: str | None = None
    seed: int = 0


class RolloutTask(NamedTuple):
    """Task of a worker: imitation rollouts of some scenarios.

    Attributes:
        numbers: Numbers of the scenarios.
        plans: Plans of the expert in these scenarios.
        repetition: Index of the repetition of the rollouts, which seeds the random numbers.
    """

    numbers: list[int]
    plans: list[ExpertPlan]
    repetition: int


class DataGenerator:
    """Generator of the expert's plans and of imitation states in one process.

    Rollouts run in lockstep, so that the network is evaluated in batches.

    Args:
        config: Configuration of the data generation.

    Raises:
        HandoverError: The dataset cannot be opened.
    """

    def __init__(self, config: DataGeneratorConfig) -> None:
        self._data, self._seed = open_dataset(config.dataset, config.data_dir, PANDA_CAMERA), config.seed
        context = make_policy_context(self._data)
        self._arm = KinematicArm(context)
        self._scenarios = ImitationScenarios(self._data, config.scenes, self._arm.arm, context.panda, config.seed)
        self._expert = GraspExpert(context, self._arm)
        self._scenes = {self._data.load_info(scene).target_name: scene for scene in reversed(config.scenes)}
        self._load_assets = functools.cache(self._read_assets)

    def plan(self, number: int) -> ExpertPlan:
        """Return the expert's plan in the scenario with a number; the plan has no goals if no grasp is reachable."""
        return self._expert.plan(self._scenarios.sample(number))

    def collect_states(self, task: RolloutTask, policy: StepPolicy | None) -> ImitationStates:
        """Return the imitation states of one rollout of each scenario of a task.

        Args:
            task: Scenarios with the expert's plans in them.
            policy: Function of the network that acts, in some rollouts after the expert; None lets the expert act.
        """
        seed = self._seed + 1_000_003 * (task.repetition + 1)
        rollouts = [
            self._start_rollout(number, plan, policy is not None, np.random.default_rng((seed, number)))
            for number, plan in zip(task.numbers, task.plans, strict=True)
        ]
        states: list[StateRow] = []
        for number in range(_MAX_DECISIONS):
            running = [rollout for rollout in rollouts if not rollout.is_over]
            observed = [
                (rollout, cloud) for rollout in running if (cloud := self._observe(rollout, states)) is not None
            ]
            for (rollout, _), step in zip(observed, self._compute_steps(observed, policy, number), strict=True):
                rollout.memory.remaining -= 1
                rollout.joints = self._arm.compute_next_joints(rollout.joints, step)
                is_caged = rollout.memory.is_object_caged(self._base_from_hand(rollout))
                rollout.is_over = rollout.memory.remaining == 0 or is_caged
        return stack_states(states)

    def _start_rollout(self, number: int, plan: ExpertPlan, has_network: bool, rng: np.random.Generator) -> _Rollout:
        scenario = self._scenarios.sample(number)
        joints = scenario.joints
        memory = PointCloudMemory(seed=int(rng.integers(2**31)))
        if rng.random() < _START_ON_PATH_PROBABILITY:
            # At the last waypoints the fingers already enclose the object.
            first = int(rng.integers(max(1, len(plan.trajectory) - 3)))
            joints, memory.remaining = plan.trajectory[first], max(3, memory.remaining - first)
        n_expert = _MAX_DECISIONS
        if has_network:
            starts = rng.random() < _EXPERT_START_PROBABILITY
            n_expert = int(rng.integers(_EXPERT_DECISIONS + 1)) if starts else 0
        camera = RayCamera(self._load_assets(scenario.object_name), OFFICIAL_CONFIG.physics)
        return _Rollout(scenario, plan, rng, joints, memory, n_expert, camera)

    def _observe(self, rollout: _Rollout, states: list[StateRow]) -> Array | None:
        """Render a view, append its state to `states`, and return the network's cloud (4, 1024).

        If the object was never visible, end the rollout and return None.
        """
        scenario, memory = rollout.scenario, rollout.memory
        robot = np.array([*rollout.joints, OPEN, OPEN], dtype=np.float32)
        image = rollout.camera.render_targets(JointSnapshot(robot, None, scenario.dof[None]))
        points = deproject(image.depth, image.compute_mask(SegmentationLabel.TARGET))
        hand = self._arm.arm.compute_hand_pose(rollout.joints)
        if scenario.occluder[3] > 0.0 and len(points):
            camera = np.array(WRIST_CAMERA.position)
            points = points[~find_occluded_points(points, hand, camera, scenario.occluder)]
        base_from_hand = self._base_from_hand(rollout)
        memory.update(points, base_from_hand)
        if memory.cloud.shape[1] == 0:
            rollout.is_over = True
            return None
        cloud = memory.make_network_input(base_from_hand)[:, GRIPPER_POINTS.shape[1] :]
        n_distinct = min(memory.cloud.shape[1], cloud.shape[1])
        goal = compose(invert_pose(hand), rollout.plan.choose_goal(hand))
        states.append((cloud[:3, :n_distinct].T, goal, memory.remaining))
        return cloud

    def _compute_steps(
        self, observed: Sequence[tuple[_Rollout, Array]], policy: StepPolicy | None, number: int
    ) -> list[Array]:
        """Return the next motion (6,) of the hand link in every rollout (m, rad), by the expert or the network.

        `observed` has the rollouts and their clouds (4, 1024), and `number` is the index of the decision.
        """
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
        """Return the expert's motion (6,) of the hand link (m, rad), with random noise in some decisions."""
        rng = rollout.rng
        hand = self._arm.arm.compute_hand_pose(rollout.joints)
        goal = rollout.plan.choose_goal(hand)
        step = self._expert.compute_step(hand, goal, rollout.memory.remaining)
        noise = rng.standard_normal(6) * np.repeat([_POSITION_NOISE_STD, _ROTATION_NOISE_STD], 3)
        disturbed: Array = step + noise * (rng.random() < _NOISY_STEP_PROBABILITY)
        return disturbed

    def _base_from_hand(self, rollout: _Rollout) -> Array:
        """Return the pose (4, 4) of the Panda's hand link in the frame of the robot's base (m)."""
        hand = compose(invert_pose(self._arm.arm.base), self._arm.arm.compute_hand_pose(rollout.joints))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(hand[3:]).as_matrix(), hand[:3]
        return matrix

    def _read_assets(self, object_name: str) -> SceneAssets:
        """Return the model files of a scene in which an object is handed over, without the other objects."""
        assets = self._data.load_scene(self._scenes[object_name]).assets
        return replace(assets, objects=assets.objects[:1])


def list_shared_scenes(data: Dataset, setups: Sequence[str]) -> tuple[int, ...]:
    """Return the scenes in the training splits of all given setups whose object has known grasps.

    Raises:
        OptionError: There are no such scenes.
    """
    common = set.intersection(*(set(data.list_scenes(setup, "train")) for setup in setups)) if setups else set[int]()
    scenes = tuple(scene for scene in sorted(common) if data.load_grasps(data.load_info(scene).target_name) is not None)
    if not scenes:
        raise OptionError(f"setups must share training scenes with known grasps, got {list(setups)}")
    return scenes


def make_plans(folder: Path, config: DataGeneratorConfig, count: int, workers: int | None) -> ExpertPlans:
    """Return the expert's plans in scenarios 0 to `count` - 1; compute plans that are not on disk.

    Scenarios without a reachable grasp are left out.

    Args:
        folder: Folder of the files of plans, for one configuration only.
        config: Configuration of the data generation.
        count: Number of scenarios.
        workers: Number of worker processes; default: one per core.

    Raises:
        ResultsError: A file is damaged or cannot be written.
        OptionError: No grasp is reachable in any scenario.
    """
    found = generate_samples(ExpertPlan, folder, range(count), lambda: DataGenerator(config).plan, "plans", workers)
    plans = {number: plan for number, plan in enumerate(found) if len(plan.goals)}
    if not plans:
        raise OptionError("the expert can reach no grasp in any scenario")
    return plans


def collect_states(
    folder: Path, config: DataGeneratorConfig, tasks: Sequence[RolloutTask], weights: Path | None, workers: int | None
) -> ImitationStates:
    """Return the imitation states of all rollouts, in the order of the tasks; collect states that are not on disk.

    Args:
        folder: Folder of the files of states, for the same configuration and tasks only.
        config: Configuration of the data generation.
        tasks: Scenarios of the rollouts, with the expert's plans.
        weights: Weight file of the network that acts; None lets the expert act.
        workers: Number of worker processes; default: one per core.
    """

    def make_collector() -> Callable[[int], ImitationStates]:
        generator, policy = DataGenerator(config), None if weights is None else _load_policy(weights)
        return lambda number: generator.collect_states(tasks[number], policy)

    numbers = range(len(tasks))
    return join_samples(generate_samples(ImitationStates, folder, numbers, make_collector, "rollouts", workers))


def _load_policy(weights: Path) -> StepPolicy:
    # Imports PyTorch, which planning does not need.
    import torch

    from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
    from handover_marl.learning.networks.weights import read_network_weights

    torch.set_num_threads(1)
    return read_network_weights(weights, GaddpgNetwork)[0].predict_steps
