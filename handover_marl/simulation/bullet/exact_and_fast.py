"""PyBullet worlds: `ExactWorld` repeats HandoverSim bit for bit, `FastWorld` omits objects until the robot is near."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.simulation.bullet.bodies import HandBody, ObjectBody, PandaBody, compute_object_masks, load_workcell
from handover_marl.simulation.bullet.rendering import render_camera
from handover_marl.simulation.bullet.sleepable_bodies import KinematicHand, SleepableObject, read_bounding_spheres
from handover_marl.simulation.bullet.world import BulletWorld
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot
from handover_marl.simulation.camera.optics import WRIST_CAMERA, Pinhole
from handover_marl.simulation.motion_bounds import RobotMotionBounds
from handover_marl.simulation.reference_tracking import ReferenceMotion, track_references
from handover_marl.simulation.world import Contacts

_NO_CONTACTS = Contacts()
# A body with fewer contact-free steps ahead is woken, since frequent predictions take longer than its simulation.
_MIN_FREE_STEPS = 5


class ExactWorld(BulletWorld):
    """PyBullet world with the same states as HandoverSim, bit for bit, for equal float32 targets.

    All bodies of a scene are simulated, and all are loaded again at every reset.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        super().__init__(config, window)
        self._objects: list[ObjectBody] = []
        self._hand: HandBody | None = None
        self._reference: Iterator[tuple[list[list[float]], list[float] | None]] = iter(())

    def reset(self, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene; set human hand and objects to the only row of `start`, the robot to nine joints (rad, m)."""
        with self._start_scene(scene):
            panda = replace(self._config.panda, start_joints=tuple(robot_joints))
            self._workcell = load_workcell(self._client, scene.assets, replace(self._config, panda=panda))
            states, masks = start.objects[0].tolist(), compute_object_masks(scene.info.object_ids)
            self._objects = [
                ObjectBody(self._client, urdf, mask, self._config.objects, state)
                for urdf, mask, state in zip(scene.assets.objects, masks, states, strict=True)
            ]
            self._hand = None
            self._update_hand(start.list_hand_targets()[0])

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of human hand and objects in the coming steps; row k of `motion` is for step k."""
        self._reference = iter(zip(motion.objects.tolist(), motion.list_hand_targets(), strict=True))

    def step(self, robot_target: list[float]) -> None:
        """Simulate one physics step towards nine joint targets of the Panda (rad, m)."""
        object_targets, hand_target = next(self._reference)
        self._update_hand(hand_target)
        if self._release_pending:
            self._objects[0].release()
            self._release_pending = False
        self._loaded_workcell.panda.set_motor_targets(robot_target)
        for body, target in zip(self._objects, object_targets, strict=True):
            body.set_motor_targets(target)
        if self._hand is not None and hand_target is not None:
            self._hand.set_motor_targets(hand_target)
        self._simulate()

    def read_contacts(self, released: bool) -> Contacts:
        """Return the contacts of the last step; read those of the target with table and objects only if `released`."""
        hand = () if self._hand is None else (self._hand.id,)
        return self._read_contacts(hand, self._objects[0], {body.id for body in self._objects[1:]}, released)

    def render_camera(self, snapshot: JointSnapshot | None, color: bool, camera: Pinhole = WRIST_CAMERA) -> CameraImage:
        """Render an image of a camera at the joints of `snapshot`, None for the current ones; `color` adds colors."""
        if snapshot is not None:
            return super().render_camera(snapshot, color, camera)
        return render_camera(self._client, self._loaded_workcell, self._objects, self._hand, color, camera)

    def _update_hand(self, target: list[float] | None) -> None:
        """Load the human hand at `target`, its 51 joints (m, rad), if it is not loaded; remove it if this is None."""
        if target is None and self._hand is not None:
            self._hand.remove()
            self._hand = None
        elif target is not None and self._hand is None and self._scene is not None:
            self._hand = HandBody(self._client, self._scene.assets.hand, target, self._config.hand)

    def _read_object_joints(self) -> npt.NDArray[np.float32]:
        return np.stack([body.read_joint_positions() for body in self._objects])

    def _read_object_poses(self) -> npt.NDArray[np.float32]:
        return np.stack([body.read_pose() for body in self._objects])

    def _read_hand_joints(self) -> npt.NDArray[np.float32] | None:
        return None if self._hand is None else self._hand.read_joint_positions()

    def _read_hand_keypoints(self) -> npt.NDArray[np.float32] | None:
        return None if self._hand is None else self._hand.read_keypoints()


class FastWorld(BulletWorld):
    """PyBullet world that simulates an object only after the Panda has come near it, or after the release.

    The Panda is simulated as in `ExactWorld`, and so are objects that it may soon touch and, after the release, all
    objects. The human hand follows its reference motion kinematically, as its motors would move it. It touches only the
    Panda, and that ends the episode, so its dynamics have no effect. Robot, table and hand shapes stay loaded.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        super().__init__(config, window)
        self._workcell_files: tuple[Path, Path] | None = None
        self._motion_bounds: RobotMotionBounds | None = None
        self._hands: dict[Path, KinematicHand] = {}
        self._objects: list[SleepableObject] = []
        self._hand: KinematicHand | None = None
        # Current row and length of the reference motion.
        self._row, self._n_rows = -1, 0
        # Row before which the robot cannot touch sleeping bodies, as long as it has this target.
        self._free_until, self._free_target = 0, list[float]()

    def reset(self, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene; set human hand and objects to the only row of `start`, the robot to nine joints (rad, m)."""
        assets = scene.assets
        files = (assets.table, assets.panda)
        with self._start_scene(scene):
            for body in [self._hand, *(item.body for item in self._objects)]:
                if body is not None:
                    body.remove()
            self._objects, self._hand = [], None
            if self._workcell is None or files != self._workcell_files:
                self._workcell = None
                self._hands.clear()
                self._workcell = load_workcell(self._client, assets, self._config)
                # In the first step of a new client the Panda's contacts with itself differ by 1e-8 m from those in
                # later steps; after this step a new world behaves like a used one.
                self._client.stepSimulation()
                self._workcell_files = files
                self._motion_bounds = RobotMotionBounds(
                    read_tree(assets.panda), read_bounding_spheres(assets.panda), self._config.panda
                )
            panda = self._workcell.panda
            self._reset_broad_phase(panda)
            if assets.hand not in self._hands:
                self._hands[assets.hand] = KinematicHand(self._client, assets.hand, self._config.hand)
            self._hand = self._hands[assets.hand]
            self._hand.reset(start.hand[0] if start.hand_present[0] else None)
            masks = compute_object_masks(scene.info.object_ids)
            for urdf, mask, state in zip(assets.objects, masks, start.objects[0], strict=True):
                self._objects.append(SleepableObject(self._client, urdf, mask, state, self._config.objects))
            self._row, self._free_until = -1, 0
            panda.reset_robot(robot_joints)

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of human hand and objects in the coming steps; row k of `motion` is for step k."""
        self._row, self._n_rows, self._free_until = -1, len(motion.hand), 0
        asleep = []
        for number, item in enumerate(self._objects):
            item.targets = motion.objects[:, number].tolist()
            if not item.is_awake:
                asleep.append((item, motion.objects[:, number], None))
        track_references([(self._loaded_hand, motion.hand, motion.hand_present), *asleep])

    def step(self, robot_target: list[float]) -> None:
        """Simulate one physics step towards nine joint targets of the Panda (rad, m)."""
        self._row += 1
        if self._release_pending:
            self._release_target_object()
        if self._row >= self._free_until or robot_target != self._free_target:
            self._wake_reachable_bodies(robot_target)
        self._loaded_workcell.panda.set_motor_targets(robot_target)
        for item in self._objects:
            if item.body is not None:
                item.body.set_motor_targets(item.targets[self._row])
        self._loaded_hand.move_bodies(self._row)
        self._simulate()

    def read_contacts(self, released: bool) -> Contacts:
        """Return the contacts of the last step; read those of the target with table and objects only if `released`."""
        target, *others = (item.body for item in self._objects)
        hand, awake = self._loaded_hand.bodies, {other.id for other in others if other is not None}
        if target is None and not hand and not awake:
            return _NO_CONTACTS
        return self._read_contacts(hand, target, awake, released)

    def _reset_broad_phase(self, panda: PandaBody) -> None:
        """Reset Bullet's broad phase to the state of a new client, independent of earlier episodes.

        The broad phase removes old pairs a few at a time, and sorts resting bodies in alternating steps; both would
        change the last bits of later steps. Without pairs, after an even number of steps, it is as in a new client.
        """
        panda.park()
        for _ in range(2 + self._n_steps % 2):
            self._client.stepSimulation()
        self._n_steps = 0

    def _wake_reachable_bodies(self, robot_target: list[float]) -> None:
        """Wake (simulate) bodies that the Panda may reach soon; store the step before which it can reach no other."""
        row, panda = self._row, self._loaded_workcell.panda
        self._free_target, self._free_until = robot_target, self._n_rows
        bodies: list[KinematicHand | SleepableObject] = [self._loaded_hand, *self._objects]
        asleep = [body for body in bodies if not body.is_awake]
        if not asleep or self._motion_bounds is None:
            return
        free_steps = self._motion_bounds.count_contact_free_steps(
            panda.read_joint_states(),
            panda.read_link_poses(self._motion_bounds.links),
            robot_target,
            np.stack([body.get_positions(row) for body in asleep], axis=1),
            np.array([body.reach for body in asleep]),
        ).tolist()
        min_steps = min(_MIN_FREE_STEPS, self._n_rows - row)
        for body, steps in zip(asleep, free_steps, strict=True):
            if steps < min_steps:
                body.wake(row)
            else:
                self._free_until = min(self._free_until, row + steps)

    def _release_target_object(self) -> None:
        # The target can fall on any object, so all must be simulated.
        for item in self._objects:
            item.wake(self._row)
        if self._objects[0].body is not None:
            self._objects[0].body.release()
        self._release_pending = False

    def _read_object_joints(self) -> npt.NDArray[np.float32]:
        return np.stack([item.read_joints(self._row) for item in self._objects])

    def _read_object_poses(self) -> npt.NDArray[np.float32]:
        poses = np.empty((len(self._objects), 7), dtype=np.float32)
        for number, item in enumerate(self._objects):
            poses[number] = item.read_pose(self._row)
        return poses

    def _read_hand_joints(self) -> npt.NDArray[np.float32] | None:
        hand = self._loaded_hand
        return hand.get_joints(self._row).astype(np.float32) if hand.is_present_after(self._row) else None

    def _read_hand_keypoints(self) -> npt.NDArray[np.float32] | None:
        hand = self._loaded_hand
        return hand.compute_keypoints(self._row) if hand.is_present_after(self._row) else None

    @property
    def _loaded_hand(self) -> KinematicHand:
        if self._hand is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        return self._hand
