"""World simulated by MuJoCo, with the same bodies, motors and collision masks as in PyBullet."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError
from handover_marl.geometry.arrays import AnyArray, AnyIntegers, Indices
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.simulation.camera.images import JointSnapshot
from handover_marl.simulation.mujoco.batch_simulation import HandKinematics, MujocoRollout, SimulationCache, WorldData
from handover_marl.simulation.mujoco.control import ABSENT, compute_controls, count_hand_free_steps, place_hand
from handover_marl.simulation.mujoco.engine import bullet_xyzw_from_wxyz, chain_joints_from_poses
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.sleep import MAX_WORLDS, RobotOnlySimulation, SleepState
from handover_marl.simulation.reference_tracking import (
    BodyTrajectory,
    ReferenceMotion,
    list_hand_motors,
    select_keypoint_links,
    track_references,
)
from handover_marl.simulation.world import (
    Contacts,
    JudgeFunction,
    RolloutContacts,
    World,
    WorldState,
)

Array = npt.NDArray[np.float64]

# Largest number of steps of a rollout. Steps after a release or an episode's end are discarded: more would waste time.
_ROLLOUT_STEPS = 100


class MujocoWorld(World):
    """World simulated by MuJoCo, alone or in a batch with other worlds.

    The human hand follows its reference motion kinematically, as in `FastWorld` of PyBullet.

    Until a body comes near the robot, or the target object is released, the world sleeps: the robot is simulated
    alone, and objects follow their reference motions. The attributes describe the current episode; row k is step k of
    the current reference motion, and row -1 the state before its first step.

    Args:
        config: Constants of the world.
        window: Not used; only PyBullet has a window.
        cache: MuJoCo's batches, shared with other worlds; None for new ones.

    Attributes:
        robot: Simulation of the robot without hand and objects.
        hand: Trajectory of the human hand under the current reference motion, valid after `track_worlds`.
        hand_kinematics: Forward kinematics of the hand's bodies in the MuJoCo model.
        sleep_state: Sleep state of the world, which `prepare_worlds` may end; None once the world is awake.
        reference: Current reference motion.
        row: Last simulated row of the reference motion.
        robot_target: Nine joint targets of the robot (rad, m) for which the coming steps were prepared; None if they
            must be prepared anew.
        is_tracked: Whether the trajectories of hand and sleeping objects are computed for the current reference motion.
        controls: Controls (n, c) of n steps from `controls_row` on, as `compute_controls` computes them.
        controls_row: Row of the reference motion at which `controls` starts.
        hand_free_steps: Number of steps from `controls_row` on in which the hand cannot touch the robot.
    """

    robot: RobotOnlySimulation
    hand: BodyTrajectory
    hand_kinematics: HandKinematics
    reference: ReferenceMotion

    def __init__(self, config: PhysicsConfig, window: bool = False, cache: SimulationCache | None = None) -> None:
        super().__init__(config)
        self._cache = cache or SimulationCache()
        self._data: WorldData | None = None
        self.sleep_state: SleepState | None = None

    @property
    def data(self) -> WorldData:
        """Model and state of the world; raises `ResetNeededError` before `reset`."""
        if self._data is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        return self._data

    def reset(self, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene; set human hand and objects to the only row of `start`, the robot to nine joints (rad, m)."""
        model, cache = load_scene_model(scene.assets, self._config), self._cache
        data, hand_joints = cache.load_scene(model), start.hand[0] if start.hand_present[0] else None
        self.robot, urdf = cache.get_robot_simulation(model.robot_only), scene.assets.hand
        self.hand = BodyTrajectory(list_hand_motors(self._config.hand), hand_joints)
        self.sleep_state = SleepState(model, self.robot, self._config.objects, start, robot_joints)
        self.reference, self.row, self.is_tracked = start, -1, True
        self.robot_target: list[float] | None = None
        self.controls, self.controls_row, self.hand_free_steps = np.zeros((0, 0)), 0, 0
        self.hand_kinematics = HandKinematics(urdf, model.hand_links)
        self._keypoint_kinematics = HandKinematics(urdf, select_keypoint_links(read_tree(urdf).moving_links))
        data.mocap_pos[model.hand] = ABSENT
        self._is_state_set, self._release_pending = False, False
        # The angles of objects' chains continue from their last values.
        self._object_joints = start.objects[0].astype(np.float64)
        self._data, self._scene = data, scene

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of human hand and objects in the coming steps; row k of `motion` is for step k."""
        # Trajectories continue from the end of the last reference.
        track_worlds([self])
        self._set_state()
        if self.sleep_state is not None:
            self.sleep_state.advance_rows(self.row + 1)
        self.row, self.reference, self.robot_target, self.is_tracked = -1, motion, None, False

    def step(self, robot_target: list[float]) -> None:
        """Simulate one physics step towards nine joint targets of the Panda (rad, m)."""
        prepare_worlds([self], [robot_target])
        self.apply_rollout_step(simulate_worlds([self], 1), 0, 1)

    def rollout(self, robot_target: list[float], steps: int, judge: JudgeFunction, rules: ProtocolConfig) -> int:
        """Simulate up to `steps` physics steps in one call; return their number, see `World.rollout`."""
        return int(rollout_worlds([self], [robot_target], steps, judge, rules)[0])

    @property
    def rollout_key(self) -> tuple[int, ...]:
        """Key that is equal for worlds that can be simulated together; sleeping and awake ones cannot."""
        if self.sleep_state is not None:
            return ()  # Sleeping worlds of all sizes are advanced together.
        model = self.data.scene.model
        return model.nq, model.nu, model.nmocap, model.nsensordata

    @property
    def remaining_steps(self) -> int:
        """Number of steps before the reference motion ends or the sleeping world wakes; call `prepare_worlds` first."""
        left = len(self.reference.objects) - (self.row + 1)
        return left if self.sleep_state is None else min(left, self.sleep_state.count_free_steps(self.row + 1))

    def apply_release(self) -> None:
        """Carry out a release that `release_target` has requested, if there is one; it wakes the world."""
        if self._release_pending:
            self.wake()
            self.data.release_object(self._config.gravity)
            self._release_pending = False

    def wake(self) -> None:
        """Wake the world, if it sleeps: robot and objects are simulated together from the coming step on."""
        if self.sleep_state is not None:
            self._set_state()
            self.data.qvel[self.data.scene.object_qvel] = self.sleep_state.compute_object_velocities(self.row).ravel()
            self.sleep_state, self.robot_target = None, None

    def release_target(self) -> None:
        """Release the target object from the human hand before the next step."""
        self._release_pending = True

    def read_contacts(self, released: bool) -> Contacts:
        """Return the contacts of the last step; read those of the target with table and objects only if `released`."""
        if self.sleep_state is not None:
            return Contacts()
        data = self.data
        return data.scene.contact_sensors.compute_contacts(data.sensordata, data.qpos, released)

    def read_state(self) -> WorldState:
        """Return the current state of robot, human hand and objects, float32."""
        self._set_state()
        data, scene, hand = self.data, self.data.scene, self._get_hand_joints()
        positions, quaternions = self.robot.compute_body_poses(data.qpos[scene.robot_qpos])
        poses = np.concatenate(
            [positions[scene.gripper], quaternions[scene.gripper], data.qpos[scene.object_qpos]]
        ).reshape(-1, 7)
        poses[:, 3:] = bullet_xyzw_from_wxyz(poses[:, 3:])
        keypoints = None if hand is None else self._keypoint_kinematics.compute_poses(hand[None])[0][0]
        return WorldState.from_bodies(
            (data.qpos[scene.robot_qpos].astype(np.float32), data.qvel[scene.robot_qvel].astype(np.float32)),
            poses[0].astype(np.float32),
            poses[1:].astype(np.float32),
            None if hand is None else hand.astype(np.float32),
            None if keypoints is None else keypoints.astype(np.float32),
        )

    def read_joints_float64(self) -> Array:
        """Return the robot's joint positions (9,) in double precision (rad, m)."""
        self._set_state()
        joints: Array = self.data.qpos[self.data.scene.robot_qpos].copy()
        return joints

    def read_joint_snapshot(self) -> JointSnapshot:
        """Return the current joint positions of robot (9,), human hand (51,) or None, and objects (n, 6), float32."""
        robot, hand = self.read_joints_float64().astype(np.float32), self._get_hand_joints()
        poses = self.data.qpos[self.data.scene.object_qpos].reshape(-1, 7)
        self._object_joints = chain_joints_from_poses(poses, self._object_joints)
        objects = self._object_joints.astype(np.float32)
        return JointSnapshot(robot, None if hand is None else hand.astype(np.float32), objects)

    def close(self) -> None:
        """Free the memory of the simulation."""
        super().close()
        self._data = self.sleep_state = None

    def apply_rollout_step(self, rollout: MujocoRollout | None, number: int, steps: int) -> None:
        """Set world `number` of a rollout (None for a sleeping world) to its state after 1 or more `steps` of it."""
        if rollout is not None:
            self.data.set_step(*(array[number, steps - 1] for array in rollout))
        self.row, self._is_state_set = self.row + steps, self.sleep_state is None

    def _set_state(self) -> None:
        """Write the joint state of a sleeping world to `data`, which its steps do not update."""
        if self.sleep_state is not None and not self._is_state_set:
            self.sleep_state.write_state(self.row, self.data.qpos, self.data.qvel)
            self._is_state_set = True

    def _get_hand_joints(self) -> Array | None:
        """Return the current joint positions (51,) of the human hand (m, rad), or None if there is no hand."""
        track_worlds([self])
        return self.hand.get_joints(self.row) if self.hand.is_present_after(self.row) else None

    def get_coming_controls(self, steps: int) -> Array:
        """Return the part (steps, c) of the attribute `controls` for the next `steps` steps."""
        first = self.row + 1 - self.controls_row
        return self.controls[first : first + steps]

    def can_touch_hand(self, steps: int) -> bool:
        """Return whether the human hand can touch the robot within the next `steps` steps."""
        return self.row + 1 - self.controls_row + steps > self.hand_free_steps


