"""Validation of grasps in simulation: a Panda hand without arm closes on an object and shakes it.

Shapes, actuators and friction are the same as in scenes. The Panda hand rests, and the object is shaken by forces in
changing directions, as in the frame of a hand that shakes without rotation. At the start, the object's frame is the
world frame. Grasps are poses (4, 4) of the gripper in the object's frame.
"""

import itertools
import math
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.shipped import PANDA_URDF
from handover_marl.config import OBJECT_DOF, OFFICIAL_CONFIG, TIME_STEP, PhysicsConfig, ProtocolConfig
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from handover_marl.geometry.panda import FINGER_LINKS, GRIPPER_FROM_HAND, HAND_LINK, OPEN, PAD_DISTANCE
from handover_marl.geometry.poses import transform_points
from handover_marl.geometry.rotations import compute_rotation_angles, quaternions_from_matrices
from handover_marl.simulation.grasp_validation_config import GraspValidationConfig
from handover_marl.simulation.mujoco.contacts import ContactSensors, add_contact_sensors
from handover_marl.simulation.mujoco.engine import XYZW, wxyz_from_xyzw
from handover_marl.simulation.mujoco.models.collision_shapes import load_link_parts, set_inertia
from handover_marl.simulation.mujoco.models.scene_spec import (
    HULL_MARGIN,
    SceneModelBuilder,
    format_object_name,
    format_rotation_reference_name,
    read_object_friction,
)
from handover_marl.simulation.world import find_points_in_grasp_region

Array = npt.NDArray[np.float64]

_OBJECT = format_object_name(0)
# Grasp files rotate the hand by 90 degrees about its approach axis: the fingers close along the gripper frame's x.
_GRIPPER_FROM_HAND = np.rint(Rotation.from_quat(GRIPPER_FROM_HAND[3:]).as_matrix())


class GripperModelBuilder(SceneModelBuilder):
    """Builder of the MuJoCo model for grasp validation: an object, and a Panda hand as mocap body.

    Args:
        object_urdf: Model of the object.
        panda_urdf: Model of the Panda.
        config: Motors of object and fingers.
    """

    def __init__(self, object_urdf: Path, panda_urdf: Path, config: PhysicsConfig) -> None:
        super().__init__(config, read_object_friction(object_urdf))
        self._add_gripper(panda_urdf)
        self._add_object(0, object_urdf)
        add_contact_sensors(self.spec, HAND_LINK, [_OBJECT])

    def _add_gripper(self, urdf: Path) -> None:
        tree = read_tree(urdf)
        links, parts_by_link = read_urdf_links(urdf, tree), load_link_parts(urdf, tree)
        numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
        missing = {HAND_LINK, *FINGER_LINKS} - set(numbers)
        if missing:
            raise SimulationError(f"{urdf} has no links {sorted(missing)}; check its URDF")
        hand = self.spec.worldbody.add_body(name=HAND_LINK, mocap=True)
        for name in (HAND_LINK, *FINGER_LINKS):
            number, is_finger = numbers[name], name != HAND_LINK
            link, joint = links[number], tree.joints[number]
            parts = parts_by_link.get(number, [])
            body = hand
            if is_finger:
                rotation = wxyz_from_xyzw(quaternions_from_matrices(joint.rotation))
                body = hand.add_body(name=name, pos=joint.offset, quat=rotation)
                self._add_robot_joint(body, tree, number, link)
                set_inertia(body, link, parts)
            self._add_robot_link(body, link, parts, is_finger)
        # Hand and fingers do not collide with each other.
        for first, second in ((HAND_LINK, FINGER_LINKS[0]), (HAND_LINK, FINGER_LINKS[1]), FINGER_LINKS):
            self.spec.add_exclude(bodyname1=first, bodyname2=second)


