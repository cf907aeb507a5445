"""A scene's bodies as a MuJoCo model that can still be changed: names, shapes, servos, masks and touch sensors."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, TIME_STEP, MotorConfig, PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.models.kinematic_tree import KinematicTree, read_tree
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK
from handover_marl.models.poses import quaternion_from_matrix
from handover_marl.models.urdf_links import UrdfLink, read_urdf_links
from handover_marl.models.urdf_shapes import read_urdf_shapes
from handover_marl.sim.mujoco.hull_parts import Part, box_inertia, convex_parts
from handover_marl.sim.mujoco.touch import add_touch_sensors
from handover_marl.sim.mujoco.tuning import Tuning
from handover_marl.sim.object_path import object_motors

Array = npt.NDArray[np.float64]

ROBOT_BASE, TABLE = "robot", "table"
# Of two that touch, the friction of the one with the higher priority counts.
_PRIORITY = {"support": 1, "robot": 1, "finger": 2}


class Group(IntFlag):
    """Collision groups. The Panda touches everything; what else touches is said by `Collides`."""

    ROBOT = 1
    OBJECT = 2
    SUPPORT = 4
    HAND = 8
    GROUND = 16


#: What an object touches beside the robot once it was let go.
RELEASED = Group.OBJECT | Group.SUPPORT | Group.GROUND


@dataclass(frozen=True)
class _Surface:
    """How a geom touches: its group, the groups it looks for, and its friction, lateral and about the normal (m)."""

    group: Group
    meets: Group
    friction: float
    spinning: float = 0.0
    priority: int = 0


def object_name(number: int) -> str:
    """Name of an object's body; the first is the one handed over."""
    return f"object{number}"


def guide_name(number: int) -> str:
    """Name of the body that says how an object is to be turned."""
    return f"guide{number}"


def hand_name(number: int) -> str:
    """Name of one of the hand's bodies."""
    return f"hand{number}"


