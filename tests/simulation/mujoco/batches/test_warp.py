"""Tests of MuJoCo Warp's worlds against MuJoCo's, on Warp's CPU device.

All tests use one model layout, whose kernels Warp compiles in about a minute and then caches.
"""

import functools
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra `warp`")

import mujoco

import handover_marl
from handover_marl.config import PandaConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import OptionError, SimulationError
from handover_marl.geometry.arrays import AnyArray, make_tensor_factory, to_numpy
from handover_marl.simulation.contacts import ContactBatch, RolloutEnd
from handover_marl.simulation.mujoco.batches import warp_group
from handover_marl.simulation.mujoco.batches.simulation import BatchSimulation
from handover_marl.simulation.mujoco.batches.warp_model import WarpModel
from handover_marl.simulation.mujoco.batches.warp_worlds import WarpWorlds
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.models.scene_spec import ModelPadding
from handover_marl.simulation.mujoco.world import MujocoWorld
from handover_marl.simulation.reference_tracking import ReferenceMotion

# The fingers start near the objects, so that they close in few steps.
PANDA = replace(PandaConfig(), start_joints=(*PandaConfig().start_joints[:7], 0.026, 0.026))
CONFIG, RULES = PhysicsConfig(panda=PANDA), ProtocolConfig()
DATA = SyntheticDataset()
TENSORS = make_tensor_factory("cpu")
#: All simulations have this many rows, so that they share kernels.
CAPACITY = 3
CLOSED = [*PANDA.start_joints[:7], 0.0, 0.0]
STEPS = 40
#: The closed fingers touch the first two of these objects.
NAMES = ("011_banana", "052_extra_large_clamp", "040_large_marker")


@functools.cache
def load_small_objects() -> list[Scene]:
    """Return scenes with different objects and hands; each target object fits between the fingers."""
    found: dict[str, Scene] = {}
    for scene_id in DATA.list_scenes("s0", "train"):
        if len(found) == len(NAMES):
            break
        scene = DATA.load_scene(scene_id)
        name = scene.info.object_names[0]
        hands = [one.assets.hand for one in found.values()]
        if name in NAMES and name not in found and scene.assets.hand not in hands:
            found[name] = scene
    return [found[name] for name in NAMES]


def place_object(scene: Scene, xyz: npt.ArrayLike, steps: int) -> ReferenceMotion:
    """Return the motion of a target that stays at a position (m), without a hand; other objects are far away."""
    count = scene.object_dof.shape[1]
    dof = np.zeros((steps, count, 6), dtype=np.float32)
    dof[..., 0], dof[..., 2] = 5.0 + np.arange(count), 2.0
    dof[:, 0, :3] = xyz
    return ReferenceMotion(dof, np.zeros((steps, 51), np.float32), np.zeros(steps, dtype=bool))


@functools.cache
def find_grasp_center() -> npt.NDArray[np.float32]:
    """Return the position between the fingers of the robot at its start (m)."""
    world = MujocoWorld(CONFIG)
    scene = load_small_objects()[0]
    world.reset(scene, place_object(scene, (0.0, 0.0, 2.0), 1), PANDA.start_joints)
    x, y, z, w = (pose := world.read_state().gripper_pose)[3:]
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return np.asarray(pose[:3] + 0.1 * axis, dtype=np.float32)


def start_batch_worlds(scenes: list[Scene], xyz: npt.ArrayLike | None = None) -> list[MujocoWorld]:
    """Return worlds of MuJoCo whose objects are at a position (m), by default between the fingers."""
    xyz = find_grasp_center() if xyz is None else xyz
    simulation = BatchSimulation()
    worlds = [MujocoWorld(CONFIG, simulation=simulation) for _ in scenes]
    for world, scene in zip(worlds, scenes, strict=True):
        world.reset(scene, place_object(scene, xyz, 1), PANDA.start_joints)
        world.set_reference(place_object(scene, xyz, STEPS))
    return worlds


