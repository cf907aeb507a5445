"""Construction of MuJoCo models: bodies, geoms, actuators and contact sensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from handover_marl.config import OBJECT_DOF, TIME_STEP, MotorConfig, PhysicsConfig
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.geometry.model_files.urdf import UrdfLink, read_urdf_links, read_urdf_shapes
from handover_marl.geometry.panda import CAMERA_LINK, FINGER_LINKS, HAND_LINK
from handover_marl.geometry.poses import IDENTITY
from handover_marl.geometry.rotations import quaternions_from_matrices
from handover_marl.simulation.mujoco.contacts import add_contact_sensors
from handover_marl.simulation.mujoco.engine import wxyz_from_xyzw
from handover_marl.simulation.mujoco.models.collision_shapes import (
    RELEASED_COLLISIONS,
    CollisionGroup,
    ConvexPart,
    add_collision_geom,
    compute_box_inertia,
    load_convex_parts,
    load_link_parts,
    set_inertia,
)
from handover_marl.simulation.reference_tracking import list_object_motors

# Parameters (SI units) that make MuJoCo's contacts and actuators behave like Bullet's. They were chosen on scenes of s0
# train only, by the share of episodes of `yang2021` with the same outcome as in exact physics.
#
# Bullet's motor gives a joint the velocity that its position error demands, with any force up to a limit. In MuJoCo an
# actuator with damping `kv` accelerates the joint towards that velocity. At the force limit the joint oscillates from
# step to step if `kv` is more than twice the joint's inertia per step; the armatures prevent this.
#
# kv of the arm's actuators (N m s), and inertia added to the arm's joints (kg m^2).
_ARM_DAMPING = (1000.0, 1000.0, 1000.0, 500.0, 100.0, 100.0, 100.0)
_ARM_ARMATURE = (0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
# kv of the finger actuators (N s/m), and mass added to each finger joint (kg), since Bullet's contacts with fingers are
# soft. The grip force (N) is the damping times 10 / s times the opening of the finger (m).
_FINGER_DAMPING, _FINGER_ARMATURE = 1500.0, 4.0
# kv of the actuators that move objects, as a multiple of the object's mass per physics step.
_OBJECT_DAMPING = 0.5
#: Distance (m) of each convex hull's surface from its vertices, equal to Bullet's collision margin.
HULL_MARGIN = 0.001
# Time constant of contacts (s); their smallest and full impedance, and the penetration (m) at which the full impedance
# is reached; ratio of frictional to normal constraint impedance.
_CONTACT_TIME, _CONTACT_IMPEDANCE, _IMPRATIO = 0.003, (0.95, 0.99, 0.001), 10.0

ROBOT_BASE, TABLE = "robot", "table"
_ALL_GROUPS, _NO_GROUP = CollisionGroup(sum(CollisionGroup)), CollisionGroup(0)
# The friction of a contact is that of the geom with the higher priority.
_SUPPORT_PRIORITY, _ROBOT_PRIORITY, _FINGER_PRIORITY = 1, 1, 2
# Pairs of the Panda's links that stay more than 1 cm apart within the joint limits, besides neighbors.
_NEVER_COLLIDING = (
    (ROBOT_BASE, "panda_link2"),
    ("panda_link1", "panda_link3"),
    ("panda_link2", "panda_link4"),
    ("panda_link4", "panda_link6"),
    ("panda_link6", HAND_LINK),
    *(("panda_link6", finger) for finger in FINGER_LINKS),
    ("panda_link6", CAMERA_LINK),
    *(("panda_link7", finger) for finger in FINGER_LINKS),
    *((finger, CAMERA_LINK) for finger in FINGER_LINKS),
)


@dataclass(frozen=True)
class ModelPadding:
    """Sizes to which a scene's model is padded, so that the models of many scenes have one layout.

    Small bodies stand for absent objects, small tetrahedra for absent hulls. The target object has each hull twice: one
    collides with the robot; the other one, after the release, with table, ground and other objects.

    Attributes:
        objects: Number of objects in the model.
        hulls: Number of convex hulls of each object.
    """

    objects: int
    hulls: int


#: Prefix of the names of geoms that stand for absent hulls.
ABSENT_PREFIX = "absent"
# Link and hull that stand for absent ones.
_ABSENT_LINK = UrdfLink(mass=1.0)
_ABSENT_HULL = ConvexPart("hull", 0.001 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), (), IDENTITY)


def format_object_name(number: int) -> str:
    """Return the MuJoCo body name of an object by number; number 0 is the target object."""
    return f"object{number}"


def format_rotation_reference_name(number: int) -> str:
    """Return the name of the mocap body whose orientation is an object's target, by the number of the object."""
    return f"rotation_reference{number}"


