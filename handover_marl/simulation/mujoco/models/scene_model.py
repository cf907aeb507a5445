"""Compiled MuJoCo models of scenes, cached by their model files."""

import copy
import functools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, PANDA_DOF, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import SimulationError
from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_model_mtimes
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.motion_bounds import RobotMotionBounds
from handover_marl.simulation.mujoco.contacts import ContactSensors
from handover_marl.simulation.mujoco.models.collision_shapes import RELEASED_COLLISIONS, compute_bounding_spheres
from handover_marl.simulation.mujoco.models.scene_spec import (
    HULL_MARGIN,
    ModelPadding,
    SceneModelBuilder,
    format_hand_name,
    format_object_name,
    format_rotation_reference_name,
    read_object_friction,
)
from handover_marl.simulation.reference_tracking import BASE_JOINTS

Index = npt.NDArray[np.int32]

# A model takes 2 MB and 20 ms to build. DexYCB has 400 pairs of object and hand, and trainings use all of them.
CACHE_SIZE = 400
# Link of an object's chain that carries the mass and all shapes, after its six joints.
_OBJECT_LINK = OBJECT_DOF - 1


@dataclass(frozen=True, eq=False)
class RobotOnlyModel:
    """Compiled MuJoCo model of ground, table and robot, without objects and human hand.

    Attributes:
        model: Compiled model; only the robot's nine joints move.
        motion_bounds: Bounds on the motion of the robot.
        links: Body numbers (L,) of the links in `motion_bounds.links`.
        spheres: Site numbers (b,) of the centers of bounding spheres, first those of these links, then the base's.
    """

    model: "mujoco.MjModel"
    motion_bounds: RobotMotionBounds
    links: Index
    spheres: Index


@dataclass(frozen=True, eq=False)
class SceneModel:
    """Compiled MuJoCo model of a scene, with the array indices of its robot, m objects and human hand.

    A model is shared by worlds and never changed.

    Attributes:
        model: Compiled model.
        contact_sensors: Layout of the contact sensors in the sensor data.
        robot_qpos: Indices of the robot's nine joints in `qpos`.
        robot_qvel: Indices of the robot's nine joints in `qvel`.
        robot_ctrl: Indices of the robot's nine actuators in `ctrl`.
        gripper: Body number of the robot's hand link.
        objects: Body numbers (m,) of the objects.
        object_qpos: Indices in `qpos` of the objects' positions and quaternions wxyz, object by object.
        object_qvel: Indices in `qvel` of the objects' velocities, linear in the world frame, angular in the object's.
        object_ctrl: Indices in `ctrl` of the six actuators of each object: world xyz, then rotation relative to the
            object's rotation reference.
        rotation_references: Mocap numbers of m bodies without shapes, which have the objects' target orientations.
        hand: Mocap numbers of the k bodies of the human hand.
        hand_links: URDF link numbers (k,) of the bodies of the hand.
        robot_only: Model without hand and objects, in which robot bodies have the same numbers.
        hand_reach: Upper bound on the distance of any point of the hand from the origin of its wrist joints (m).
        object_radii: Upper bounds (m,) on the distance of any point of each object from the object's origin, in m.
    """

    model: "mujoco.MjModel"
    contact_sensors: ContactSensors
    robot_qpos: slice
    robot_qvel: slice
    robot_ctrl: slice
    gripper: int
    objects: Index
    object_qpos: slice
    object_qvel: slice
    object_ctrl: slice
    rotation_references: slice
    hand: slice
    hand_links: Index
    robot_only: RobotOnlyModel
    hand_reach: float
    object_radii: npt.NDArray[np.float64]


@functools.lru_cache(maxsize=64)
def select_variant(scene: SceneModel, released: bool, hand_collides: bool) -> "mujoco.MjModel":
    """Return the variant of a scene's MuJoCo model for the current state of an episode.

    In the model itself, the human hand collides, and actuators hold the target object. With `released`, these actuators
    are off, and the object collides with table, ground and other objects. Without `hand_collides`, the hand does not
    collide, and steps take a tenth less time.
    """
    if hand_collides and not released:
        return scene.model
    model, target = copy.copy(scene.model), scene.objects[0]
    if released:
        first = model.body_geomadr[target]
        geoms = slice(first, first + model.body_geomnum[target])
        model.geom_conaffinity[geoms] = model.body_conaffinity[target] = int(RELEASED_COLLISIONS)
        model.actuator_forcerange[scene.object_ctrl.start : scene.object_ctrl.start + OBJECT_DOF] = 0.0
    if not hand_collides:
        hand = np.flatnonzero((model.body_mocapid >= scene.hand.start) & (model.body_mocapid < scene.hand.stop))
        model.body_contype[hand] = 0
        model.geom_contype[np.isin(model.geom_bodyid, hand)] = 0
    return model


def _read_scene_mtimes(assets: SceneAssets) -> tuple[tuple[int, ...], ...]:
    return _read_mtimes((assets.table, assets.panda, *assets.objects, assets.hand))


def _read_mtimes(files: tuple[Path, ...]) -> tuple[tuple[int, ...], ...]:
    return tuple(map(read_model_mtimes, files))