def start_device_worlds(scenes: list[Scene], xyz: npt.ArrayLike | None = None) -> WarpWorlds:
    """Return worlds of MuJoCo Warp, the first ones in these scenes with the objects at a position (m)."""
    worlds = WarpWorlds(CONFIG, CAPACITY, TENSORS)
    for row, scene in enumerate(scenes):
        worlds.reset(
            row, scene, place_object(scene, find_grasp_center() if xyz is None else xyz, 1), PANDA.start_joints
        )
    return worlds


def make_reference(scenes: list[Scene], xyz: npt.ArrayLike | None = None, steps: int = STEPS) -> ReferenceMotion:
    """Return the motion of `place_object` in every scene as tensors."""
    xyz = find_grasp_center() if xyz is None else xyz
    motions = [place_object(scene, xyz, steps) for scene in scenes]
    objects = np.zeros((len(scenes), steps, 5, 6), dtype=np.float32)
    for own, motion in zip(objects, motions, strict=True):
        own[:, : motion.objects.shape[1]] = motion.objects
    hands, present = (np.stack([getattr(one, name) for one in motions]) for name in ("hand", "hand_present"))
    return ReferenceMotion(*map(TENSORS.asarray, (objects, hands, present)))


def simulate(
    worlds: WarpWorlds, scenes: list[Scene], ends: list[int], rows: list[int] | None = None
) -> list[ContactBatch]:
    """Close the fingers in some worlds, each of which ends after a number of steps; return the contacts."""
    steps, contacts = 0, []
    last = TENSORS.asarray(ends)

    def judge(rows: AnyArray, found: ContactBatch) -> RolloutEnd:
        nonlocal steps
        steps += 1
        contacts.append(found)
        return RolloutEnd((last >= steps) + 0, TENSORS.zeros(len(ends), "bool"), last <= steps)

    chosen = TENSORS.asarray(np.arange(len(scenes)) if rows is None else np.array(rows))
    targets = TENSORS.asarray(np.tile(CLOSED, (len(scenes), 1)), "float32")
    simulated = worlds.rollout(chosen, make_reference(scenes, steps=max(ends)), targets, judge, RULES)
    assert simulated.tolist() == ends
    return contacts


def read_batch_poses(worlds: list[MujocoWorld]) -> npt.NDArray[np.float64]:
    """Return the robots' joint positions and the objects' poses of worlds of MuJoCo, (n, 16)."""
    states = [world.read_state() for world in worlds]
    return np.array([[*one.robot_joint_position, *one.object_poses[0]] for one in states], dtype=np.float64)


def read_device_poses(worlds: WarpWorlds, rows: list[int]) -> npt.NDArray[np.float64]:
    """Return the robots' joint positions and the objects' poses of worlds of MuJoCo Warp, (n, 16)."""
    state = worlds.read_state(TENSORS.asarray(rows))
    return np.concatenate([to_numpy(state.robot_joint_position), to_numpy(state.object_poses[:, 0])], axis=1).astype(
        float
    )


@pytest.fixture(scope="module")
def grasps() -> npt.NDArray[np.float64]:
    """Return joint positions and object poses (3, 16) of MuJoCo Warp's worlds after the fingers have closed."""
    scenes = load_small_objects()
    worlds = start_device_worlds(scenes)
    contacts = simulate(worlds, scenes, [STEPS] * 3)
    assert to_numpy(contacts[-1].fingers_touch[0]).all(axis=-1).tolist() == [True, True, False]
    assert len(contacts) == STEPS, "one group has different objects"
    assert worlds.are_grasped(TENSORS.arange(3), RULES).tolist() == [True, True, False]
    assert worlds.read_contacts(0, False).both_fingers_touch
    assert not worlds.read_contacts(2, False).both_fingers_touch
    return read_device_poses(worlds, [0, 1, 2])


@pytest.mark.slow
def test_grasps_agree_with_the_c_engine(grasps: npt.NDArray[np.float64]) -> None:
    worlds = start_batch_worlds(load_small_objects())
    for world in worlds:
        world.simulate([world], [CLOSED], STEPS, RULES)
    # Single precision changes the forces of the impact by some percent. Without contact there is no such difference.
    difference = np.abs(grasps - read_batch_poses(worlds))
    assert difference[:, :12].max() < 1e-3
    assert difference[:, 12:].max() < 5e-3
    assert difference[2].max() < 1e-6


