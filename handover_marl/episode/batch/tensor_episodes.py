"""Batch of handover episodes in MuJoCo Warp: all state is in PyTorch tensors on the device of the simulation."""

import numpy as np

from handover_marl.config import TIME_STEP, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.batch.tensor_motion import TensorGiverMotion
from handover_marl.episode.giver_motion import PLANNED_STEPS
from handover_marl.episode.lockstep import RefereeStateBatch, make_judge
from handover_marl.episode.observations import Observation, state_space
from handover_marl.episode.referee import RELEASE_REASONS, Referee, ReleaseReason
from handover_marl.geometry.arrays import AnyArray, expand_mask, make_tensor_factory, to_numpy
from handover_marl.geometry.model_files.meshes import check_collision_meshes
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.engines import make_device_worlds
from handover_marl.simulation.reference_tracking import ReferenceMotion

_VOLUNTARY = RELEASE_REASONS.index(ReleaseReason.VOLUNTARY)


class TensorEpisodeBatch:
    """Simulator of n handover episodes on a device; attributes and methods are those of `EpisodeBatch`.

    Arrays are tensors on the device, and so are `rows` (r,), the indices of the episodes to which a method applies.
    Observations agree with those of `EpisodeBatch` to single precision.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number n of episodes.
        device: Name of the device, "cuda" or "cpu".

    Attributes:
        config: Simulated world, protocol and limits of the givers.
        arrays: Creator of tensors on the device.
        motion: Motion of the givers.
        referees: Referee states.
        state: Full state of all episodes after their last `observe`: tensors (n, ...) by the keys of
            `state_space`.
    """

    def __init__(self, config: WorldConfig, count: int, device: str) -> None:
        self.config, self.arrays = config, make_tensor_factory(device)
        arrays = self.arrays
        self.motion = TensorGiverMotion(count, config.giver, arrays)
        start = RefereeStateBatch.from_states([Referee(config.protocol).get_state()])
        self._start = RefereeStateBatch(*map(arrays.asarray, start))
        self.referees = RefereeStateBatch(*(array.repeat(count) for array in self._start))
        self.state: Observation = {
            key: arrays.zeros((count, *(space.shape or ())), "float32") for key, space in state_space().items()
        }
        self._scene_ids = arrays.full(count, -1, "int64")
        self._worlds = make_device_worlds(config.physics, count, arrays)

    @property
    def released(self) -> AnyArray:
        """Whether each person has released the object, (n,)."""
        return self.referees.release_reason >= 0

    def reset(self, row: int, scene: Scene, seed: int = 0) -> None:
        """Start an episode of a scene; see `EpisodeBatch.reset`."""
        for urdf in scene.urdfs:
            check_collision_meshes(urdf)
        self.motion.reset(row, scene)
        first = ReferenceMotion(scene.object_dof[:1], scene.hand_dof[:1], scene.is_hand_present(np.array([0])))
        self._worlds.reset(row, scene, first, self.config.draw_initial_joints(seed))
        self.referees.assign_rows(self.arrays.asarray([row]), self._start)
        self._scene_ids[row], count = scene.info.scene_id, len(scene.info.object_ids)
        for key in ("object_mask", "object_classes", "object_poses"):
            self.state[key][row] = 0.0
        self.state["object_mask"][row, :count] = 1.0
        self.state["object_classes"][row, :count] = self.arrays.asarray(scene.info.object_ids, "float32")

    def advance(self, rows: AnyArray, robot_targets: AnyArray, steps: int, giver_actions: AnyArray) -> None:
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
        for places in self._worlds.split(to_numpy(rows)):
            group = self.arrays.asarray(places)
            group_rows, targets, actions = rows[group], robot_targets[group], giver_actions[group]
            for first in range(0, steps, PLANNED_STEPS):
                self._advance_planned(group_rows, targets, min(steps - first, PLANNED_STEPS), actions)
                running = self.referees.status[group_rows] == 0
                group_rows, targets, actions = group_rows[running], targets[running], actions[running]
                if not len(group_rows):
                    break

    def observe(self, rows: AnyArray) -> None:
        """Read the full state of episodes from the simulation into `state`."""
        xp, state, host = self.arrays.xp, self.state, to_numpy(rows)
        for places in self._worlds.split(host):
            world_state, group_rows = self._worlds.read_state(host[places]), rows[self.arrays.asarray(places)]
            for key in ("robot_joint_position", "robot_joint_velocity", "gripper_pose"):
                state[key][group_rows] = getattr(world_state, key)
            count = world_state.object_poses.shape[1]
            state["object_poses"][group_rows, :count] = (
                world_state.object_poses * state["object_mask"][group_rows, :count, None]
            )
            state["hand_present"][group_rows] = xp.astype(world_state.hand_present[:, None], xp.float32)
            for key in ("hand_dof_position", "hand_keypoints"):
                values = getattr(world_state, key)
                state[key][group_rows] = xp.where(expand_mask(world_state.hand_present, values), values, 0.0)
        state["released"][rows, 0] = xp.astype(self.released[rows], xp.float32)
        steps = xp.astype(self.referees.steps[rows], xp.float64)
        state["time"][rows, 0] = xp.astype(steps * TIME_STEP, xp.float32)

    def select_state(self, rows: AnyArray) -> Observation:
        """Return copies (r, ...) of the full state of episodes at their last `observe`."""
        return {key: values[rows] for key, values in self.state.items()}

    def select_giver_observation(self, rows: AnyArray) -> Observation:
        """Return the givers' observations (r, ...): state, preview of the recording, deviation."""
        xp = self.arrays.xp
        wrists, objects = self.motion.read_previews(rows)
        return {
            **self.select_state(rows),
            "replay_wrist_poses": wrists,
            "replay_object_poses": objects,
            "deviation": self.motion.deviation[rows],
            "holding": xp.astype(self.motion.holding[rows, None], xp.float32),
        }

    def are_grasped(self, rows: AnyArray) -> AnyArray:
        """Return whether both fingers touched the object in the last physics step, in each of r episodes."""
        grasped, host = self.arrays.zeros(len(rows), "bool"), to_numpy(rows)
        for places in self._worlds.split(host):
            contacts = self._worlds.read_contact_batch(host[places], self.config.protocol)
            grasped[self.arrays.asarray(places)] = self.arrays.xp.all(contacts.fingers_touch[0], axis=-1)
        return grasped

    def read_contacts(self, row: int) -> Contacts:
        """Return the contacts of an episode in the last physics step."""
        if int(self.referees.steps[row]) == 0:
            return Contacts()
        return self._worlds.read_contacts(row, bool(self.released[row]))

    def make_infos(self, rows: AnyArray) -> dict[str, AnyArray]:
        """Return tensors (r,) of scene numbers, status bits, physics steps, and steps and reasons of release."""
        referees = self.referees
        return {
            "scene_id": self._scene_ids[rows],
            "status": referees.status[rows],
            "steps": referees.steps[rows],
            "release_step": referees.release_step[rows],
            "release": referees.release_reason[rows],
        }

    def close(self) -> None:
        """Free the simulation; memory of the device is free once nothing refers to its tensors."""
        self._worlds.close()

    def _release_voluntarily(self, rows: AnyArray) -> None:
        """Release the objects that are still held, by the givers' choice."""
        rows = rows[self.referees.release_reason[rows] < 0]
        self.referees.release_reason[rows], self.referees.release_step[rows] = _VOLUNTARY, self.referees.steps[rows]
        self._worlds.release_targets(rows)

    def _advance_planned(self, rows: AnyArray, robot_targets: AnyArray, steps: int, giver_actions: AnyArray) -> None:
        reasons = self.referees.release_reason[rows]
        plan = self.motion.plan(rows, steps, giver_actions, reasons >= 0, reasons == _VOLUNTARY)
        states = self.referees.select_rows(rows)
        judge, rules = make_judge(states, self.config.protocol), self.config.protocol
        simulated = self._worlds.rollout(to_numpy(rows), plan.reference, robot_targets, judge, rules)
        self.referees.assign_rows(rows, states)
        self.motion.commit(plan, simulated)