def format_hand_name(number: int) -> str:
    """Return the MuJoCo body name of a link of the human hand, by its index in `SceneModelBuilder.hand_links`."""
    return f"hand{number}"


class SceneModelBuilder:
    """Builder of a scene's MuJoCo model.

    The world has the bodies `robot` with the URDF's links below it, `table`, free bodies `object0`, ..., and mocap
    bodies `hand0`, .... The robot's actuators have the names of the links that they move, an object's are `object0/0`
    to `object0/5` (world xyz, then three rotation components). There is no gravity, since the motors compensate it
    exactly. A released object gets its weight as an external force.

    All methods raise a `SimulationError` or a `DataFormatError` if a model or a mesh cannot be read.

    Args:
        config: Poses and motors of robot, table, objects and hand.
        object_friction: Friction coefficient of the target object.
        spec: Specification to extend, for example with a workcell; None for an empty one.
        padding: Sizes to which the model is padded; None for no padding.

    Attributes:
        spec: MuJoCo specification of the model under construction.
        hand_links: URDF link numbers of the human hand's bodies `hand0`, ....
    """

    def __init__(
        self,
        config: PhysicsConfig,
        object_friction: float = 1.0,
        spec: "mujoco.MjSpec | None" = None,
        padding: ModelPadding | None = None,
    ) -> None:
        self.spec = _make_empty_spec() if spec is None else spec
        self.hand_links: list[int] = []
        self._config, self._padding = config, padding
        # Bullet multiplies both frictions of a contact, MuJoCo takes one: the object's is multiplied in beforehand.
        self._object_friction = object_friction

    def add_workcell(self, table: Path, panda: Path) -> None:
        """Add the ground, and table and robot from their URDF files, to the model."""
        ground = self.spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        self._set_contact_parameters(ground, CollisionGroup.GROUND, 0.5, priority=_SUPPORT_PRIORITY)
        tree = read_tree(table)
        body = self.spec.worldbody.add_body(name=TABLE, pos=self._config.table_position)
        friction = read_urdf_links(table, tree)[-1].friction * self._object_friction
        parts = load_convex_parts(read_urdf_shapes(table, tree, "collision"))
        self._add_parts(body, parts, CollisionGroup.SUPPORT, friction, priority=_SUPPORT_PRIORITY)
        self.add_robot(panda)
        names = {body.name for body in self.spec.bodies}
        for one, other in _NEVER_COLLIDING:
            if {one, other} <= names:
                self.spec.add_exclude(bodyname1=one, bodyname2=other)

    def add_objects_and_hand(self, objects: Sequence[Path], hand: Path) -> None:
        """Add objects (the target first), human hand and contact sensors; the model must have the workcell."""
        for number, urdf in enumerate(objects):
            self._add_object(number, urdf)
        count = len(objects) if self._padding is None else self._padding.objects
        for number in range(len(objects), count):
            self._add_object_body(number, _ABSENT_LINK, [_ABSENT_HULL])
        self.add_hand(hand)
        hands = [format_hand_name(number) for number in range(len(self.hand_links))]
        names = [format_object_name(number) for number in range(count)]
        add_contact_sensors(self.spec, ROBOT_BASE, names, TABLE, hands)

    def add_robot(self, urdf: Path) -> None:
        """Add the robot of a URDF file to the model."""
        tree, panda = read_tree(urdf), self._config.panda
        links, parts_by_link = read_urdf_links(urdf, tree), load_link_parts(urdf, tree)
        orientation = wxyz_from_xyzw(panda.base_orientation)
        base = self.spec.worldbody.add_body(name=ROBOT_BASE, pos=panda.base_position, quat=orientation)
        bodies = {-1: base}
        for number, joint in enumerate(tree.joints):
            rotation = wxyz_from_xyzw(quaternions_from_matrices(joint.rotation))
            bodies[number] = bodies[joint.parent].add_body(name=joint.link, pos=joint.offset, quat=rotation)
            if joint.parent < 0:
                # MuJoCo excludes collisions of parent and child only if the parent moves.
                self.spec.add_exclude(bodyname1=ROBOT_BASE, bodyname2=joint.link)
            if joint.kind != "fixed":
                self._add_robot_joint(bodies[number], tree, number, links[number])
        for number, body in bodies.items():
            parts = parts_by_link.get(number, [])
            is_finger = number >= 0 and tree.joints[number].link in FINGER_LINKS
            self._add_robot_link(body, links[number], parts, is_finger)
            if number >= 0:
                set_inertia(body, links[number], parts)

    def _add_robot_link(self, body: "mujoco.MjsBody", link: UrdfLink, parts: list[ConvexPart], is_finger: bool) -> None:
        self._add_parts(
            *(body, parts, CollisionGroup.ROBOT, link.friction * self._object_friction),
            collides_with=_ALL_GROUPS,
            torsion=link.spinning_friction * self._object_friction,
            priority=_FINGER_PRIORITY if is_finger else _ROBOT_PRIORITY,
        )

    def _add_robot_joint(self, body: "mujoco.MjsBody", tree: KinematicTree, number: int, link: UrdfLink) -> None:
        tree_joint = tree.joints[number]
        slides = tree_joint.kind == "prismatic"
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        joint = body.add_joint(name=tree_joint.link, type=kind, axis=tree_joint.axis)
        order = len(self.spec.actuators)
        joint.armature = _FINGER_ARMATURE if slides else _ARM_ARMATURE[order]
        damping = _FINGER_DAMPING if slides else _ARM_DAMPING[order]
        actuator = self._add_actuator(tree_joint.link, self._config.panda.motor, damping)
        actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_JOINT, tree_joint.link
        if link.limits is not None:
            joint.limited, joint.range = True, link.limits
            joint.solref_limit = [_CONTACT_TIME, 1.0]
            # Bullet clips motor targets to the joint limits.
            actuator.ctrllimited, actuator.ctrlrange = True, link.limits

    def _add_object(self, number: int, urdf: Path) -> None:
        tree = read_tree(urdf)
        # The last link but the base carries the mass and all shapes.
        self._add_object_body(number, read_urdf_links(urdf, tree)[-2], load_object_parts(urdf))

    def _add_object_body(self, number: int, link: UrdfLink, parts: list[ConvexPart]) -> None:
        name, reference = format_object_name(number), format_rotation_reference_name(number)
        body = self.spec.worldbody.add_body(name=name)
        body.add_freejoint(name=name)
        friction = link.friction * self._object_friction
        filled = parts
        if self._padding is not None:
            filled = parts + [_ABSENT_HULL] * (self._padding.hulls - len(parts))
        self._add_parts(body, filled, CollisionGroup.OBJECT, friction)
        if self._padding is not None and number == 0:
            self._add_parts(body, filled, _NO_GROUP, friction, collides_with=RELEASED_COLLISIONS)
        set_inertia(body, link, parts)
        body.add_site(name=name)
        # Positions are driven relative to the world's axes, rotations relative to a mocap body.
        self.spec.worldbody.add_site(name=f"{name}/origin")
        self.spec.worldbody.add_body(name=reference, mocap=True).add_site(name=reference)
        inertias = [link.mass] * 3 + compute_box_inertia(link, parts).tolist()
        motors = list_object_motors(self._config.objects)
        for axis in range(OBJECT_DOF):
            damping = _OBJECT_DAMPING * inertias[axis] / TIME_STEP
            actuator = self._add_actuator(f"{name}/{axis}", motors[axis], damping)
            actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_SITE, name
            actuator.refsite = f"{name}/origin" if axis < OBJECT_DOF // 2 else reference
            actuator.gear = np.eye(OBJECT_DOF)[axis]

    def _add_actuator(self, name: str, motor: MotorConfig, damping: float) -> "mujoco.MjsActuator":
        """Add an actuator that reduces a position error by a fixed ratio per step; the caller sets its transmission."""
        stiffness = damping * motor.position_gain / TIME_STEP
        actuator = self.spec.add_actuator(name=name)
        actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = stiffness
        actuator.biasprm[:3] = [0.0, -stiffness, -damping * motor.velocity_gain]
        actuator.forcelimited, actuator.forcerange = True, [-motor.force, motor.force]
        return actuator

    def add_hand(self, urdf: Path) -> None:
        """Add the human hand of a URDF file to the model."""
        parts_by_link = load_link_parts(urdf, read_tree(urdf))
        for number, parts in enumerate(parts_by_link.values()):
            body = self.spec.worldbody.add_body(name=format_hand_name(number), mocap=True)
            self._add_parts(body, parts, CollisionGroup.HAND, self._config.hand.friction)
        self.hand_links = list(parts_by_link)

    def _add_parts(
        self,
        body: "mujoco.MjsBody",
        parts: list[ConvexPart],
        group: CollisionGroup,
        friction: float,
        *,
        collides_with: CollisionGroup = _NO_GROUP,
        torsion: float = 0.0,
        priority: int = 0,
    ) -> None:
        """Add the convex parts of a link to a body as geoms; other arguments are as in `_set_contact_parameters`."""
        for part in parts:
            geom = add_collision_geom(self.spec, body, part)
            if part is _ABSENT_HULL:
                geom.name = f"{ABSENT_PREFIX}{len(self.spec.geoms)}"
            self._set_contact_parameters(geom, group, friction, collides_with, torsion, priority)
            # In Bullet, boxes and spheres include their margin.
            geom.margin = HULL_MARGIN if part.kind == "hull" else 0.0

    def _set_contact_parameters(
        self,
        geom: "mujoco.MjsGeom",
        group: CollisionGroup,
        friction: float,
        collides_with: CollisionGroup = _NO_GROUP,
        torsion: float = 0.0,
        priority: int = 0,
    ) -> None:
        """Set the contact parameters of a geom.

        Args:
            geom: Geom to change.
            group: Collision group of the geom.
            friction: Lateral friction coefficient.
            collides_with: Groups that the geom collides with. One of two geoms is enough for a pair to collide.
            torsion: Friction coefficient about the contact normal (m).
            priority: Priority of the geom. Of two geoms in contact, the one with the higher priority sets the friction.
        """
        geom.contype, geom.conaffinity = int(group), int(collides_with)
        geom.friction, geom.condim = [friction, torsion, 0.0], 4 if torsion else 3
        geom.priority = priority
        geom.solref = [_CONTACT_TIME, 1.0]
        geom.solimp[:3] = _CONTACT_IMPEDANCE


def _make_empty_spec() -> "mujoco.MjSpec":
    """Return a specification without bodies, with the options of the simulation."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIME_STEP
    option.gravity = np.zeros(3)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = _IMPRATIO
    # MuJoCo 4.0.0 factorizes sparse matrices wrongly, which it would choose for models with many objects.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # A state that is not finite must raise an error instead of a silent reset.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # The robot connects all moving bodies, so that there is only one constraint island to find.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return spec


def load_object_parts(urdf: Path) -> list[ConvexPart]:
    """Load the convex parts of an object's collision shape."""
    return load_convex_parts(read_urdf_shapes(urdf, read_tree(urdf), "collision"))


def read_object_friction(urdf: Path) -> float:
    """Return the friction coefficient of an object from its URDF file."""
    return read_urdf_links(urdf, read_tree(urdf))[-2].friction
