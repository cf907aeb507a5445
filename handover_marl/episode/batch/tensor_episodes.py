"""Handover episodes in MuJoCo Warp: all state is in PyTorch tensors on the device of the simulation."""

import numpy as np

from handover_marl.config import TIME_STEP, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.batch.episodes import Episodes
from handover_marl.episode.batch.tensor_motion import TensorGiverMotion, TensorPlan
from handover_marl.episode.lockstep import RefereeStateBatch, make_judge
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyArray, expand_mask, make_tensor_factory, to_numpy
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.engines import make_device_worlds
from handover_marl.simulation.reference_tracking import ReferenceMotion


class WarpEpisodes(Episodes):
    """Simulator of episodes in MuJoCo Warp, with tensors on the device, the `rows` of methods too.

    Observations agree with those of `MujocoEpisodes` to single precision. Memory of the device is free after `close`,
    once nothing refers to its tensors.

    Args:
        config: Simulated world, protocol and limits of the givers.
        count: Number n of episodes.
        device: Name of the device, "cuda" or "cpu".
    """

    def __init__(self, config: WorldConfig, count: int, device: str) -> None:
        arrays = make_tensor_factory(device)
        super().__init__(config, count, arrays, TensorGiverMotion(count, config.giver, arrays))
        self._worlds = make_device_worlds(config.physics, count, arrays)

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

    def close(self) -> None:
        """Free the simulation."""
        self._worlds.close()

    def _reset_world(self, row: int, scene: Scene, robot_joints: tuple[float, ...]) -> None:
        self.motion.reset(row, scene)
        first = ReferenceMotion(scene.object_dof[:1], scene.hand_dof[:1], scene.is_hand_present(np.array([0])))
        self._worlds.reset(row, scene, first, robot_joints)

    def _split(self, rows: AnyArray) -> list[AnyArray]:
        return [self.arrays.asarray(places) for places in self._worlds.split(to_numpy(rows))]

    def _simulate_worlds(
        self, plan: TensorPlan, robot_targets: AnyArray, steps: int, states: RefereeStateBatch
    ) -> AnyArray:
        judge, rules = make_judge(states, self.config.protocol), self.config.protocol
        return self._worlds.rollout(to_numpy(plan.rows), plan.reference, robot_targets, judge, rules)

    def _release_targets(self, rows: AnyArray) -> None:
        self._worlds.release_targets(rows)

    def _read_world_contacts(self, row: int, released: bool) -> Contacts:
        return self._worlds.read_contacts(row, released)