@pytest.mark.slow
def test_a_world_does_not_depend_on_the_others_or_on_steps_after_its_end(grasps: npt.NDArray[np.float64]) -> None:
    scenes = load_small_objects()
    worlds = start_device_worlds([scenes[0], *scenes[1:]])
    simulate(worlds, scenes[1:], [STEPS, STEPS - 10], rows=[1, 2])
    assert np.abs(read_device_poses(worlds, [2]) - grasps[2:]).max() > 1e-6, "it has stopped earlier"
    simulate(worlds, scenes[2:], [10], rows=[2])
    np.testing.assert_array_equal(read_device_poses(worlds, [1, 2]), grasps[1:])


def test_released_objects_lie_on_the_table() -> None:
    scenes, xyz = load_small_objects()[:1], (0.4, 0.3, 0.944)
    (world,) = start_batch_worlds(scenes, xyz)
    world.release_target()
    expected = world.simulate([world], [CLOSED], STEPS, RULES)[0].object_supported[:, 0]
    assert expected.any()
    for at_start in (True, False):
        worlds, supported = start_device_worlds(scenes, xyz), []
        if at_start:
            worlds.release_targets(TENSORS.asarray([0]))

        def judge(
            rows: AnyArray, found: ContactBatch, supported: list[bool] = supported, now: bool = not at_start
        ) -> RolloutEnd:
            supported.append(bool(found.object_supported[0, 0]))
            released = TENSORS.full(1, now and len(supported) == 1, "bool")
            return RolloutEnd(TENSORS.full(1, 1, "int64"), released, TENSORS.zeros(1, "bool"))

        targets = TENSORS.asarray([CLOSED], "float32")
        worlds.rollout(TENSORS.asarray([0]), make_reference(scenes, xyz), targets, judge, RULES)
        if at_start:
            assert supported == expected.tolist()
            np.testing.assert_allclose(
                read_device_poses(worlds, [0])[0, 9:], read_batch_poses([world])[0, 9:], atol=1e-4
            )
        else:
            assert supported[1:] == expected[:-1].tolist(), "an object falls from the step after its release on"


def test_jacobians_are_dense() -> None:
    scene = load_scene_model(load_small_objects()[0].assets, CONFIG, padding=ModelPadding(objects=8, hulls=20))
    assert scene.model.nv == 57
    assert not mujoco.mj_isSparse(WarpModel(scene, 1, TENSORS).source)


def test_too_little_memory_for_contacts_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp_group, "_MAX_CONTACTS", 1)
    scenes = load_small_objects()[:1]
    message = r"failed: too many pairs of near bodies\. To go on, use backend='threads'"
    with pytest.raises(SimulationError, match=message):
        simulate(start_device_worlds(scenes), scenes, [STEPS])


def test_a_state_that_is_not_finite_raises_an_error() -> None:
    scenes = load_small_objects()[:1]
    worlds = WarpWorlds(CONFIG, CAPACITY, TENSORS)
    worlds.reset(0, scenes[0], place_object(scenes[0], (0.4, np.nan, 1.0), 1), PANDA.start_joints)
    with pytest.raises(SimulationError, match="Nan"):
        simulate(worlds, scenes, [2])


def test_options_of_vector_env() -> None:
    with pytest.raises(OptionError, match="must be left out with backend='warp', got 2 and None"):
        handover_marl.vector_env(2, backend="warp", threads=2)
    with pytest.raises(OptionError, match="must have physics='mujoco'"):
        handover_marl.vector_env(2, backend="warp", physics="fast", dataset="synthetic")
    if not warp_group.warp.is_cuda_available():
        with pytest.raises(OptionError, match="needs an NVIDIA GPU"):
            handover_marl.vector_env(2, backend="warp", device="cuda")