def track_worlds(worlds: Sequence[MujocoWorld]) -> None:
    """Compute the trajectories of hands and sleeping objects in those worlds that have a new reference motion."""
    behind = [world for world in worlds if not world.is_tracked]
    hands = [(one.hand, one.reference.hand, one.reference.hand_present) for one in behind]
    objects = [
        (item, one.reference.objects[:, number], None)
        for one in behind
        if one.sleep_state is not None
        for number, item in enumerate(one.sleep_state.objects)
    ]
    track_references([*hands, *objects])
    for world in behind:
        world.is_tracked = True


def _update_sleep(worlds: Sequence[MujocoWorld], robot_targets: Sequence[list[float]]) -> None:
    """Simulate the robots of sleeping worlds with changed targets; wake worlds for a release, or if a body comes near.

    Args:
        worlds: Worlds with a scene.
        robot_targets: Nine joint targets of each robot (rad, m).
    """
    for world in worlds:
        world.apply_release()
    changed: list[tuple[SleepState, int, list[float], BodyTrajectory]] = []
    for world, target in zip(worlds, robot_targets, strict=True):
        if world.sleep_state is not None and world.robot_target != target:
            world.robot_target = target
            changed.append((world.sleep_state, world.row + 1, target, world.hand))
    if changed:
        SleepState.simulate_robots(*zip(*changed, strict=True))
    for world in worlds:
        if world.sleep_state is not None and not world.sleep_state.count_free_steps(world.row + 1):
            world.wake()


