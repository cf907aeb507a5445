"""Compiled models of scenes: built once for each set of bodies and kept, whatever plays them."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, PANDA_DOF, PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.errors import SimulationError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.panda import FINGER_LINKS, HAND_LINK
from handover_marl.models.urdf_shapes import named_meshes
from handover_marl.sim.clearance import Clearance
from handover_marl.sim.hand_path import BASE_JOINTS
from handover_marl.sim.mujoco.hull_parts import link_balls
from handover_marl.sim.mujoco.model_variants import ModelVariants
from handover_marl.sim.mujoco.never_touching import never_touching
from handover_marl.sim.mujoco.scene_spec import SceneSpec, guide_name, hand_name, object_friction, object_name
from handover_marl.sim.mujoco.touch import TouchSensors
from handover_marl.sim.mujoco.tuning import TUNING, Tuning

Index = npt.NDArray[np.int32]

# A model takes 1.2 MB and some 20 ms to build; DexYCB has 400 pairs of object and hand, s0 train 360 of them.
_KEPT = 400
# The link of an object's chain that carries everything, behind its six joints.
_OBJECT_LINK = OBJECT_DOF - 1


@dataclass(frozen=True, eq=False)
class StageModel:
    """What is there before anything is handed over, as a compiled model.

    Attributes:
        model: Ground, table and robot; the robot's nine joints are all that moves.
        clearance: Bounds on where the robot can get.
        links: (L,) body numbers of the links that these are about.
    """

    model: "mujoco.MjModel"
    clearance: Clearance
    links: Index


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A scene's bodies as a compiled model, and where in its arrays they are. Worlds share it; nobody changes it.

    Attributes:
        model: The model, everything at the origin.
        variants: The same for moments in which the target object is let go, or the hand out of reach.
        touch: Its touch sensors.
        robot_qpos: Places of the robot's nine joints in `qpos`.
        robot_qvel: Likewise in `qvel`.
        robot_ctrl: Its servos.
        gripper: Body number of the robot's hand link.
        fingers: (2,) of the left and the right finger.
        objects: (m,) body numbers of the objects.
        object_qpos: Where in `qpos` their m positions and quaternions wxyz are, one after the other.
        object_qvel: Likewise in `qvel` their velocities, linear in the world's frame and angular in their own.
        object_ctrl: Their servos, six each: world xyz, then a rotation that is led by the guide.
        guides: The m mocap bodies that say how objects are to be turned.
        hand: The k mocap bodies of the hand.
        hand_links: (k,) the links that these are.
        stage: The same without hand and objects; its bodies have the same numbers in both.
        hand_reach: How far the hand reaches from the origin of its base joints (m).
        object_reaches: (m,) how far the objects reach from theirs (m).
    """

    model: "mujoco.MjModel"
    variants: ModelVariants
    touch: TouchSensors
    robot_qpos: slice
    robot_qvel: slice
    robot_ctrl: slice
    gripper: int
    fingers: Index
    objects: Index
    object_qpos: slice
    object_qvel: slice
    object_ctrl: slice
    guides: slice
    hand: slice
    hand_links: Index
    stage: StageModel
    hand_reach: float
    object_reaches: npt.NDArray[np.float64]


def scene_model(assets: SceneAssets, config: PhysicsConfig, tuning: Tuning = TUNING) -> SceneModel:
    """The model of a scene's bodies; built once for the same files.

    Raises:
        SimulationError, DataFormatError: A model or a mesh cannot be read, or MuJoCo refuses it.
    """
    files = (assets.table, assets.panda, *assets.objects, assets.hand)
    try:
        changed = tuple(_changed(urdf) for urdf in files)
    except OSError as error:
        raise SimulationError(f"{error.filename}: cannot read this model ({error.strerror or error})") from error
    return _built(assets, changed, config, tuning)


def _changed(urdf: Path) -> tuple[int, ...]:
    own = urdf.stat().st_mtime_ns
    return (own, *(mesh.stat().st_mtime_ns if mesh.exists() else 0 for mesh in _meshes(urdf, own)))


@functools.lru_cache(maxsize=256)
def _meshes(urdf: Path, changed: int) -> tuple[Path, ...]:
    return tuple(mesh for _, mesh in named_meshes(urdf))


