"""Validation of grasps in MuJoCo, with the same shapes, actuators and friction as in scenes."""

from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.config import OBJECT_DOF, OFFICIAL_CONFIG, TIME_STEP, PhysicsConfig
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from handover_marl.geometry.panda import FINGER_LINKS, HAND_LINK, OPEN
from handover_marl.geometry.poses import inverse_transform_points, quaternion_from_matrix
from handover_marl.simulation.grasp_validation import GraspValidationConfig, GraspValidator
from handover_marl.simulation.mujoco.models.collision_shapes import load_link_parts, set_inertia
from handover_marl.simulation.mujoco.models.scene_spec import (
    SceneModelBuilder,
    format_object_name,
    format_rotation_reference_name,
    read_object_friction,
)
from handover_marl.simulation.mujoco.models.tuning import TUNING, MujocoTuning
from handover_marl.simulation.mujoco.quaternions import XYZW, wxyz_from_xyzw

Array = npt.NDArray[np.float64]

_OBJECT = format_object_name(0)


class GripperModelBuilder(SceneModelBuilder):
    """Builder of the MuJoCo model for grasp validation: an object, and a Panda hand as mocap body.

    Args:
        object_urdf: Model of the object.
        panda_urdf: Model of the Panda.
        config: Motors of object and fingers.
        tuning: Engine parameters.

    Raises:
        SimulationError, DataFormatError: A model or a mesh cannot be read.
    """

    def __init__(self, object_urdf: Path, panda_urdf: Path, config: PhysicsConfig, tuning: MujocoTuning) -> None:
        super().__init__(config, tuning, read_object_friction(object_urdf))
        self._add_gripper(panda_urdf)
        self._add_object(0, object_urdf)

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
                rotation = wxyz_from_xyzw(quaternion_from_matrix(joint.rotation))
                body = hand.add_body(name=name, pos=joint.offset, quat=rotation)
                self._add_robot_joint(body, tree, number, link)
                set_inertia(body, link, parts)
            self._add_robot_link(body, link, parts, is_finger)
        # Hand and fingers do not collide with each other in Bullet's validation either.
        for first, second in ((HAND_LINK, FINGER_LINKS[0]), (HAND_LINK, FINGER_LINKS[1]), FINGER_LINKS):
            self.spec.add_exclude(bodyname1=first, bodyname2=second)


class MujocoGraspValidator(GraspValidator):
    """Grasp validator with an object and a Panda hand in a separate MuJoCo model.

    Args:
        object_urdf: Model of the object, on HandoverSim's chain of six joints.
        config: Conditions that a valid grasp must satisfy.
        panda_urdf: Panda that the hand is taken from.

    Raises:
        SimulationError, DataFormatError: A model or a mesh cannot be read.
    """

    def __init__(
        self, object_urdf: Path, config: GraspValidationConfig | None = None, panda_urdf: Path = PANDA_URDF
    ) -> None:
        super().__init__(config)
        built = GripperModelBuilder(object_urdf, panda_urdf, OFFICIAL_CONFIG.physics, TUNING)
        self._model = model = built.spec.compile()
        self._data = mujoco.MjData(model)
        self._body = model.body(_OBJECT).id
        self._fingers = [model.body(name).id for name in FINGER_LINKS]
        self._finger_qpos = [model.joint(name).qposadr[0] for name in FINGER_LINKS]
        self._free_qpos = model.joint(_OBJECT).qposadr[0]
        self._mocap = [model.body(name).mocapid[0] for name in (HAND_LINK, format_rotation_reference_name(0))]
        self._actuators = [model.actuator(f"{_OBJECT}/{axis}").id for axis in range(OBJECT_DOF)]
        self._finger_actuators = [model.actuator(name).id for name in FINGER_LINKS]
        self._force_ranges = model.actuator_forcerange[self._actuators].copy()
        own = [model.body(HAND_LINK).id, *self._fingers]
        self._hand_geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in own]
        self._geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == self._body]

    def close(self) -> None:
        """Do nothing: MuJoCo frees its memory itself."""

    def _reset_bodies(self) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._free_object()
        self._data.mocap_pos[self._mocap[1]] = 0.0
        self._data.mocap_quat[self._mocap[1]] = (1.0, 0.0, 0.0, 0.0)
        self._data.qpos[self._finger_qpos] = self._data.ctrl[self._finger_actuators] = OPEN

    def _set_hand_pose(self, position: Array, orientation: Array) -> None:
        self._data.mocap_pos[self._mocap[0]], self._data.mocap_quat[self._mocap[0]] = (
            position,
            wxyz_from_xyzw(orientation),
        )

    def _has_contact(self) -> bool:
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        for first in self._hand_geoms:
            for second in self._geoms:
                margins = float(model.geom_margin[first] + model.geom_margin[second])
                if mujoco.mj_geomDistance(model, data, first, second, 2.0 * margins + 1e-3, None) < margins:
                    return True
        return False

    def _hold_object(self) -> None:
        self._model.actuator_forcerange[self._actuators] = self._force_ranges

    def _free_object(self) -> None:
        self._model.actuator_forcerange[self._actuators] = 0.0

    def _close_fingers(self) -> None:
        self._data.ctrl[self._finger_actuators] = 0.0

    def _simulate(self, duration: float, gravity: Array) -> None:
        self._data.xfrc_applied[self._body, :3] = self._model.body_mass[self._body] * gravity
        for _ in range(round(duration / TIME_STEP)):
            mujoco.mj_step(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)

    def _read_finger_points(self) -> tuple[Array, Array]:
        left, right = (self._read_points_on(finger) for finger in self._fingers)
        return left, right

    def _read_points_on(self, finger: int) -> Array:
        model, data, found = self._model, self._data, []
        for number in range(data.ncon):
            contact, force = data.contact[number], np.zeros(6)
            bodies = model.geom_bodyid[contact.geom].tolist()
            mujoco.mj_contactForce(model, data, number, force)
            if force[0] > 0.0 and sorted(bodies) == sorted((finger, self._body)):
                # MuJoCo places a contact in the middle of both surfaces, its normal from the first
                # to the second.
                outwards = float(model.geom_margin[contact.geom[0]]) - 0.5 * contact.dist
                side = 1.0 if bodies[0] == finger else -1.0
                found.append(contact.pos + side * outwards * contact.frame[:3])
        pose = np.concatenate([data.xpos[finger], data.xquat[finger][XYZW]])
        return inverse_transform_points(pose, np.array(found)) if found else np.zeros((0, 3))

    def _read_object_pose(self) -> Array:
        free = self._data.qpos[self._free_qpos : self._free_qpos + 7]
        return np.concatenate([free[:3], free[3:][XYZW]])

    def _read_finger_joints(self) -> tuple[float, float]:
        left, right = self._data.qpos[self._finger_qpos].tolist()
        return left, right
