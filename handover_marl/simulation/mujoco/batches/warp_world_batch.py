"""Worlds of many episodes in MuJoCo Warp; the state of robots, objects and hands stays on the device."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, OBJECT_DOF, HandConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError, SimulationError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, expand_mask, make_constant, to_numpy
from handover_marl.geometry.kinematic_tree import TreeBatch, read_tree
from handover_marl.geometry.rotations import quaternions_from_euler, quaternions_from_matrices
from handover_marl.simulation.mujoco.batches.warp_group import StepControls, WarpGroup
from handover_marl.simulation.mujoco.batches.warp_model import compute_layout, load_padded_model
from handover_marl.simulation.mujoco.control import ABSENT
from handover_marl.simulation.mujoco.engine import WXYZ, bullet_xyzw_from_wxyz, configure_engine
from handover_marl.simulation.reference_tracking import ReferenceMotion, list_hand_motors, select_keypoint_links
from handover_marl.simulation.world import Contacts, JudgeFunction, WorldState


class DeviceHands:
    """Human hands of n worlds, which track their reference motions without contact, as `BodyTrajectory` does.

    The hands may have different sizes, but have the same joints. Methods apply to the r worlds whose indices are in
    their argument `rows` (r,); other arrays have r rows.

    Args:
        count: Number n of worlds.
        config: Motors of the hands' joints.
        arrays: Creator of tensors on the device.

    Attributes:
        joints: Joint positions (n, 51) (m, rad), undefined without a hand.
        present: Whether there is a hand, (n,).
    """

    def __init__(self, count: int, config: HandConfig, arrays: ArrayFactory) -> None:
        self._arrays = arrays
        self._gains = arrays.asarray([motor.position_gain for motor in list_hand_motors(config)], "float64")
        self.joints, self.present = arrays.zeros((count, HAND_DOF)), arrays.zeros(count, "bool")
        self._hands, self._trees = arrays.zeros(count, "int64"), TreeBatch("hands", arrays)
        self._keypoint_links: AnyArray = None

    def reset(self, row: int, urdf: Path, joints: npt.NDArray[np.float32] | None) -> None:
        """Set the hand of world `row` to the model `urdf` at `joints` (51,) (m, rad), None if it is absent at first."""
        self._hands[row], self.present[row] = self._trees.add(urdf), joints is not None
        if self._keypoint_links is None:
            self._keypoint_links = self._arrays.asarray(select_keypoint_links(read_tree(urdf).moving_links))
        if joints is not None:
            self.joints[row] = self._arrays.asarray(joints, "float64")

    def track(self, rows: AnyArray, targets: AnyArray, present: AnyArray) -> AnyArray:
        """Compute the joint positions (r, k, 51) of hands that track targets in k steps, without changing the hands.

        Args:
            rows: Indices (r,) of the worlds.
            targets: Joint targets (r, k, 51) (m, rad).
            present: Whether the hand is in the scene in each step, (r, k).
        """
        xp = self._arrays.xp
        wanted = xp.astype(targets, xp.float64)
        before, was_present, joints = self.joints[rows], self.present[rows], []
        for step in range(wanted.shape[1]):
            # A hand appears at its target.
            appears = (present[:, step] & ~was_present)[:, None]
            before = xp.where(appears, wanted[:, step], before + self._gains * (wanted[:, step] - before))
            was_present = present[:, step]
            joints.append(before)
        return xp.stack(joints, axis=1)

    def store(self, rows: AnyArray, joints: AnyArray, present: AnyArray, steps: AnyArray) -> None:
        """Set hands to their state after some steps of a trajectory.

        Args:
            rows: Indices (r,) of the worlds.
            joints: Joint positions (r, k, 51) after each step (m, rad).
            present: Whether the hand is in the scene after each step, (r, k).
            steps: Number (r,) of steps; with 0 steps, a hand stays as it is.
        """
        xp, places = self._arrays.xp, self._arrays.arange(len(rows))
        moved, last = steps > 0, xp.clip(steps - 1, 0)
        self.joints[rows] = xp.where(moved[:, None], joints[places, last], self.joints[rows])
        self.present[rows] = xp.where(moved, present[places, last], self.present[rows])

    def compute_link_poses(self, rows: AnyArray, joints: AnyArray, links: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Compute world positions (r, k, l, 3) in m and quaternions xyzw (r, k, l, 4) of l links of hands `rows` (r,).

        `joints` (r, k, 51) are k configurations of each hand (m, rad), `links` (l,) the numbers of the links.
        """
        origins, rotations = self._trees.compute_link_frames(self._hands[rows], joints)
        return origins[..., links, :], quaternions_from_matrices(rotations[..., links, :, :])

    def compute_keypoints(self, rows: AnyArray) -> AnyArray:
        """Compute the world positions (r, 16, 3) in m of the wrist and the finger joints of the hands `rows` (r,)."""
        origins, _ = self._trees.compute_link_frames(self._hands[rows], self.joints[rows][:, None])
        return origins[:, 0, self._keypoint_links]