def prepare_worlds(worlds: Sequence[MujocoWorld], robot_targets: Sequence[list[float]]) -> None:
    """Prepare worlds for their next steps: compute controls or, in sleeping worlds, robot motions for changed targets.

    Requested releases are carried out, and sleeping worlds wake if a body comes near the robot.

    Args:
        worlds: Worlds with a scene.
        robot_targets: Nine joint targets of each robot (rad, m).
    """
    track_worlds(worlds)
    _update_sleep(worlds, robot_targets)
    groups: dict[tuple[int, ...], list[tuple[MujocoWorld, list[float]]]] = {}
    for world, target in zip(worlds, robot_targets, strict=True):
        if world.sleep_state is None and world.robot_target != target:
            world.robot_target, world.controls_row = target, world.row + 1
            model = world.data.scene.model
            # Models with equally many objects, actuators and mocap bodies have them in the same places.
            steps, objects = world.reference.objects.shape[:2]
            key = (steps - world.controls_row, objects, model.nu, model.nmocap)
            groups.setdefault(key, []).append((world, target))
    for group in groups.values():
        own, data = [world for world, _ in group], [world.data for world, _ in group]
        targets = np.array([target for _, target in group])
        controls = compute_controls(data, targets, np.stack([one.reference.objects[one.controls_row :] for one in own]))
        wrists = np.array([one.hand.get_positions(one.controls_row) for one in own])
        free_steps = count_hand_free_steps(data, [one.robot for one in own], targets, wrists).tolist()
        for number, (world, free) in enumerate(zip(own, free_steps, strict=True)):
            world.controls = controls[number]
            _, *poses = world.data.split_controls(world.controls)
            hand_poses = (array[:, world.data.scene.hand] for array in poses)
            world.hand_free_steps = place_hand(world.hand, world.row, world.hand_kinematics, free, *hand_poses)


