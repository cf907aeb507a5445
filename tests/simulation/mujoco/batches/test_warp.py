"""Tests of MuJoCo Warp's batches against MuJoCo's, on Warp's CPU device.

All tests use one model layout, whose kernels Warp compiles in about two minutes and then caches.
"""

import functools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra `warp`")

import handover_marl
from handover_marl.config import PandaConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.envs.vector.vector_env import HandoverVectorEnv
from handover_marl.errors import OptionError, SimulationError
from handover_marl.simulation.engines import BatchBackend, make_batch_worlds
from handover_marl.simulation.kinematic_paths import ReferenceMotion
from handover_marl.simulation.mujoco.batches import warp_batch
from handover_marl.simulation.mujoco.world import MujocoWorld
from handover_marl.simulation.world import BatchWorld

# The fingers start near the objects, so that they close in few steps.
PANDA = replace(PandaConfig(), start_joints=(*PandaConfig().start_joints[:7], 0.026, 0.026))
CONFIG, RULES = PhysicsConfig(panda=PANDA), ProtocolConfig()
DATA = SyntheticDataset()
WARP = BatchBackend("warp", "cpu")
#: All batches have this many rows, so that they share kernels.
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


def start_worlds(backend: BatchBackend, scenes: list[Scene], xyz: npt.ArrayLike | None = None) -> list[BatchWorld]:
    """Return worlds whose objects are at a position (m), by default between the fingers."""
    xyz = find_grasp_center() if xyz is None else xyz
    worlds = make_batch_worlds(CONFIG, CAPACITY, backend)[: len(scenes)]
    for world, scene in zip(worlds, scenes, strict=True):
        world.reset(scene, place_object(scene, xyz, 1), PANDA.start_joints)
        world.set_reference(place_object(scene, xyz, STEPS))
    if backend == WARP:
        assert len({world.batch_key[0] for world in worlds}) == 1, "one batch has different objects and hands"
    return worlds


def read_poses(worlds: list[BatchWorld]) -> npt.NDArray[np.float64]:
    """Return the robots' joint positions and the objects' poses, (n, 16)."""
    states = [world.read_state() for world in worlds]
    return np.array([[*one.robot_joint_position, *one.object_poses[0]] for one in states], dtype=np.float64)


@pytest.fixture(scope="module")
def grasps() -> npt.NDArray[np.float64]:
    """Return joint positions and object poses (3, 16) of MuJoCo Warp's worlds after the fingers have closed."""
    worlds = start_worlds(WARP, load_small_objects())
    contacts = worlds[0].simulate_rollout(worlds, [CLOSED] * 3, STEPS, RULES).contacts
    assert contacts.fingers_touch[-1].all(axis=-1).tolist() == [True, True, False]
    return read_poses(worlds)


def test_absent_objects_have_no_motion() -> None:
    scene = next(one for one in load_small_objects() if len(one.assets.objects) < 5)
    (world,) = start_worlds(WARP, [scene])
    assert isinstance(world, MujocoWorld)
    world.prepare_rollout([world], [CLOSED])
    slot, controls = world.controller.slot, world.controller.coming_controls
    assert not controls[:, slot.scene.object_ctrl.stop : slot.scene.model.nu].any()
    assert len(controls) == STEPS
    assert np.isfinite(controls).all()


def test_grasps_agree_with_the_c_engine(grasps: npt.NDArray[np.float64]) -> None:
    worlds = start_worlds(BatchBackend(), load_small_objects())
    for world in worlds:
        world.simulate_rollout([world], [CLOSED], STEPS, RULES)
    # Single precision changes the forces of the impact by some percent. Without contact there is no such difference.
    difference = np.abs(grasps - read_poses(worlds))
    assert difference[:, :12].max() < 1e-3
    assert difference[:, 12:].max() < 5e-3
    assert difference[2].max() < 1e-6


def test_a_world_does_not_depend_on_the_others_or_on_truncated_steps(grasps: npt.NDArray[np.float64]) -> None:
    worlds = start_worlds(WARP, load_small_objects()[1:])
    rollout = worlds[0].simulate_rollout(worlds, [CLOSED] * 2, STEPS, RULES)
    rollout.truncate(1, STEPS - 10)
    worlds[1].simulate_rollout(worlds[1:], [CLOSED], 10, RULES)
    np.testing.assert_array_equal(read_poses(worlds), grasps[1:])


def test_released_objects_lie_on_the_table() -> None:
    found = []
    for backend in (BatchBackend(), WARP):
        worlds = start_worlds(backend, load_small_objects()[:1], (0.4, 0.3, 0.944))
        worlds[0].release_target()
        contacts = worlds[0].simulate_rollout(worlds, [CLOSED], STEPS, RULES).contacts
        found.append((contacts.object_supported[:, 0], read_poses(worlds)[0, 9:]))
    assert found[0][0].any()
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-4)


def test_too_little_memory_for_contacts_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp_batch, "_MAX_CONTACTS", 1)
    worlds = start_worlds(WARP, load_small_objects()[:1])
    message = r"failed after 0\.000 s: too many pairs of near bodies\. To go on, use backend='threads'"
    with pytest.raises(SimulationError, match=message):
        worlds[0].simulate_rollout(worlds, [CLOSED], STEPS, RULES)


def test_a_state_that_is_not_finite_raises_an_error() -> None:
    worlds = start_worlds(WARP, load_small_objects()[:1])
    world = worlds[0]
    assert isinstance(world, MujocoWorld)
    world.prepare_rollout([world], [CLOSED])
    world.controller.slot.qpos[2] = np.nan
    with pytest.raises(SimulationError, match="Nan"):
        world.simulate_rollout([world], [CLOSED], 2, RULES)


@pytest.fixture
def envs() -> Iterator[HandoverVectorEnv]:
    made = handover_marl.vector_env(
        2, "receiver", "replay", dataset="generated:n=20", control_period=0.005, backend="warp"
    )
    yield made
    made.close()


def test_vector_env(envs: HandoverVectorEnv) -> None:
    observations, _ = envs.reset(seed=0)
    targets = observations["robot_joint_position"]
    observations, _, terminations, truncations, _ = envs.step(targets)
    assert not (terminations | truncations).any()
    np.testing.assert_allclose(observations["time"], 0.005)
    np.testing.assert_allclose(observations["robot_joint_position"], targets, atol=1e-3)


def test_options_of_vector_env() -> None:
    with pytest.raises(OptionError, match="must be left out with backend='warp', got 2 and None"):
        handover_marl.vector_env(2, backend="warp", threads=2)
    with pytest.raises(OptionError, match="no camera"):
        handover_marl.vector_env(2, backend="warp", obs_mode="pointcloud", dataset="synthetic")
    if not warp_batch.warp.is_cuda_available():
        with pytest.raises(OptionError, match="needs an NVIDIA GPU"):
            handover_marl.vector_env(2, backend="warp", device="cuda")