# Number of physics steps whose controls are computed at a time, limited by their memory.
_CHUNK_STEPS = 25


class WarpWorldBatch:
    """Batch of n worlds that MuJoCo Warp simulates together; see `MujocoWorldBatch` for the methods.

    Worlds whose models have different layouts are in different groups, which are simulated one after another.

    Args:
        config: Constants of the worlds.
        count: Number n of worlds.
        arrays: Creator of tensors on the device.
    """

    def __init__(self, config: PhysicsConfig, count: int, arrays: ArrayFactory) -> None:
        configure_engine()
        self._config, self._count, self._arrays = config, count, arrays
        self._hands = DeviceHands(count, config.hand, arrays)
        self._groups: dict[tuple[object, ...], WarpGroup] = {}
        self._group_of: list[WarpGroup | None] = [None] * count
        self._n_objects = arrays.zeros(count, "int64")

    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene into the world with index `row`, and set all its bodies to their start; see `World.reset`."""
        model = load_padded_model(scene.assets, self._config)
        layout = compute_layout(model)
        if layout not in self._groups:
            self._groups[layout] = WarpGroup(model, self._count, self._config, self._arrays)
        group = self._group_of[row] = self._groups[layout]
        group.reset(row, model, robot_joints, start.objects[0])
        self._n_objects[row] = start.objects.shape[1]
        self._hands.reset(row, scene.assets.hand, start.hand[0] if start.hand_present[0] else None)

    def release_targets(self, rows: AnyArray) -> None:
        """Release the target objects of the worlds `rows` (r,) from the human hands before the next step."""
        for group in self._groups.values():
            group.released[rows] = True

    def rollout(
        self,
        rows: AnyArray,
        reference: ReferenceMotion,
        robot_targets: AnyArray,
        judge: JudgeFunction,
        rules: ProtocolConfig,
    ) -> AnyArray:
        """Simulate r worlds for all steps of `reference`, or until their episodes end; return step counts (r,).

        Arguments are as in `MujocoWorldBatch.rollout`; `judge` is called after every step, for each group of worlds.
        Worlds whose episodes have ended keep their last state.
        """
        simulated = self._arrays.zeros(len(rows), "int64")
        for group, places in self._split(rows):
            index, own = rows[places], reference.select_rows(places)
            hands = self._hands.track(index, own.hand, own.hand_present)
            rollout = group.start_rollout(index)
            for first in range(0, own.hand.shape[1], _CHUNK_STEPS):
                controls = self._make_controls(group, index, own, hands, slice(first, first + _CHUNK_STEPS))
                controls.targets[..., group.scene.robot_ctrl] = robot_targets[places][:, None]
                for step in range(controls.targets.shape[1]):
                    contacts = group.step(rollout, StepControls(*(array[:, step] for array in controls)), rules)
                    end = judge(places, contacts)
                    group.store_states(rollout, end.steps > 0)
                    group.release_targets(rollout, end.released)
                    simulated[places] += end.steps
                if bool(self._arrays.xp.all(end.ended)):
                    break
            reason = group.finish(rollout)
            if reason is not None:
                raise SimulationError(
                    f"MuJoCo Warp's simulation failed: {reason} To go on, use backend='threads', and report this."
                )
            self._hands.store(index, hands, own.hand_present, simulated[places])
        return simulated

    def read_state(self, rows: AnyArray) -> WorldState:
        """Return the states (r, ...) of the worlds `rows` (r,)."""
        xp, batch = self._arrays.xp, WorldState.from_zeros(len(rows), self._arrays)
        for group, places in self._split(rows):
            index, scene = rows[places], group.scene
            qpos = group.state["qpos"][index]
            positions, quaternions = group.compute_body_poses(index, [scene.gripper])
            objects = qpos[:, scene.object_qpos.start :].reshape(len(index), -1, 7)
            poses = xp.concat([xp.concat([positions, quaternions], axis=-1), objects], axis=1)
            poses = xp.concat([poses[..., :3], bullet_xyzw_from_wxyz(poses[..., 3:])], axis=-1)
            is_object = self._arrays.arange(objects.shape[1]) < self._n_objects[index][:, None]
            batch.robot_joint_position[places] = qpos[:, scene.robot_qpos]
            batch.robot_joint_velocity[places] = group.state["qvel"][index][:, scene.robot_qvel]
            batch.gripper_pose[places] = poses[:, 0]
            batch.object_poses[places, : objects.shape[1]] = xp.where(is_object[..., None], poses[:, 1:], 0.0)
        present = self._hands.present[rows][:, None]
        batch.hand_present[:] = present
        for values, found in (
            (batch.hand_dof_position, self._hands.joints[rows]),
            (batch.hand_keypoints, self._hands.compute_keypoints(rows)),
        ):
            values[:] = xp.where(expand_mask(present, found), found, 0.0)
        return batch

    def are_grasped(self, rows: AnyArray) -> AnyArray:
        """Return a mask (r,) of the worlds `rows` whose fingers both touched the target object in the last step."""
        grasped = self._arrays.zeros(len(rows), "bool")
        for group, places in self._split(rows):
            grasped[places] = group.are_grasped(rows[places])
        return grasped

    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of world `row` in its last step; `released` is as in `World.read_contacts`."""
        ((group, _),) = self._split(self._arrays.asarray([row]))
        return group.read_contacts(row, released)

    def close(self) -> None:
        """Free the memory of all worlds; none can be simulated until its next reset."""
        self._groups.clear()
        self._group_of = [None] * self._count

    def _split(self, rows: AnyArray) -> list[tuple[WarpGroup, AnyArray]]:
        """Return each group that has worlds in `rows` (r,), with the positions of its worlds in `rows`."""
        groups = [self._group_of[row] for row in to_numpy(rows).tolist()]
        if None in groups:
            raise ResetNeededError("a world has no scene; call reset() first")
        return [
            (group, self._arrays.asarray([place for place, own in enumerate(groups) if own is group]))
            for group in self._groups.values()
            if group in groups
        ]

    def _make_controls(
        self, group: WarpGroup, rows: AnyArray, reference: ReferenceMotion, hands: AnyArray, steps: slice
    ) -> StepControls:
        """Return the controls (r, c, ...) of worlds `rows` (r,) of a group in c `steps`; robots' targets are zeros.

        `reference` has k steps, of which `steps` selects c; `hands` (r, k, 51) are the hands' joint positions (m, rad).
        """
        xp, scene = self._arrays.xp, group.scene
        wanted, present = reference.objects[:, steps], reference.hand_present[:, steps, None, None]
        shape = wanted.shape[:2]
        n_objects = (scene.model.nu - scene.object_ctrl.start) // OBJECT_DOF
        targets = self._arrays.zeros((*shape, scene.model.nu), "float32")
        # Actuators drive objects to world positions; the target orientation is that of a mocap body.
        own = targets[..., scene.object_ctrl.start :].reshape(*shape, n_objects, OBJECT_DOF)
        own[..., : OBJECT_DOF // 2] = wanted[..., :n_objects, : OBJECT_DOF // 2]
        targets[..., scene.object_ctrl.start :] = own.reshape(*shape, -1)
        start = scene.rotation_references.start
        positions, quaternions = (
            xp.broadcast_to(array[:, None], (*shape, *array.shape[1:])).clone() for array in group.get_mocap_poses(rows)
        )
        turns = quaternions_from_euler(wanted[..., :n_objects, OBJECT_DOF // 2 :])
        quaternions[..., start : start + n_objects, :] = turns[..., WXYZ]
        links = self._arrays.asarray(scene.hand_links, "int64")
        origins, rotations = self._hands.compute_link_poses(rows, hands[:, steps], links)
        positions[..., scene.hand, :] = xp.where(present, origins, make_constant(ABSENT, origins))
        quaternions[..., scene.hand, :] = xp.astype(rotations[..., WXYZ], xp.float32)
        return StepControls(targets, positions, quaternions)