def simulate_worlds(worlds: Sequence[MujocoWorld], steps: int) -> MujocoRollout | None:
    """Simulate `steps` steps, at most the `remaining_steps`, of prepared worlds with equal `rollout_key`s.

    The worlds keep their states until `MujocoWorld.apply_rollout_step`. The result is None for sleeping worlds.
    """
    if worlds[0].sleep_state is not None:
        return None
    data, controls = worlds[0].data, np.stack([world.get_coming_controls(steps) for world in worlds])
    sensordata = np.empty((*controls.shape[:2], len(data.sensordata)))
    step_states = np.empty((*controls.shape[:2], data.step_state_size))
    for number, world in enumerate(worlds):
        world.data.simulate(world.can_touch_hand(steps), controls[number], sensordata[number], step_states[number])
    return MujocoRollout(controls, sensordata, step_states)


def _split(numbers: list[int]) -> list[list[int]]:
    """Split the indices of worlds into lists of at most 32, the largest number of worlds that one call simulates."""
    return [numbers[first : first + MAX_WORLDS] for first in range(0, len(numbers), MAX_WORLDS)]


def rollout_worlds(
    worlds: Sequence[MujocoWorld],
    robot_targets: Sequence[list[float]],
    steps: int,
    judge: JudgeFunction,
    rules: ProtocolConfig,
) -> npt.NDArray[np.int_]:
    """Simulate n worlds for `steps` steps, or until their episodes end; return step counts (n,).

    The worlds must have reference motions of at least `steps` steps. `robot_targets` has nine joint targets (rad, m;
    float32 values) for each world. `judge` and `rules` are as in `MujocoWorldBatch.rollout`.
    """
    simulated, running = np.zeros(len(worlds), dtype=np.int_), np.ones(len(worlds), dtype=bool)
    while rows := np.flatnonzero(running & (simulated < steps)).tolist():
        # Preparing a sleeping world may wake it, which changes its key.
        for chunk in _split([row for row in rows if worlds[row].sleep_state is not None]):
            prepare_worlds([worlds[row] for row in chunk], [robot_targets[row] for row in chunk])
        groups: dict[object, list[int]] = {}
        for row in rows:
            groups.setdefault(worlds[row].rollout_key, []).append(row)
        for chunk in (part for group in groups.values() for part in _split(group)):
            own, indices = [worlds[row] for row in chunk], np.array(chunk)
            limit = min(_ROLLOUT_STEPS, steps - int(simulated[indices].max()), *(one.remaining_steps for one in own))
            prepare_worlds(own, [robot_targets[row] for row in chunk])
            rollout = simulate_worlds(own, limit)
            if rollout is None:
                contacts = RolloutContacts.without_contacts(limit, len(own))
            else:
                # The state starts with the time.
                qpos = rollout.step_states[..., 1 : 1 + len(own[0].data.qpos)].swapaxes(0, 1)
                sensors = own[0].data.scene.contact_sensors
                contacts = sensors.compute_rollout_contacts(rollout.sensordata.swapaxes(0, 1), qpos, rules)
            end = judge(indices, contacts)
            for number, (world, n_kept) in enumerate(zip(own, end.steps.tolist(), strict=True)):
                world.apply_rollout_step(rollout, number, n_kept)
                if end.released[number]:
                    world.release_target()
            simulated[indices] += end.steps
            running[indices] = ~end.ended
    return simulated