class SceneSpec:
    """Builds the model of a scene's table, robot, objects and hand.

    What stands in the world are bodies `robot` with the URDF's links below it, `table`, `object0`, ..., each free, and
    `hand0`, ..., which are put where they are. Servos are named after the robot's joints, `object0/0` to `object0/5`
    (world xyz and the three components of a rotation) and so on. Gravity acts on nothing: the motors carry everything
    exactly, but for an object that was let go, to which it is applied as a force.

    Args:
        config: Where they stand and how they are driven.
        tuning: Numbers of the engine.
        object_friction: Of the object that is handed over.

    Attributes:
        spec: The model, empty at first.
        hand_links: Numbers of the links that the hand's bodies are.
    """

    def __init__(self, config: PhysicsConfig, tuning: Tuning, object_friction: float) -> None:
        self.spec = mujoco.MjSpec()
        self.spec.compiler.degree = False
        self.hand_links: list[int] = []
        self._config, self._tuning = config, tuning
        # MuJoCo takes one friction of the two that touch, Bullet their product: what touches objects has it in advance.
        self._object_friction = object_friction
        option = self.spec.option
        option.timestep = TIME_STEP
        option.gravity = np.zeros(3)
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = self._tuning.impratio
        # A state that is not finite is to be told, not to be forgotten.
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # All that moves hangs together by the robot: looking for islands finds one.
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND

    @classmethod
    def of_scene(
        cls, assets: SceneAssets, config: PhysicsConfig, tuning: Tuning, apart: Iterable[tuple[str, str]]
    ) -> "SceneSpec":
        """All of a scene's bodies.

        Args:
            assets: The bodies' model files.
            config: Where they stand and how they are driven.
            tuning: Numbers of the engine.
            apart: The robot's links between which no contacts are looked for.

        Raises:
            SimulationError, DataFormatError: A model or a mesh cannot be read.
        """
        friction = object_friction(assets.objects[0])
        made = cls.of_stage(assets.table, assets.panda, friction, config, tuning, apart)
        for number, urdf in enumerate(assets.objects):
            made._add_object(number, urdf)
        made.hand_links = made._add_hand(assets.hand)
        hands = [hand_name(number) for number in range(len(made.hand_links))]
        supports = [TABLE, *(object_name(number) for number in range(1, len(assets.objects)))]
        add_touch_sensors(made.spec, ROBOT_BASE, HAND_LINK, FINGER_LINKS, object_name(0), hands, supports)
        return made

    @classmethod
    def of_stage(
        cls,
        table: Path,
        panda: Path,
        friction: float,
        config: PhysicsConfig,
        tuning: Tuning,
        apart: Iterable[tuple[str, str]],
    ) -> "SceneSpec":
        """What is there before anything is handed over, numbered as in `of_scene`; raises as that does.

        Args:
            table: Model of the table.
            panda: Model of the robot.
            friction: Of the object that is handed over.
            config: Where they stand and how they are driven.
            tuning: Numbers of the engine.
            apart: The robot's links between which no contacts are looked for.
        """
        made = cls(config, tuning, friction)
        made._add_ground()
        made._add_table(table)
        made._add_robot(panda)
        for one, other in apart:
            made.spec.add_exclude(bodyname1=one, bodyname2=other)
        return made

    @classmethod
    def of_robot(cls, panda: Path, config: PhysicsConfig, tuning: Tuning) -> "SceneSpec":
        """The robot alone; raises as `of_scene`."""
        made = cls(config, tuning, 1.0)
        made._add_robot(panda)
        return made

    def _add_ground(self) -> None:
        ground = self.spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        self._cover(ground, _Surface(Group.GROUND, Group(0), 0.5, priority=_PRIORITY["support"]))

    def _add_table(self, urdf: Path) -> None:
        tree = read_tree(urdf)
        body = self.spec.worldbody.add_body(name=TABLE, pos=self._config.table_position)
        links = read_urdf_links(urdf, tree)
        surface = _Surface(
            Group.SUPPORT, Group(0), links[-1].friction * self._object_friction, priority=_PRIORITY["support"]
        )
        self._add_parts(body, convex_parts(read_urdf_shapes(urdf, tree, "collision")), surface)

    def _add_robot(self, urdf: Path) -> None:
        tree, panda = read_tree(urdf), self._config.panda
        links, shapes = read_urdf_links(urdf, tree), read_urdf_shapes(urdf, tree, "collision")
        orientation = np.array(panda.base_orientation)
        base = self.spec.worldbody.add_body(name=ROBOT_BASE, pos=panda.base_position, quat=wxyz(orientation))
        bodies = {-1: base}
        for number, joint in enumerate(tree.joints):
            turn = quaternion_from_matrix(joint.turn)
            bodies[number] = bodies[joint.parent].add_body(name=joint.link, pos=joint.offset, quat=wxyz(turn))
            if joint.parent < 0:
                # Links never touch those that carry them; MuJoCo keeps to that but where the carrier stands still.
                self.spec.add_exclude(bodyname1=ROBOT_BASE, bodyname2=joint.link)
            if joint.kind != "fixed":
                self._add_robot_joint(bodies[number], tree, number, links[number])
        for number, body in bodies.items():
            parts = convex_parts([shape for shape in shapes if shape.link == number])
            finger = number >= 0 and tree.joints[number].link in FINGER_LINKS
            self._add_robot_link(body, links[number], parts, finger)
            if number >= 0:
                weigh(body, links[number], parts)

    def _add_robot_link(self, body: "mujoco.MjsBody", link: UrdfLink, parts: list[Part], finger: bool) -> None:
        surface = _Surface(
            Group.ROBOT,
            Group.ROBOT | Group.OBJECT | Group.SUPPORT | Group.HAND | Group.GROUND,
            link.friction * self._object_friction,
            link.spinning_friction * self._object_friction,
            _PRIORITY["finger" if finger else "robot"],
        )
        self._add_parts(body, parts, surface)

    def _add_robot_joint(self, body: "mujoco.MjsBody", tree: KinematicTree, number: int, link: UrdfLink) -> None:
        joint, tuning = tree.joints[number], self._tuning
        slides = joint.kind == "prismatic"
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        made = body.add_joint(name=joint.link, type=kind, axis=joint.axis)
        order = len(self.spec.actuators)
        made.armature = tuning.finger_armature if slides else tuning.arm_armature[order]
        if link.limits is not None:
            made.limited, made.range = True, link.limits
            made.solref_limit = [tuning.contact_time, 1.0]
        servo = self._add_servo(
            joint.link, self._config.panda.motor, tuning.finger_damping if slides else tuning.arm_damping[order]
        )
        servo.trntype, servo.target = mujoco.mjtTrn.mjTRN_JOINT, joint.link
        if link.limits is not None:
            # Bullet's motors take no targets beyond them.
            servo.ctrllimited, servo.ctrlrange = True, link.limits

    def _add_object(self, number: int, urdf: Path) -> None:
        tree, name = read_tree(urdf), object_name(number)
        # The last link carries everything; behind it comes the base.
        link = read_urdf_links(urdf, tree)[-2]
        parts = convex_parts(read_urdf_shapes(urdf, tree, "collision"))
        body = self.spec.worldbody.add_body(name=name)
        body.add_freejoint(name=name)
        self._add_parts(body, parts, _Surface(Group.OBJECT, Group(0), link.friction * self._object_friction))
        weigh(body, link, parts)
        body.add_site(name=name)
        # Its place is told in the world's axes, how it is turned by a body that turns as it should.
        self.spec.worldbody.add_site(name=f"{name}/origin")
        self.spec.worldbody.add_body(name=guide_name(number), mocap=True).add_site(name=guide_name(number))
        inertias = [link.mass] * 3 + box_inertia(link, parts).tolist()
        motors = object_motors(self._config.objects)
        for axis in range(OBJECT_DOF):
            damping = self._tuning.object_damping * inertias[axis] / TIME_STEP
            servo = self._add_servo(f"{name}/{axis}", motors[axis], damping)
            servo.trntype, servo.target = mujoco.mjtTrn.mjTRN_SITE, name
            servo.refsite = f"{name}/origin" if axis < OBJECT_DOF // 2 else guide_name(number)
            servo.gear = np.eye(OBJECT_DOF)[axis]

    def _add_servo(self, name: str, motor: MotorConfig, damping: float) -> "mujoco.MjsActuator":
        """Bullet's motor: towards the velocity that makes up a share of the position error in a step."""
        stiffness = damping * motor.position_gain / TIME_STEP
        servo = self.spec.add_actuator(name=name)
        servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        servo.gainprm[0] = stiffness
        servo.biasprm[:3] = [0.0, -stiffness, -damping * motor.velocity_gain]
        servo.forcelimited, servo.forcerange = True, [-motor.force, motor.force]
        return servo

    def _add_hand(self, urdf: Path) -> list[int]:
        tree = read_tree(urdf)
        shapes = read_urdf_shapes(urdf, tree, "collision")
        links = sorted({shape.link for shape in shapes})
        surface = _Surface(Group.HAND, Group(0), self._config.hand.friction)
        for number, link in enumerate(links):
            body = self.spec.worldbody.add_body(name=hand_name(number), mocap=True)
            self._add_parts(body, convex_parts([shape for shape in shapes if shape.link == link]), surface)
        return links

    def _add_parts(self, body: "mujoco.MjsBody", parts: list[Part], surface: _Surface) -> None:
        for part in parts:
            geom = add_shape(self.spec, body, part)
            self._cover(geom, surface)
            # Boxes and balls have Bullet's margin inside.
            geom.margin = self._tuning.margin if part.kind == "hull" else 0.0

    def _cover(self, geom: "mujoco.MjsGeom", surface: _Surface) -> None:
        geom.contype, geom.conaffinity = int(surface.group), int(surface.meets)
        geom.friction, geom.condim = [surface.friction, surface.spinning, 0.0], 4 if surface.spinning else 3
        geom.priority = surface.priority
        geom.solref = [self._tuning.contact_time, 1.0]
        geom.solimp[:3] = self._tuning.contact_impedance


