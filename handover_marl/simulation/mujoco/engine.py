"""MuJoCo settings and tools: tuning, warnings, profiler, model variants, quaternions, kinematics.

MuJoCo's quaternions are wxyz, the library's xyzw.
"""

import copy
import ctypes
import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path
from weakref import WeakValueDictionary

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from handover_marl.config import OBJECT_DOF
from handover_marl.errors import SimulationError
from handover_marl.execution.options import is_pybullet_installed
from handover_marl.geometry.arrays import AnyArray, get_namespace, is_tensor
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.poses import (
    quaternion_from_matrix,
    quaternions_from_euler,
    unwrap_euler,
)

Array = npt.NDArray[np.float64]

#: Indices that reorder a quaternion wxyz to xyzw, and back.
XYZW, WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]

_LIBRARIES = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll")


@dataclass(frozen=True)
class MujocoTuning:
    """Parameters (SI units) that make MuJoCo's contacts and actuators behave like Bullet's.

    The values were chosen on scenes of s0 train only, by the share of episodes of `yang2021` with the
    same outcome as in exact physics.

    Bullet's motor gives a joint the velocity that its position error demands, with any force up to
    a limit. In MuJoCo an actuator with damping `kv` accelerates the joint towards that velocity. At
    the force limit the joint oscillates from step to step if `kv` is more than twice the joint's
    inertia per step; the armatures prevent this.

    Attributes:
        arm_damping: kv of the seven arm actuators (N m s).
        arm_armature: Inertia added to the seven arm joints (kg m^2).
        finger_damping: kv of the finger actuators (N s/m). The grip force (N) is this value times
            10 / s times the opening of the finger (m).
        finger_armature: Mass added to each finger joint (kg), since Bullet's contacts with fingers
            are soft.
        object_damping: kv of the actuators that move objects, as a multiple of the object's mass per
            physics step.
        margin: Distance (m) of each convex hull's surface from its vertices, equal to Bullet's
            collision margin.
        contact_time: Time constant of contacts (s).
        contact_impedance: Smallest and full impedance of contacts, and the penetration (m) at
            which the full impedance is reached.
        impratio: Ratio of frictional to normal constraint impedance.
    """

    arm_damping: tuple[float, ...] = (1000.0, 1000.0, 1000.0, 500.0, 100.0, 100.0, 100.0)
    arm_armature: tuple[float, ...] = (0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
    finger_damping: float = 1500.0
    finger_armature: float = 4.0
    object_damping: float = 0.5
    margin: float = 0.001
    contact_time: float = 0.003
    contact_impedance: tuple[float, float, float] = (0.95, 0.99, 0.001)
    impratio: float = 10.0


TUNING = MujocoTuning()


class CollisionGroup(IntFlag):
    """Collision groups: bits of MuJoCo's contype and conaffinity. The Panda collides with all."""

    ROBOT = 1
    OBJECT = 2
    SUPPORT = 4
    HAND = 8
    GROUND = 16


#: Groups that a released object collides with, apart from the robot.
RELEASED_COLLISIONS = CollisionGroup.OBJECT | CollisionGroup.SUPPORT | CollisionGroup.GROUND


@functools.cache
def configure_engine() -> None:
    """Disable MuJoCo's warning output and stop its profiler once in this process.

    MuJoCo writes warnings to the console and to a log in the working folder; `check_warnings`
    reports them instead.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda message: None)
    stop_profiler()


def stop_profiler() -> bool:
    """Stop MuJoCo's profiler in this process; steps become 6 % faster and nothing else changes.

    The Python package leaves the profiler on, which reads the clock many times in every step. After
    this call `mujoco.MjData.timer` stays at zero; `mujoco.set_mjcb_time(None)` starts the profiler
    again. A clock that was set by `mujoco.set_mjcb_time` is kept.

    Returns:
        Whether the profiler was stopped; False if the engine's library was not found.
    """
    if mujoco.get_mjcb_time() is not None:
        return False
    folder = Path(mujoco.__file__).parent
    for library in (path for pattern in _LIBRARIES for path in sorted(folder.glob(pattern))):
        try:
            # The package cannot unset the clock: it replaces None by its own clock.
            clock = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_time")
        except (OSError, ValueError):
            continue
        clock.value = None
        return True
    return False


def check_warnings(engine: Batch) -> None:
    """Raise an error if MuJoCo warned in the world of an engine.

    Raises:
        SimulationError: There were warnings; the simulated state is invalid.
    """
    details, counts = engine.warning[0].T
    if not counts.any():
        return
    found = [mujoco.mju_warningText(kind, details[kind]) for kind in np.flatnonzero(counts)]
    seconds = float(engine.bind("time")[0])
    advice = "run this scene with physics='fast'" if is_pybullet_installed() else "leave this scene out"
    raise SimulationError(
        f"MuJoCo's simulation failed after {seconds:.3f} s: {' '.join(found)} To go on, {advice}, and report this."
    )


class ModelVariants:
    """Variants of a scene's model with a released target object or a hand without collisions.

    Copying a model takes 1 ms; a variant is shared for as long as it is referenced.

    Args:
        model: Model of the scene, in which actuators hold the target object.
        target: Body number of the target object.
        actuators: Number of the first of the object's six actuators.
        hand: Body numbers of the hand.
    """

    def __init__(self, model: "mujoco.MjModel", target: int, actuators: int, hand: Sequence[int]) -> None:
        self._model = model
        self._target, self._actuators, self._hand = target, actuators, list(hand)
        self._variants: WeakValueDictionary[tuple[bool, bool], mujoco.MjModel] = WeakValueDictionary()

    def select(self, released: bool, hand: bool) -> "mujoco.MjModel":
        """Return a variant of the scene's MuJoCo model.

        Args:
            released: Whether the target object is free: its actuators are off and it collides with
                supports.
            hand: Whether the hand collides. Without it, steps take a tenth less time.
        """
        if hand and not released:
            return self._model
        found = self._variants.get((released, hand))
        if found is None:
            # Threads may copy the same variant twice; the later copy is shared.
            found = self._variants[released, hand] = self._copy(released, hand)
        return found

    def _copy(self, released: bool, hand: bool) -> "mujoco.MjModel":
        own = copy.copy(self._model)
        if released:
            geoms = slice(
                own.body_geomadr[self._target], own.body_geomadr[self._target] + own.body_geomnum[self._target]
            )
            own.geom_conaffinity[geoms] = own.body_conaffinity[self._target] = int(RELEASED_COLLISIONS)
            own.actuator_forcerange[self._actuators : self._actuators + OBJECT_DOF] = 0.0
        if not hand:
            own.body_contype[self._hand] = 0
            own.geom_contype[np.isin(own.geom_bodyid, self._hand)] = 0
        return own


def wxyz_from_xyzw(xyzw: npt.ArrayLike) -> Array:
    """Convert a quaternion (4,) from xyzw to MuJoCo's order wxyz."""
    return np.asarray(xyzw, dtype=np.float64)[WXYZ]


def wxyz_from_euler(angles: AnyArray) -> AnyArray:
    """Convert intrinsic XYZ Euler angles (..., 3) (rad) to quaternions (..., 4) wxyz."""
    return quaternions_from_euler(angles)[..., WXYZ]


def bullet_xyzw_from_wxyz(wxyz: AnyArray) -> AnyArray:
    """Convert quaternions (..., 4) from wxyz to xyzw, with the sign that Bullet returns."""
    xp, xyzw = get_namespace(wxyz), wxyz[..., XYZW]
    w, others = xyzw[..., 3:], xyzw[..., :3]
    # Bullet reads quaternions off a matrix: w is positive if the trace is, else the largest other
    # component.
    place = xp.argmax(xp.abs(others), axis=-1)[..., None]
    largest = xp.take_along_dim(others, place, -1) if is_tensor(others) else np.take_along_axis(others, place, axis=-1)
    return xp.where(xp.where(xp.abs(w) > 0.5, w, largest) < 0.0, -xyzw, xyzw)


def chain_joints_from_poses(poses: Array, reference: npt.NDArray[np.floating]) -> Array:
    """Convert world poses of m objects to joint positions (m, 6): xyz and XYZ Euler angles.

    Args:
        poses: Object positions (m) and quaternions wxyz, (m, 7).
        reference: Joint positions (m, 6) near which equivalent angles are chosen.
    """
    with warnings.catch_warnings():
        # At gimbal lock any of the equivalent angles will do.
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_quat(poses[:, 3:][:, XYZW]).as_euler("XYZ")
    wanted = np.asarray(reference[:, 3:], dtype=np.float64)
    rows = [unwrap_euler(angle[None], last)[0] for angle, last in zip(angles, wanted, strict=True)]
    return np.concatenate([poses[:, :3], np.array(rows)], axis=1)


class HandKinematics:
    """Forward kinematics of a human hand by MuJoCo, much faster than array operations.

    Args:
        urdf: Model of the hand.
        links: Numbers (k,) of the links whose poses are computed.
    """

    def __init__(self, urdf: Path, links: npt.NDArray[np.integer]) -> None:
        self._model = _compile_tree(urdf, urdf.stat().st_mtime_ns)
        self._data = mujoco.MjData(self._model)
        self._joints, self._positions, self._quaternions = self._data.qpos, self._data.xpos, self._data.xquat
        # Body 0 is the world, body 1 the base.
        self._bodies = links + 2

    def compute_poses(self, joints: Array) -> tuple[Array, Array]:
        """Compute the links' positions (k, 3) (m) and quaternions wxyz (k, 4) in the base frame.

        Args:
            joints: Positions (d,) of the moving joints (m, rad).
        """
        self._joints[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._positions[self._bodies], self._quaternions[self._bodies]

    def compute_path(self, joints: Array) -> tuple[Array, Array]:
        """Compute positions (n, k, 3) (m) and quaternions wxyz (n, k, 4) for joint positions (n, d)."""
        count, place = len(joints), self._joints
        positions = np.empty((count, *self._positions.shape))
        quaternions = np.empty((count, *self._quaternions.shape))
        for number in range(count):
            place[:] = joints[number]
            mujoco.mj_kinematics(self._model, self._data)
            positions[number], quaternions[number] = self._positions, self._quaternions
        return positions[:, self._bodies], quaternions[:, self._bodies]


@functools.lru_cache(maxsize=64)
def _compile_tree(urdf: Path, mtime: int) -> "mujoco.MjModel":
    """Compile the joints of a URDF file as a MuJoCo model without shapes."""
    tree, spec = read_tree(urdf), mujoco.MjSpec()
    bodies = {-1: spec.worldbody.add_body()}
    # Links are numbered depth first, like MuJoCo's bodies.
    for number, joint in enumerate(tree.joints):
        rotation = wxyz_from_xyzw(quaternion_from_matrix(joint.rotation))
        body = bodies[number] = bodies[joint.parent].add_body(pos=joint.offset, quat=rotation)
        # MuJoCo refuses moving bodies without mass.
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        if joint.kind != "fixed":
            slides = joint.kind == "prismatic"
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(type=kind, axis=joint.axis)
    return spec.compile()