class MujocoWorldBatch:
    """Batch of n worlds that MuJoCo simulates together in one thread, with NumPy arrays.

    Methods apply to the r worlds whose indices are in their argument `rows` (r,); other arrays have r rows.

    Args:
        config: Constants of the worlds.
        count: Number n of worlds.
    """

    def __init__(self, config: PhysicsConfig, count: int) -> None:
        cache = SimulationCache()
        self._worlds = [MujocoWorld(config, cache=cache) for _ in range(count)]
        self._n_objects = [0] * count

    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene into the world with index `row`, and set all its bodies to their start; see `World.reset`."""
        self._worlds[row].reset(scene, start, robot_joints)
        self._n_objects[row] = start.objects.shape[1]

    def rollout(
        self,
        rows: Indices,
        reference: ReferenceMotion,
        robot_targets: AnyArray,
        judge: JudgeFunction,
        rules: ProtocolConfig,
    ) -> AnyIntegers:
        """Simulate r worlds for all steps of a reference motion, or until their episodes end.

        Args:
            rows: Indices (r,) of worlds of running episodes.
            reference: Joint targets of human hands and objects of these r worlds in k steps.
            robot_targets: Joint targets (r, 9) of the Pandas (rad, m).
            judge: Function that applies the rules of release and end to contacts; its indices are from 0 to r - 1.
            rules: Rules of the protocol, of which only the grasp region of the fingers is used here.

        Returns:
            Number (r,) of simulated steps of each world.
        """
        worlds = [self._worlds[row] for row in rows.tolist()]
        for number, row in enumerate(rows.tolist()):
            worlds[number].set_reference(reference.select(number, self._n_objects[row]))
        return rollout_worlds(worlds, robot_targets.tolist(), reference.hand.shape[1], judge, rules)

    def release_targets(self, rows: Indices) -> None:
        """Release the target objects of the worlds `rows` (r,) from the human hands before the next step."""
        for row in rows.tolist():
            self._worlds[row].release_target()

    def read_state(self, rows: Indices) -> WorldState:
        """Return the states (r, ...) of the worlds `rows` (r,)."""
        states = [self._worlds[row].read_state() for row in rows.tolist()]
        return WorldState(*map(np.stack, zip(*states, strict=True)))

    def are_grasped(self, rows: Indices) -> AnyArray:
        """Return a mask (r,) of the worlds `rows` whose fingers both touched the target object in the last step."""
        return np.array(
            [self._worlds[row].read_contacts(False).both_fingers_touch for row in rows.tolist()], dtype=bool
        )

    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of world `row` in its last step; `released` is as in `World.read_contacts`."""
        return self._worlds[row].read_contacts(released)

    def close(self) -> None:
        """Free the memory of all worlds."""
        for world in self._worlds:
            world.close()
