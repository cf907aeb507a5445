"""Handover episodes that are advanced together, with observations, motion and rules as arrays."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.giver_motion import PLANNED_STEPS, GiverMotion, PlannedMotion
from handover_marl.episode.lockstep import RefereeStateBatch, make_judge
from handover_marl.episode.observations import MotionPreview, Observation, giver_observation_space, state_space
from handover_marl.episode.referee import RELEASE_REASONS, Referee, ReleaseReason
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, AnyIntegers, ArrayFactory, Indices
from handover_marl.geometry.model_files.meshes import check_collision_meshes
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.engines import make_batch_worlds

Flags = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

_VOLUNTARY = RELEASE_REASONS.index(ReleaseReason.VOLUNTARY)
_GIVER_KEYS = ("replay_wrist_poses", "replay_object_poses", "deviation", "holding")


class Episodes(ABC):
    """Base class of the simulators of n handover episodes, which are advanced together.

    An episode equals an episode of `handover_marl.episode.episode.Episode` and does not depend on the
    other episodes. The argument `rows` (r,) of methods has the indices of the episodes to which a method
    applies. All arrays are in one namespace: NumPy arrays, or PyTorch tensors on one device.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number n of episodes.
        arrays: Creator of arrays.
        motion: `GiverMotion` or `TensorGiverMotion` of n givers.

    Attributes:
        config: Simulated world, protocol and limits of the givers.
        arrays: Creator of arrays.
        motion: Motion of the givers.
        referees: Referee states.
        state: Full state of all episodes after their last `observe`: arrays (n, ...) by the keys of
            `state_space`.
    """

    def __init__(self, config: WorldConfig, count: int, arrays: ArrayFactory, motion: Any) -> None:
        self.config, self.arrays, self.motion = config, arrays, motion
        start = RefereeStateBatch.from_states([Referee(config.protocol).get_state()])
        self._start = RefereeStateBatch(*map(arrays.asarray, start))
        self.referees = RefereeStateBatch(*(arrays.xp.tile(array, (count,)) for array in self._start))
        self.state: Observation = {
            key: arrays.zeros((count, *(space.shape or ())), "float32") for key, space in state_space().items()
        }
        self._scene_ids = arrays.full(count, -1, "int64")

    @property
    def released(self) -> AnyArray:
        """Whether each person has released the object, (n,)."""
        return self.referees.release_reason >= 0

    def reset(self, row: int, scene: Scene, seed: int = 0) -> None:
        """Start an episode of a scene.

        Args:
            row: Index of the episode.
            scene: Scene of the episode.
            seed: Seed of the robot's initial joint positions, if the configuration has noise on them.

        Raises:
            DataNotFoundError, DataFormatError: Files of the scene are missing or damaged.
            SimulationError: The engine cannot load a model.
        """
        for urdf in scene.urdfs:
            check_collision_meshes(urdf)
        self._reset_world(row, scene, self.config.draw_initial_joints(seed))
        self.referees.assign_rows(self.arrays.asarray([row]), self._start)
        self._scene_ids[row], count = scene.info.scene_id, len(scene.info.object_ids)
        for key in ("object_mask", "object_classes", "object_poses"):
            self.state[key][row] = 0.0
        self.state["object_mask"][row, :count] = 1.0
        self.state["object_classes"][row, :count] = self.arrays.asarray(scene.info.object_ids, "float32")

    def advance(self, rows: AnyIndices, robot_targets: AnyArray, steps: int, giver_actions: AnyArray) -> None:
        """Simulate up to `steps` physics steps with constant actions, or to each episode's end.

        Args:
            rows: Indices (r,) of running episodes.
            robot_targets: (r, 9) target joint positions, 7 arm (rad) and 2 fingers (m).
            steps: Number of physics steps (1 ms).
            giver_actions: (r, 8) deviations from the recordings.

        Raises:
            SimulationError: The engine failed; the states of all episodes are invalid.
        """
        held = rows[(giver_actions[:, 7] > 0.5) & self.motion.holding[rows]]
        held = held[self.referees.release_reason[held] < 0]
        self.referees.release_reason[held], self.referees.release_step[held] = _VOLUNTARY, self.referees.steps[held]
        self._release_targets(held)
        for places in self._split(rows):
            group, targets, actions = rows[places], robot_targets[places], giver_actions[places]
            for first in range(0, steps, PLANNED_STEPS):
                self._simulate(group, targets, min(steps - first, PLANNED_STEPS), actions)
                running = self.referees.status[group] == 0
                group, targets, actions = group[running], targets[running], actions[running]
                if not len(group):
                    break

    @abstractmethod
    def observe(self, rows: AnyIndices) -> None:
        """Read the full state of episodes from the simulation into `state`."""

    def select_state(self, rows: AnyIndices) -> Observation:
        """Return copies (r, ...) of the full state of episodes at their last `observe`."""
        return {key: values[rows] for key, values in self.state.items()}

    @abstractmethod
    def select_giver_observation(self, rows: AnyIndices) -> Observation:
        """Return the givers' observations (r, ...): state, preview of the recording, deviation."""

    @abstractmethod
    def are_grasped(self, rows: AnyIndices) -> AnyArray:
        """Return whether both fingers touched the object in the last physics step, in each of r episodes."""

    def read_contacts(self, row: int) -> Contacts:
        """Return the contacts of an episode in the last physics step."""
        if int(self.referees.steps[row]) == 0:
            return Contacts()
        return self._read_world_contacts(row, bool(self.released[row]))

    def make_infos(self, rows: AnyIndices) -> dict[str, AnyArray]:
        """Return arrays (r,) of scene numbers, status bits, physics steps, and steps and reasons of release."""
        referees = self.referees
        return {
            "scene_id": self._scene_ids[rows],
            "status": referees.status[rows],
            "steps": referees.steps[rows],
            "release_step": referees.release_step[rows],
            "release": referees.release_reason[rows],
        }

    @abstractmethod
    def close(self) -> None:
        """Free the simulation."""

    def _simulate(self, rows: AnyIndices, robot_targets: AnyArray, steps: int, giver_actions: AnyArray) -> None:
        reasons, states = self.referees.release_reason[rows], self.referees.select_rows(rows)
        plan = self.motion.plan(rows, steps, giver_actions, reasons >= 0, reasons == _VOLUNTARY)
        simulated = self._simulate_worlds(plan, robot_targets, steps, states)
        self.referees.assign_rows(rows, states)
        self.motion.commit(plan, simulated)

    @abstractmethod
    def _reset_world(self, row: int, scene: Scene, robot_joints: tuple[float, ...]) -> None:
        """Load a scene into a world and start its giver's motion."""

    @abstractmethod
    def _split(self, rows: AnyIndices) -> Sequence[AnyIndices]:
        """Divide r episodes into groups whose worlds are simulated together; return the indices in `rows` of each."""

    @abstractmethod
    def _simulate_worlds(self, plan: Any, robot_targets: AnyArray, steps: int, states: RefereeStateBatch) -> AnyArray:
        """Simulate worlds with a planned motion, and apply the rules to `states`; return the numbers (r,) of steps."""

    @abstractmethod
    def _release_targets(self, rows: AnyIndices) -> None:
        """Release the objects of episodes from the hands."""

    @abstractmethod
    def _read_world_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of a world in the last physics step."""


class MujocoEpisodes(Episodes):
    """Simulator of episodes in MuJoCo's physics on the processor, with NumPy arrays.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number n of episodes.
    """

    def __init__(self, config: WorldConfig, count: int) -> None:
        super().__init__(config, count, NUMPY_ARRAYS, GiverMotion(count, config.giver))
        self._scenes: list[Scene | None] = [None] * count
        self._preview_space = giver_observation_space(config.giver)
        self._previews: list[MotionPreview | None] = [None] * count
        self._worlds = make_batch_worlds(config.physics, count)

    def observe(self, rows: Indices) -> None:
        """Read the full state of episodes from the simulation into `state`."""
        state = self.state
        for row in rows.tolist():
            world_state = self._worlds[row].read_state()
            state["robot_joint_position"][row] = world_state.robot_joint_position
            state["robot_joint_velocity"][row] = world_state.robot_joint_velocity
            state["gripper_pose"][row] = world_state.gripper_pose
            state["object_poses"][row, : len(world_state.object_poses)] = world_state.object_poses
            present = world_state.hand_dof_position is not None
            state["hand_present"][row] = present
            state["hand_dof_position"][row] = world_state.hand_dof_position if present else 0.0
            state["hand_keypoints"][row] = world_state.hand_keypoints if present else 0.0
        state["released"][rows, 0] = self.released[rows]
        state["time"][rows, 0] = self.referees.steps[rows] * TIME_STEP

    def select_giver_observation(self, rows: Indices) -> Observation:
        """Return the givers' observations (r, ...): state, preview of the recording, deviation."""
        shapes = {key: (len(rows), *(self._preview_space[key].shape or ())) for key in _GIVER_KEYS}
        giver_arrays = {key: np.empty(shape, dtype=np.float32) for key, shape in shapes.items()}
        for index, row in enumerate(rows.tolist()):
            scene, preview = self._scenes[row], self._previews[row]
            if scene is None:
                raise ValueError(f"episode {row} has no scene; call reset() first")
            if preview is None:
                preview = self._previews[row] = MotionPreview(scene, self.config.giver)
            poses = preview.read_poses(int(self.motion.frame[row]))
            giver_arrays["replay_wrist_poses"][index], giver_arrays["replay_object_poses"][index] = poses
        giver_arrays["deviation"][:] = self.motion.deviation[rows]
        giver_arrays["holding"][:, 0] = self.motion.holding[rows]
        return {**self.select_state(rows), **giver_arrays}

    def are_grasped(self, rows: Indices) -> Flags:
        """Return whether both fingers touched the object in the last physics step, in each of r episodes."""
        return np.array([self.read_contacts(row).both_fingers_touch for row in rows.tolist()], dtype=bool)

    def close(self) -> None:
        """Free the simulation."""
        for world in self._worlds:
            world.close()

    def _reset_world(self, row: int, scene: Scene, robot_joints: tuple[float, ...]) -> None:
        self._worlds[row].reset(scene, self.motion.reset(row, scene), robot_joints)
        self._scenes[row], self._previews[row] = scene, None

    def _split(self, rows: Indices) -> list[Indices]:
        return [np.arange(len(rows))] if len(rows) else []

    def _simulate_worlds(
        self, plan: PlannedMotion, robot_targets: Float32, steps: int, states: RefereeStateBatch
    ) -> AnyIntegers:
        worlds, rules = [self._worlds[row] for row in plan.rows.tolist()], self.config.protocol
        for world, reference in zip(worlds, plan.references, strict=True):
            world.set_reference(reference)
        return worlds[0].rollout(worlds, robot_targets.tolist(), steps, make_judge(states, rules), rules)

    def _release_targets(self, rows: Indices) -> None:
        for row in rows.tolist():
            self._worlds[row].release_target()

    def _read_world_contacts(self, row: int, released: bool) -> Contacts:
        return self._worlds[row].read_contacts(released)