def object_friction(urdf: Path) -> float:
    """Friction of an object's one link that has a shape."""
    return read_urdf_links(urdf, read_tree(urdf))[-2].friction


def add_shape(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", part: Part) -> "mujoco.MjsGeom":
    """Give a body a part's shape, which weighs nothing."""
    geom = body.add_geom(pos=part.link_from_part[:3], quat=wxyz(part.link_from_part[3:]))
    # Weights come from the links, not from volumes.
    geom.mass = 0.0
    if part.kind == "hull":
        mesh = spec.add_mesh(name=f"hull{len(spec.meshes)}", uservert=part.vertices.ravel())
        # Flat hulls have no volume to weigh.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
    elif part.kind == "box":
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_BOX, np.array(part.size) / 2.0
    else:
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [part.size[0], 0.0, 0.0]
    return geom


def weigh(body: "mujoco.MjsBody", link: UrdfLink, parts: list[Part]) -> None:
    """Give a body the mass and inertia that the link has in Bullet."""
    body.explicitinertial = True
    body.mass, body.ipos = link.mass, link.center
    if parts:
        body.inertia = box_inertia(link, parts)


def wxyz(xyzw: npt.ArrayLike) -> Array:
    """A quaternion in MuJoCo's order."""
    return np.roll(np.asarray(xyzw, dtype=np.float64), 1)
