"""Grasps tried out in MuJoCo, with shapes, servos and frictions as in its scenes."""

from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.config import OBJECT_DOF, OFFICIAL, TIME_STEP, PhysicsConfig
from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK, OPEN
from handover_marl.models.poses import inverse_transform_points, quaternion_from_matrix
from handover_marl.models.urdf_links import read_urdf_links
from handover_marl.models.urdf_shapes import read_urdf_shapes
from handover_marl.sim.grasp_trial import GraspTrial, TrialConfig
from handover_marl.sim.mujoco.chain import XYZW
from handover_marl.sim.mujoco.hull_parts import convex_parts
from handover_marl.sim.mujoco.scene_spec import SceneSpec, guide_name, object_friction, object_name, weigh, wxyz
from handover_marl.sim.mujoco.tuning import TUNING, Tuning

Array = npt.NDArray[np.float64]

_OBJECT = object_name(0)


class TrialSpec(SceneSpec):
    """Builds the model of an object and the hand of a Panda, which is put where it is.

    Args:
        object_urdf: Model of the object.
        panda_urdf: Model of the Panda.
        config: How they are driven.
        tuning: Numbers of the engine.

    Raises:
        SimulationError, DataFormatError: A model or a mesh cannot be read.
    """

    def __init__(self, object_urdf: Path, panda_urdf: Path, config: PhysicsConfig, tuning: Tuning) -> None:
        super().__init__(config, tuning, object_friction(object_urdf))
        self._add_gripper(panda_urdf)
        self._add_object(0, object_urdf)

    def _add_gripper(self, urdf: Path) -> None:
        tree = read_tree(urdf)
        links, shapes = read_urdf_links(urdf, tree), read_urdf_shapes(urdf, tree, "collision")
        numbers = {joint.link: number for number, joint in enumerate(tree.joints)}
        missing = {HAND_LINK, *FINGER_LINKS} - set(numbers)
        if missing:
            raise SimulationError(f"{urdf} has no links {sorted(missing)}; check its URDF")
        hand = self.spec.worldbody.add_body(name=HAND_LINK, mocap=True)
        for name in (HAND_LINK, *FINGER_LINKS):
            number, finger = numbers[name], name != HAND_LINK
            link, joint = links[number], tree.joints[number]
            parts = convex_parts([shape for shape in shapes if shape.link == number])
            body = hand
            if finger:
                body = hand.add_body(name=name, pos=joint.offset, quat=wxyz(quaternion_from_matrix(joint.turn)))
                self._add_robot_joint(body, tree, number, link)
                weigh(body, link, parts)
            self._add_robot_link(body, link, parts, finger)
        # Fingers are far from the hand or pass it by; neither touches the other in Bullet's trials.
        for first, second in ((HAND_LINK, FINGER_LINKS[0]), (HAND_LINK, FINGER_LINKS[1]), FINGER_LINKS):
            self.spec.add_exclude(bodyname1=first, bodyname2=second)


class MujocoTrial(GraspTrial):
    """An object and a hand in a model of their own.

    Args:
        object_urdf: Model of the object, on HandoverSim's chain of six joints.
        config: What a grasp must stand.
        panda_urdf: The Panda whose hand it is.

    Raises:
        SimulationError, DataFormatError: A model or a mesh cannot be read.
    """

    def __init__(self, object_urdf: Path, config: TrialConfig | None = None, panda_urdf: Path = PANDA_URDF) -> None:
        super().__init__(config)
        self._model = model = TrialSpec(object_urdf, panda_urdf, OFFICIAL.physics, TUNING).spec.compile()
        self._data = mujoco.MjData(model)
        self._body = model.body(_OBJECT).id
        self._fingers = [model.body(name).id for name in FINGER_LINKS]
        self._finger_qpos = [model.joint(name).qposadr[0] for name in FINGER_LINKS]
        self._free_qpos = model.joint(_OBJECT).qposadr[0]
        self._mocap = [model.body(name).mocapid[0] for name in (HAND_LINK, guide_name(0))]
        self._servos = [model.actuator(f"{_OBJECT}/{axis}").id for axis in range(OBJECT_DOF)]
        self._finger_servos = [model.actuator(name).id for name in FINGER_LINKS]
        self._servo_limits = model.actuator_forcerange[self._servos].copy()
        own = [model.body(HAND_LINK).id, *self._fingers]
        self._hand_geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in own]
        self._geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == self._body]

    def close(self) -> None:
        """Nothing is to be ended."""

    def _rest(self) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._free_object()
        self._data.mocap_pos[self._mocap[1]] = 0.0
        self._data.mocap_quat[self._mocap[1]] = (1.0, 0.0, 0.0, 0.0)
        self._data.qpos[self._finger_qpos] = self._data.ctrl[self._finger_servos] = OPEN

    def _put_hand(self, position: Array, orientation: Array) -> None:
        self._data.mocap_pos[self._mocap[0]], self._data.mocap_quat[self._mocap[0]] = position, wxyz(orientation)

    def _touches(self) -> bool:
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        for first in self._hand_geoms:
            for second in self._geoms:
                margins = float(model.geom_margin[first] + model.geom_margin[second])
                if mujoco.mj_geomDistance(model, data, first, second, 2.0 * margins + 1e-3, None) < margins:
                    return True
        return False

    def _hold_object(self) -> None:
        self._model.actuator_forcerange[self._servos] = self._servo_limits

    def _free_object(self) -> None:
        self._model.actuator_forcerange[self._servos] = 0.0

    def _drive_fingers(self) -> None:
        self._data.ctrl[self._finger_servos] = 0.0

    def _simulate(self, duration: float, gravity: Array) -> None:
        self._data.xfrc_applied[self._body, :3] = self._model.body_mass[self._body] * gravity
        for _ in range(round(duration / TIME_STEP)):
            mujoco.mj_step(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)

    def _finger_points(self) -> tuple[Array, Array]:
        left, right = (self._points_on(finger) for finger in self._fingers)
        return left, right

    def _points_on(self, finger: int) -> Array:
        model, data, found = self._model, self._data, []
        for number in range(data.ncon):
            contact, force = data.contact[number], np.zeros(6)
            bodies = model.geom_bodyid[contact.geom].tolist()
            mujoco.mj_contactForce(model, data, number, force)
            if force[0] > 0.0 and sorted(bodies) == sorted((finger, self._body)):
                # A contact is told in the middle between the two; its normal points from the first to the second.
                outwards = float(model.geom_margin[contact.geom[0]]) - 0.5 * contact.dist
                side = 1.0 if bodies[0] == finger else -1.0
                found.append(contact.pos + side * outwards * contact.frame[:3])
        pose = np.concatenate([data.xpos[finger], data.xquat[finger][XYZW]])
        return inverse_transform_points(pose, np.array(found)) if found else np.zeros((0, 3))

    def _object_pose(self) -> Array:
        free = self._data.qpos[self._free_qpos : self._free_qpos + 7]
        return np.concatenate([free[:3], free[3:][XYZW]])

    def _finger_joints(self) -> tuple[float, float]:
        left, right = self._data.qpos[self._finger_qpos].tolist()
        return left, right