@functools.lru_cache(maxsize=_KEPT)
def _built(
    assets: SceneAssets, changed: tuple[tuple[int, ...], ...], config: PhysicsConfig, tuning: Tuning
) -> SceneModel:
    apart = _never_touching(assets.panda, changed[1], config, tuning)
    built = SceneSpec.of_scene(assets, config, tuning, apart)
    model = _compiled(built, assets.objects[0].parent.name)
    tree = read_tree(assets.panda)
    joints = [joint.link for joint in tree.joints if joint.kind != "fixed"]
    if len(joints) != PANDA_DOF:
        raise SimulationError(f"{assets.panda} has {len(joints)} moving joints, expected {PANDA_DOF}; check its URDF")
    stage = _stage(assets.table, assets.panda, changed[:2], object_friction(assets.objects[0]), config, tuning)
    objects = [object_name(number) for number in range(len(assets.objects))]
    hands = [model.body(hand_name(number)).id for number in range(len(built.hand_links))]
    object_ctrl = _run(model.actuator(f"{name}/{axis}").id for name in objects for axis in range(OBJECT_DOF))
    return SceneModel(
        model=model,
        variants=ModelVariants(model, model.body(objects[0]).id, object_ctrl.start, hands),
        touch=TouchSensors(model, tuning.margin),
        robot_qpos=_run(model.joint(name).qposadr[0] for name in joints),
        robot_qvel=_run(model.joint(name).dofadr[0] for name in joints),
        robot_ctrl=_run(model.actuator(name).id for name in joints),
        gripper=_body(model, HAND_LINK, assets.panda),
        fingers=np.array([_body(model, name, assets.panda) for name in FINGER_LINKS], dtype=np.int32),
        objects=np.array([model.body(name).id for name in objects], dtype=np.int32),
        object_qpos=_run(model.joint(name).qposadr[0] + place for name in objects for place in range(7)),
        object_qvel=_run(model.joint(name).dofadr[0] + place for name in objects for place in range(6)),
        object_ctrl=object_ctrl,
        guides=_run(model.body(guide_name(number)).mocapid[0] for number in range(len(objects))),
        hand=_run(model.body(number).mocapid[0] for number in hands),
        hand_links=np.array(built.hand_links, dtype=np.int32),
        stage=stage,
        hand_reach=_reach(assets.hand, changed[-1], BASE_JOINTS - 1),
        object_reaches=np.array(
            [_reach(*item, _OBJECT_LINK) for item in zip(assets.objects, changed[2:-1], strict=True)]
        ),
    )


@functools.lru_cache(maxsize=16)
def _never_touching(
    panda: Path, changed: tuple[int, ...], config: PhysicsConfig, tuning: Tuning
) -> tuple[tuple[str, str], ...]:
    """Names of the robot's links that cannot touch; to prove it takes a tenth of a second."""
    model = _compiled(SceneSpec.of_robot(panda, config, tuning), panda.stem)
    return tuple((model.body(one).name, model.body(other).name) for one, other in never_touching(model))


def _compiled(built: SceneSpec, name: str) -> "mujoco.MjModel":
    try:
        return built.spec.compile()
    except (ValueError, RuntimeError) as error:
        raise SimulationError(f"MuJoCo refuses the model of {name} ({error})") from error


@functools.lru_cache(maxsize=32)
def _stage(
    table: Path,
    panda: Path,
    changed: tuple[tuple[int, ...], ...],
    friction: float,
    config: PhysicsConfig,
    tuning: Tuning,
) -> StageModel:
    tree = read_tree(panda)
    built = SceneSpec.of_stage(
        table, panda, friction, config, tuning, _never_touching(panda, changed[1], config, tuning)
    )
    model, clearance = _compiled(built, panda.stem), Clearance(tree, link_balls(panda, tree), config.panda)
    links = np.array([model.body(tree.joints[link].link).id for link in clearance.links], dtype=np.int32)
    return StageModel(model, clearance, links)


@functools.lru_cache(maxsize=512)
def _reach(urdf: Path, changed: tuple[int, ...], link: int) -> float:
    """How far a model reaches from the origin of a link (m)."""
    tree = read_tree(urdf)
    return tree.reach(link, link_balls(urdf, tree))


def _run(places: Iterable[int]) -> slice:
    """Places that follow each other, as views want them."""
    found = list(places)
    if found != list(range(found[0], found[0] + len(found))):
        raise SimulationError(f"MuJoCo numbers a model otherwise than it was built: {found}; report this")
    return slice(int(found[0]), int(found[-1]) + 1)


def _body(model: "mujoco.MjModel", name: str, urdf: Path) -> int:
    try:
        return int(model.body(name).id)
    except KeyError as error:
        raise SimulationError(f"{urdf} has no link {name!r}; check its URDF") from error
