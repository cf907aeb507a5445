"""Batch of handover episodes in MuJoCo's physics, with observations, motion and rules as arrays."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.giver_motion import PLANNED_STEPS, GiverMotion, PlannedMotion
from handover_marl.episode.lockstep import RefereeStateBatch, make_judge
from handover_marl.episode.observations import MotionPreview, Observation, giver_observation_space, state_space
from handover_marl.episode.referee import RELEASE_REASONS, Referee, ReleaseReason
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyIntegers, Indices
from handover_marl.geometry.model_files.meshes import check_collision_meshes
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.engines import make_batch_worlds

Flags = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

_VOLUNTARY = RELEASE_REASONS.index(ReleaseReason.VOLUNTARY)
_GIVER_KEYS = ("replay_wrist_poses", "replay_object_poses", "deviation", "holding")


class EpisodeBatch:
    """Simulator of n handover episodes, which are advanced together.

    An episode equals an episode of `handover_marl.episode.episode.Episode` and does not depend on the
    other episodes. The argument `rows` (r,) of methods has the indices of the episodes to which a method
    applies.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number n of episodes.

    Attributes:
        arrays: Creator of arrays in the namespace of this batch.
        config: Simulated world, protocol and limits of the givers.
        motion: Motion of the givers.
        referees: Referee states.
        state: Full state of all episodes after their last `observe`: arrays (n, ...) by the keys of
            `state_space`.
    """

    arrays = NUMPY_ARRAYS

    def __init__(self, config: WorldConfig, count: int) -> None:
        self.config = config
        self.motion = GiverMotion(count, config.giver)
        self._start = RefereeStateBatch.from_states([Referee(config.protocol).get_state()])
        self.referees = RefereeStateBatch(*(np.repeat(array, count) for array in self._start))
        self._scenes: list[Scene | None] = [None] * count
        self.state: Observation = {
            key: np.zeros((count, *(space.shape or ())), dtype=np.float32) for key, space in state_space().items()
        }
        self._preview_space = giver_observation_space(config.giver)
        self._previews: list[MotionPreview | None] = [None] * count
        self._worlds = make_batch_worlds(config.physics, count)

    @property
    def released(self) -> Flags:
        """Whether each person has released the object, (n,)."""
        return np.asarray(self.referees.release_reason >= 0)

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
        self._worlds[row].reset(scene, self.motion.reset(row, scene), self.config.draw_initial_joints(seed))
        self._scenes[row], self._previews[row] = scene, None
        self.referees.assign_rows(np.array([row]), self._start)
        ids = scene.info.object_ids
        for key, values in (("object_mask", np.ones(len(ids))), ("object_classes", ids)):
            self.state[key][row] = 0.0
            self.state[key][row, : len(ids)] = values
        self.state["object_poses"][row] = 0.0

    def advance(self, rows: Indices, robot_targets: Float32, steps: int, giver_actions: Float32) -> None:
        """Simulate up to `steps` physics steps with constant actions, or to each episode's end.

        Args:
            rows: Indices (r,) of running episodes.
            robot_targets: (r, 9) target joint positions, 7 arm (rad) and 2 fingers (m).
            steps: Number of physics steps (1 ms).
            giver_actions: (r, 8) deviations from the recordings.

        Raises:
            SimulationError: The engine failed; the states of all episodes are invalid.
        """
        self._release_voluntarily(rows[(giver_actions[:, 7] > 0.5) & self.motion.holding[rows]])
        while steps > 0 and len(rows):
            planned = min(steps, PLANNED_STEPS)
            reasons = self.referees.release_reason[rows]
            motion = self.motion.plan(rows, planned, giver_actions, reasons >= 0, reasons == _VOLUNTARY)
            self._simulate(motion, robot_targets, planned)
            steps -= planned
            running = self.referees.status[rows] == 0
            rows, robot_targets, giver_actions = rows[running], robot_targets[running], giver_actions[running]

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

    def select_state(self, rows: Indices) -> Observation:
        """Return copies (r, ...) of the full state of episodes at their last `observe`."""
        return {key: values[rows] for key, values in self.state.items()}

    def select_giver_observation(self, rows: Indices) -> Observation:
        """Return the givers' observations (r, ...): state, preview of the recording, deviation."""
        shapes = {key: (len(rows), *(self._preview_space[key].shape or ())) for key in _GIVER_KEYS}
        giver_arrays = {key: np.empty(shape, dtype=np.float32) for key, shape in shapes.items()}
        for index, row in enumerate(rows.tolist()):
            preview = self._previews[row]
            if preview is None:
                preview = self._previews[row] = MotionPreview(self._require_scene(row), self.config.giver)
            poses = preview.read_poses(int(self.motion.frame[row]))
            giver_arrays["replay_wrist_poses"][index], giver_arrays["replay_object_poses"][index] = poses
        giver_arrays["deviation"][:] = self.motion.deviation[rows]
        giver_arrays["holding"][:, 0] = self.motion.holding[rows]
        return {**self.select_state(rows), **giver_arrays}

    def are_grasped(self, rows: Indices) -> Flags:
        """Return whether both fingers touched the object in the last physics step, in each of r episodes."""
        return np.array([self.read_contacts(row).both_fingers_touch for row in rows.tolist()], dtype=bool)

    def read_contacts(self, row: int) -> Contacts:
        """Return the contacts of an episode in the last physics step."""
        if self.referees.steps[row] == 0:
            return Contacts()
        return self._worlds[row].read_contacts(bool(self.released[row]))

    def make_infos(self, rows: Indices) -> dict[str, AnyIntegers]:
        """Return arrays (r,) of scene numbers, status bits, physics steps, and steps and reasons of release."""
        referees = self.referees
        return {
            "scene_id": np.array([self._require_scene(row).info.scene_id for row in rows.tolist()], dtype=np.int_),
            "status": referees.status[rows],
            "steps": referees.steps[rows],
            "release_step": referees.release_step[rows],
            "release": referees.release_reason[rows],
        }

    def close(self) -> None:
        """Free the simulation."""
        for world in self._worlds:
            world.close()

    def _release_voluntarily(self, rows: Indices) -> None:
        """Release the objects that are still held, by the givers' choice."""
        rows = rows[self.referees.release_reason[rows] < 0]
        self.referees.release_reason[rows], self.referees.release_step[rows] = _VOLUNTARY, self.referees.steps[rows]
        for row in rows.tolist():
            self._worlds[row].release_target()

    def _simulate(self, motion: PlannedMotion, robot_targets: Float32, steps: int) -> None:
        worlds = [self._worlds[row] for row in motion.rows.tolist()]
        for world, reference in zip(worlds, motion.references, strict=True):
            world.set_reference(reference)
        states = self.referees.select_rows(motion.rows)
        rules = self.config.protocol
        simulated = worlds[0].rollout(worlds, robot_targets.tolist(), steps, make_judge(states, rules), rules)
        self.referees.assign_rows(motion.rows, states)
        self.motion.commit(motion, simulated)

    def _require_scene(self, row: int) -> Scene:
        scene = self._scenes[row]
        if scene is None:
            raise ValueError(f"episode {row} has no scene; call reset() first")
        return scene