class GraspValidator:
    """Validator of grasps of one object, in a MuJoCo model of the object and a Panda hand without an arm.

    Args:
        object_urdf: Model of the object, with HandoverSim's chain of six joints.
        config: Conditions that a valid grasp must satisfy; None for the defaults.
        panda_urdf: Model of the Panda from which the hand link and the fingers are taken.
    """

    def __init__(
        self, object_urdf: Path, config: GraspValidationConfig | None = None, panda_urdf: Path = PANDA_URDF
    ) -> None:
        self._config = config or GraspValidationConfig()
        built = GripperModelBuilder(object_urdf, panda_urdf, OFFICIAL_CONFIG.physics)
        self._model = model = built.spec.compile()
        self._data = mujoco.MjData(model)
        self._body = model.body(_OBJECT).id
        self._finger_qpos = [model.joint(name).qposadr[0] for name in FINGER_LINKS]
        self._free_qpos = model.joint(_OBJECT).qposadr[0]
        self._sensors = ContactSensors(model, HULL_MARGIN, self._free_qpos + 2)
        self._hand, self._reference = (
            model.body(name).mocapid[0] for name in (HAND_LINK, format_rotation_reference_name(0))
        )
        self._actuators = [model.actuator(f"{_OBJECT}/{axis}").id for axis in range(OBJECT_DOF)]
        self._finger_actuators = [model.actuator(name).id for name in FINGER_LINKS]
        self._force_ranges = model.actuator_forcerange[self._actuators].copy()
        hand = np.flatnonzero(np.isin(model.geom_bodyid, [model.body(name).id for name in (HAND_LINK, *FINGER_LINKS)]))
        self._pairs = list(itertools.product(hand.tolist(), np.flatnonzero(model.geom_bodyid == self._body).tolist()))

    def is_collision_free(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Return whether the open Panda hand does not touch the object at any standoff distance before a grasp.

        The grasp (4, 4) is the pose of the gripper in the object's frame.
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._reset(grasp)
        for distance in self._config.standoff_distances:
            self._set_hand_before(grasp, distance)
            if self._has_contact():
                return False
        return True

    def is_stable(self, object_from_gripper: npt.ArrayLike) -> bool:
        """Return whether the Panda hand at a grasp holds the object while the fingers close and while it is shaken.

        The grasp (4, 4) is the pose of the gripper in the object's frame.
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._reset(grasp)
        self._close_fingers()
        start = self._read_gripped_pose(grasp)
        self._simulate(self._config.close_time, np.zeros(3))
        held = self._read_gripped_pose(grasp)
        if not self._is_gripped() or self._has_moved(start, held):
            return False
        for direction in np.concatenate([np.eye(3), -np.eye(3)]):
            self._simulate(self._config.shake_time, self._config.acceleration * direction)
            if not self._is_gripped() or self._has_moved(held, self._read_gripped_pose(grasp)):
                return False
        return True

    def measure_release_slip(self, object_from_gripper: npt.ArrayLike, held_time: float, free_time: float) -> float:
        """Measure the object's displacement relative to the fingers (m) after a person releases it.

        In a scene, a person holds the object while the fingers close, and releases it 0.1 s later. An object that only
        the edge of a finger touches slips away then. Here, the configured `acceleration` is gravity, along -z.

        Args:
            object_from_gripper: Grasp, the pose (4, 4) of the gripper in the object's frame.
            held_time: Time for which the object is held while the fingers close (s).
            free_time: Time after the release (s).

        Returns:
            Displacement (m); infinity if in the end a finger does not touch the object inside its grasp region.
        """
        grasp = np.asarray(object_from_gripper, dtype=np.float64)
        self._reset(grasp)
        self._hold_object(True)
        self._close_fingers()
        self._simulate(held_time, np.zeros(3))
        self._hold_object(False)
        before = self._read_gripped_pose(grasp)
        self._simulate(free_time, np.array([0.0, 0.0, -self._config.acceleration]))
        if not self._is_gripped():
            return math.inf
        return float(np.linalg.norm(self._read_gripped_pose(grasp)[:3] - before[:3]))

    def _reset(self, grasp: Array) -> None:
        """Reset the object to its initial pose, free and at rest, and set the open hand to a grasp pose (4, 4)."""
        mujoco.mj_resetData(self._model, self._data)
        self._hold_object(False)
        self._data.mocap_pos[self._reference], self._data.mocap_quat[self._reference] = 0.0, (1.0, 0.0, 0.0, 0.0)
        self._data.qpos[self._finger_qpos] = self._data.ctrl[self._finger_actuators] = OPEN
        self._set_hand_before(grasp, 0.0)

    def _set_hand_before(self, grasp: Array, distance: float) -> None:
        """Set the Panda hand to a grasp pose (4, 4), moved back by a distance (m) along the approach direction."""
        self._data.mocap_pos[self._hand] = grasp[:3, 3] - distance * grasp[:3, 2]
        rotation = quaternions_from_matrices(grasp[:3, :3] @ _GRIPPER_FROM_HAND)
        self._data.mocap_quat[self._hand] = wxyz_from_xyzw(rotation)

    def _has_contact(self) -> bool:
        """Return whether Panda hand and object touch in their current poses."""
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        for pair in self._pairs:
            margins = float(model.geom_margin[list(pair)].sum())
            if mujoco.mj_geomDistance(model, data, *pair, 2.0 * margins + 1e-3, None) < margins:
                return True
        return False

    def _hold_object(self, is_held: bool) -> None:
        """Switch on or off the motors that hold the object."""
        self._model.actuator_forcerange[self._actuators] = self._force_ranges if is_held else 0.0

    def _close_fingers(self) -> None:
        self._data.ctrl[self._finger_actuators] = 0.0

    def _simulate(self, duration: float, gravity: Array) -> None:
        """Simulate object and hand for a duration (s) under a gravity vector (3,) (m/s^2)."""
        self._data.xfrc_applied[self._body, :3] = self._model.body_mass[self._body] * gravity
        for _ in range(round(duration / TIME_STEP)):
            mujoco.mj_step(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)

    def _is_gripped(self) -> bool:
        """Return whether both fingers press on the object inside HandoverSim's grasp region."""
        points = self._sensors.compute_contacts(self._data.sensordata, self._data.qpos, False).finger_points
        return all(find_points_in_grasp_region(own, ProtocolConfig()).any() for own in points)

    def _read_gripped_pose(self, grasp: Array) -> Array:
        """Return the position (m) of the object's gripped point and its orientation xyzw, (7,), without finger drift.

        At the start that point is in the middle between the finger pads. The finger motors are independent, as in
        HandoverSim: closed fingers may drift sideways together and take the object along, which is no slip.
        """
        free = self._data.qpos[self._free_qpos : self._free_qpos + 7]
        pose = np.concatenate([free[:3], free[3:][XYZW]])
        gripped = transform_points(pose, grasp[:3, 3] + PAD_DISTANCE * grasp[:3, 2])
        left, right = self._data.qpos[self._finger_qpos].tolist()
        return np.concatenate([gripped - 0.5 * (left - right) * grasp[:3, 0], pose[3:]])

    def _has_moved(self, before: Array, after: Array) -> bool:
        shift = float(np.linalg.norm(after[:3] - before[:3]))
        rotation = float(compute_rotation_angles(before[3:], after[3:]))
        return shift > self._config.max_translation or rotation > self._config.max_rotation
