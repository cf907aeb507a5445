"""World simulated by MuJoCo, with the same bodies, motors and collision masks as in PyBullet."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.simulation.contacts import ContactBatch, Contacts, JudgeFunction
from handover_marl.simulation.mujoco.batches.simulation import BatchSimulation
from handover_marl.simulation.mujoco.control import WorldController, prepare_controls
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.quaternions import bullet_xyzw_from_wxyz, chain_joints_from_poses
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import AgentJoints, World, WorldState

Array = npt.NDArray[np.float64]
TruncateFunction = Callable[[int, int], None]

# The sensor readings of more worlds do not fit into the processor's cache.
_ROLLOUT_WORLDS = 32
# Steps of one rollout. Steps after a release or an episode's end are simulated in vain.
_ROLLOUT_STEPS = 100


class MujocoWorld(World):
    """World simulated by MuJoCo, alone or in a batch with other worlds.

    The robot is always simulated; objects are simulated once the robot is near them or near the
    hand, or once they are released. The hand follows its reference kinematically, as in
    `FastWorld` of PyBullet.

    Args:
        config: Constants of the world.
        window: Must be False; only PyBullet opens a window.
        simulation: Batch simulation shared with other worlds; None for a new one.

    Raises:
        OptionError: A window was requested.
    """

    has_rollouts = True

    def __init__(self, config: PhysicsConfig, window: bool = False, simulation: BatchSimulation | None = None) -> None:
        if window:
            raise OptionError('physics="mujoco" opens no window; use render_mode="rgb_array", or physics="fast"')
        super().__init__(config)
        self._simulation = simulation or BatchSimulation()
        self._controller: WorldController | None = None
        # The angles of objects' chains continue from their last values.
        self._object_joints = np.zeros((0, 6))

    @property
    def controller(self) -> WorldController:
        """Controller of the world in the current episode.

        Raises:
            ResetNeededError: No scene has been loaded.
        """
        if self._controller is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        return self._controller

    def reset(self, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene and set robot, objects and hand to its start.

        Args:
            scene: Scene to load.
            start: Reference motion of one row: joint positions of hand and objects at the start.
            robot_joints: Nine joint positions of the robot at the start (rad, m).
        """
        model = load_scene_model(scene.assets, self._config)
        data = self._simulation.load_scene(model)
        config = replace(self._config, panda=replace(self._config.panda, start_joints=tuple(robot_joints)))
        self._controller = WorldController(data, self._simulation, scene.assets.hand, config, start)
        self._scene = scene
        self._object_joints = start.objects[0].astype(np.float64)

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of hand and objects for the coming steps, one row per step."""
        self.controller.set_reference(motion)

    def step(self, robot_target: list[float]) -> None:
        """Simulate one physics step towards nine joint targets of the Panda (rad, m)."""
        controller = self.controller
        prepare_controls([controller], [robot_target])
        if controller.sleep is None:
            touching = [controller.can_touch_hand(1)]
            self._simulation.simulate([controller.data], touching, [controller.coming_controls[:1]])
        controller.set_row(controller.row + 1)

    @classmethod
    def rollout(
        cls,
        worlds: Sequence["MujocoWorld"],
        robot_targets: Sequence[list[float]],
        steps: int,
        judge: JudgeFunction,
        rules: ProtocolConfig,
    ) -> npt.NDArray[np.int_]:
        """Simulate n worlds together for some steps, or to their ends; see `World.rollout`."""
        simulated, running = np.zeros(len(worlds), dtype=np.int_), np.ones(len(worlds), dtype=bool)
        while rows := np.flatnonzero(running & (simulated < steps)).tolist():
            # Preparing a sleeping world may wake it, which changes its key.
            for chunk in _split([row for row in rows if worlds[row].is_asleep]):
                cls.prepare([worlds[row] for row in chunk], [robot_targets[row] for row in chunk])
            groups: dict[object, list[int]] = {}
            for row in rows:
                groups.setdefault(worlds[row].rollout_key, []).append(row)
            for chunk in (part for group in groups.values() for part in _split(group)):
                own, indices = [worlds[row] for row in chunk], np.array(chunk)
                limit = min(
                    _ROLLOUT_STEPS, steps - int(simulated[indices].max()), *(one.remaining_steps for one in own)
                )
                contacts, truncate = cls.simulate(own, [robot_targets[row] for row in chunk], limit, rules)
                end = judge(indices, contacts)
                for number in np.flatnonzero(end.steps < limit).tolist():
                    truncate(number, int(end.steps[number]))
                for number in np.flatnonzero(end.released).tolist():
                    own[number].release_target()
                simulated[indices] += end.steps
                running[indices] = ~end.ended
        return simulated

    @classmethod
    def prepare(cls, worlds: Sequence["MujocoWorld"], robot_targets: Sequence[list[float]]) -> None:
        """Compute the controls of worlds for the coming steps; sleeping worlds may wake."""
        prepare_controls([world.controller for world in worlds], robot_targets)

    @classmethod
    def simulate(
        cls, worlds: Sequence["MujocoWorld"], robot_targets: Sequence[list[float]], steps: int, rules: ProtocolConfig
    ) -> tuple[ContactBatch, TruncateFunction]:
        """Simulate several steps of worlds with the same `rollout_key`, at most the `remaining_steps` of any.

        Returns:
            The contacts, and a function `truncate(number, steps)` that sets the world with index `number` back to its
            state after `steps` of these steps (1 or more).
        """
        controllers = [world.controller for world in worlds]
        prepare_controls(controllers, robot_targets)
        if controllers[0].sleep is not None:
            return _skip_sleeping_steps(controllers, steps)
        rollout = worlds[0]._simulation.simulate(
            [controller.data for controller in controllers],
            [controller.can_touch_hand(steps) for controller in controllers],
            [controller.coming_controls[:steps] for controller in controllers],
        )
        for controller in controllers:
            controller.row += steps

        def truncate(number: int, taken: int) -> None:
            rollout.set_world(number, taken)
            controllers[number].row += taken - steps

        return rollout.make_readings().compute_contact_batch(rules), truncate

    @property
    def rollout_key(self) -> tuple[int, ...]:
        """Key that is equal for worlds that can be simulated together; sleeping and awake ones cannot."""
        if self.is_asleep:
            return ()  # Sleeping worlds of all sizes are advanced together.
        model = self.controller.data.scene.model
        return model.nq, model.nu, model.nmocap, model.nsensordata

    @property
    def is_asleep(self) -> bool:
        """Whether only the arm is simulated, because no body can touch the robot; `prepare` may end this."""
        return self._controller is not None and self._controller.sleep is not None

    @property
    def remaining_steps(self) -> int:
        """Largest number of steps that can be simulated at once, valid for a sleeping world after `prepare`."""
        return self.controller.remaining_steps

    def release_target(self) -> None:
        """Release the target object from the human hand, from the next step on."""
        self.controller.release_pending = True

    def read_contacts(self, released: bool) -> Contacts:
        """Return the contacts of the last physics step; see `World.read_contacts`."""
        if self.is_asleep:
            return Contacts()
        return self.controller.data.read_sensors().compute_contacts(released)

    def read_state(self) -> WorldState:
        """Return the current state of robot, objects and human hand."""
        self.controller.set_state()
        controller, data, scene = self.controller, self.controller.data, self.controller.data.scene
        hand = controller.get_hand_joints()
        positions, quaternions = controller.robot.compute_body_poses(data.qpos[scene.robot_qpos])
        # The gripper's pose, then the objects'.
        poses = np.concatenate(
            [positions[scene.gripper], quaternions[scene.gripper], data.qpos[scene.object_qpos]]
        ).reshape(-1, 7)
        poses[:, 3:] = bullet_xyzw_from_wxyz(poses[:, 3:])
        return WorldState(
            robot_joint_position=data.qpos[scene.robot_qpos].astype(np.float32),
            robot_joint_velocity=data.qvel[scene.robot_qvel].astype(np.float32),
            gripper_pose=poses[0].astype(np.float32),
            object_poses=poses[1:].astype(np.float32),
            hand_dof_position=None if hand is None else hand.astype(np.float32),
            hand_keypoints=None if hand is None else controller.compute_keypoints(hand),
        )

    def read_agent_joints(self) -> AgentJoints:
        """Return the current joint positions of robot and human hand."""
        hand, robot = self.controller.get_hand_joints(), self.read_joints_float64()
        return AgentJoints(robot.astype(np.float32), None if hand is None else hand.astype(np.float32))

    def read_joints_float64(self) -> Array:
        """Return the robot's joint positions (9,) in double precision (rad, m)."""
        self.controller.set_state()
        data = self.controller.data
        joints: Array = data.qpos[data.scene.robot_qpos].copy()
        return joints

    def read_object_joints(self) -> npt.NDArray[np.float32]:
        """Return the joint positions (n, 6) of n objects: xyz (m), Euler angles (rad), float32."""
        self.controller.set_state()
        data = self.controller.data
        poses = data.qpos[data.scene.object_qpos].reshape(-1, 7)
        self._object_joints = chain_joints_from_poses(poses, self._object_joints)
        joints: npt.NDArray[np.float32] = self._object_joints.astype(np.float32)
        return joints

    def close(self) -> None:
        """Free the memory of the simulation."""
        super().close()
        self._controller = None


def _split(numbers: list[int]) -> list[list[int]]:
    """Split the numbers of worlds into those of single rollouts."""
    return [numbers[first : first + _ROLLOUT_WORLDS] for first in range(0, len(numbers), _ROLLOUT_WORLDS)]


def _skip_sleeping_steps(controllers: Sequence[WorldController], steps: int) -> tuple[ContactBatch, TruncateFunction]:
    """Advance sleeping worlds by some steps, and return a rollout without contacts."""
    started = [controller.row for controller in controllers]

    def truncate(number: int, taken: int) -> None:
        controllers[number].set_row(started[number] + taken)

    for number in range(len(controllers)):
        truncate(number, steps)
    return ContactBatch.without_contacts(steps, len(controllers)), truncate