@cached_by_file(CACHE_SIZE, _read_scene_mtimes)
def load_scene_model(assets: SceneAssets, config: PhysicsConfig, padding: ModelPadding | None = None) -> SceneModel:
    """Compile the MuJoCo model of a scene, or return it from the cache if no file has changed.

    Args:
        assets: Model files of the scene.
        config: Constants of the world.
        padding: Sizes to which the model is padded, None for no padding; results have no indices of added objects.
    """
    friction = read_object_friction(assets.objects[0])
    workcell = (assets.table, assets.panda), friction, config
    built = SceneModelBuilder(config, friction, _build_workcell(*workcell).copy(), padding)
    built.add_objects_and_hand(assets.objects, assets.hand)
    model = _compile(built.spec, assets.objects[0].parent.name)
    joints = [joint.link for joint in read_tree(assets.panda).joints if joint.kind != "fixed"]
    if len(joints) != PANDA_DOF:
        raise SimulationError(f"{assets.panda} has {len(joints)} moving joints, expected {PANDA_DOF}; check its URDF")
    objects = [format_object_name(number) for number in range(len(assets.objects))]
    hands = [model.body(format_hand_name(number)).id for number in range(len(built.hand_links))]
    object_ctrl = _as_slice(model.actuator(f"{name}/{axis}").id for name in objects for axis in range(OBJECT_DOF))
    object_qpos = _as_slice(model.joint(name).qposadr[0] + place for name in objects for place in range(7))
    references = (format_rotation_reference_name(number) for number in range(len(objects)))
    return SceneModel(
        model=model,
        contact_sensors=ContactSensors(model, HULL_MARGIN, object_qpos.start + 2),
        robot_qpos=_as_slice(model.joint(name).qposadr[0] for name in joints),
        robot_qvel=_as_slice(model.joint(name).dofadr[0] for name in joints),
        robot_ctrl=_as_slice(model.actuator(name).id for name in joints),
        gripper=model.body(HAND_LINK).id,
        objects=np.array([model.body(name).id for name in objects], dtype=np.int32),
        object_qpos=object_qpos,
        object_qvel=_as_slice(model.joint(name).dofadr[0] + place for name in objects for place in range(6)),
        object_ctrl=object_ctrl,
        rotation_references=_as_slice(model.body(name).mocapid[0] for name in references),
        hand=_as_slice(model.body(number).mocapid[0] for number in hands),
        hand_links=np.array(built.hand_links, dtype=np.int32),
        robot_only=_load_robot_only(*workcell),
        hand_reach=_compute_reach(assets.hand, BASE_JOINTS - 1),
        object_radii=np.array([_compute_reach(urdf, _OBJECT_LINK) for urdf in assets.objects]),
    )


def _compile(spec: "mujoco.MjSpec", name: str) -> "mujoco.MjModel":
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        raise SimulationError(f"MuJoCo refuses the model of {name} ({error})") from error


@cached_by_file(32, _read_mtimes)
def _build_workcell(table_and_panda: tuple[Path, Path], friction: float, config: PhysicsConfig) -> "mujoco.MjSpec":
    """Build the specification of ground, table and robot for an object's `friction`; the result must not be changed."""
    built = SceneModelBuilder(config, friction)
    built.add_workcell(*table_and_panda)
    return built.spec


@cached_by_file(32, _read_mtimes)
def _load_robot_only(table_and_panda: tuple[Path, Path], friction: float, config: PhysicsConfig) -> RobotOnlyModel:
    panda = table_and_panda[1]
    tree = read_tree(panda)
    bounds = RobotMotionBounds(tree, compute_bounding_spheres(panda, tree), config.panda)
    names = [tree.joints[link].link for link in bounds.links]
    spec = _build_workcell(table_and_panda, friction, config).copy()
    centers = [(spec.body(name), center) for name, center in zip(names, bounds.link_centers, strict=True)]
    centers += [(spec.worldbody, center) for center in bounds.base_centers]
    # MuJoCo moves the sites in every step, which is faster than array operations.
    for number, (body, center) in enumerate(centers):
        body.add_site(name=f"sphere{number}", pos=center)
    model = _compile(spec, panda.stem)
    links = np.array([model.body(name).id for name in names], dtype=np.int32)
    spheres = np.array([model.site(f"sphere{number}").id for number in range(len(centers))], dtype=np.int32)
    return RobotOnlyModel(model, bounds, links, spheres)


@cached_by_file(512, read_model_mtimes)
def _compute_reach(urdf: Path, link: int) -> float:
    """Return an upper bound (m) on the distance from a link's origin to the shapes it carries, at any joint angles."""
    tree = read_tree(urdf)
    return tree.compute_reach(link, compute_bounding_spheres(urdf, tree))


def _as_slice(places: Iterable[int]) -> slice:
    """Return ascending indices as a slice, which selects views; raise `SimulationError` if they have gaps."""
    found = list(places)
    if found != list(range(found[0], found[0] + len(found))):
        raise SimulationError(f"MuJoCo's numbers of the model's parts must be consecutive, got {found}; report this")
    return slice(int(found[0]), int(found[-1]) + 1)
