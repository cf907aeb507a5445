"""Tests of contacts in MuJoCo Warp's worlds against MuJoCo's, on Warp's CPU device.

All tests use one model layout, whose kernels Warp compiles in about a minute and then caches.
"""

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra `warp`")


from handover_marl.config import PandaConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import SimulationError
from handover_marl.geometry.arrays import AnyArray, make_tensor_factory, to_numpy
from handover_marl.geometry.poses import transform_points
from handover_marl.simulation.mujoco.batches import warp_group
from handover_marl.simulation.mujoco.batches.warp_world_batch import WarpWorldBatch
from handover_marl.simulation.mujoco.world import MujocoWorld
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import RolloutContacts, RolloutEnd

pytestmark = pytest.mark.slow

# The fingers start near the objects, so that they close in few steps.
PANDA = replace(PandaConfig(), start_joints=(*PandaConfig().start_joints[:7], 0.026, 0.026))
CONFIG, RULES = PhysicsConfig(panda=PANDA), ProtocolConfig()
TENSORS = make_tensor_factory("cpu")
CLOSED = [*PANDA.start_joints[:7], 0.0, 0.0]
STEPS = 40
#: Scenes with a banana, an extra large clamp and a large marker; the closed fingers touch the first two.
SCENES = (45, 90, 85)
#: Position of an object that lies on the table (m).
ON_THE_TABLE = (0.4, 0.3, 0.944)
Judge = Callable[[AnyArray, RolloutContacts], RolloutEnd]


@functools.cache
def load_scenes() -> list[Scene]:
    """Return scenes with different objects, each of which fits between the fingers."""
    return [SyntheticDataset().load_scene(number) for number in SCENES]


def place_object(scene: Scene, xyz: npt.ArrayLike, steps: int) -> ReferenceMotion:
    """Return the motion of a target that stays at a position (m), without a hand; other objects are far away."""
    count = scene.object_dof.shape[1]
    dof = np.zeros((steps, count, 6), dtype=np.float32)
    dof[..., 0], dof[..., 2] = 5.0 + np.arange(count), 2.0
    dof[:, 0, :3] = xyz
    return ReferenceMotion(dof, np.zeros((steps, 51), np.float32), np.zeros(steps, dtype=bool))


def start_single(scene: Scene, xyz: npt.ArrayLike) -> MujocoWorld:
    """Return a world of MuJoCo whose target object is at a position (m)."""
    world = MujocoWorld(CONFIG)
    world.reset(scene, place_object(scene, xyz, 1), PANDA.start_joints)
    world.set_reference(place_object(scene, xyz, STEPS))
    return world


@functools.cache
def find_grasp_center() -> npt.NDArray[np.float64]:
    """Return the position between the fingers of the robot at its start (m)."""
    pose = start_single(load_scenes()[0], (0.0, 0.0, 2.0)).read_state().gripper_pose
    return np.asarray(transform_points(pose.astype(np.float64), np.array([0.0, 0.0, 0.1])))


def roll_out(worlds: WarpWorldBatch, xyz: npt.ArrayLike, count: int, judge: Judge) -> None:
    """Place the objects of new scenes in the first worlds, and close the fingers."""
    scenes = load_scenes()[:count]
    for row, scene in enumerate(scenes):
        worlds.reset(row, scene, place_object(scene, xyz, 1), PANDA.start_joints)
    objects = np.zeros((count, STEPS, 5, 6), dtype=np.float32)
    for own, scene in zip(objects, scenes, strict=True):
        own[:, : scene.object_dof.shape[1]] = place_object(scene, xyz, STEPS).objects
    absent = np.zeros((count, STEPS, 51), np.float32), np.zeros((count, STEPS), dtype=bool)
    reference = ReferenceMotion(*map(TENSORS.asarray, (objects, *absent)))
    targets = TENSORS.asarray(np.tile(CLOSED, (count, 1)), "float32")
    worlds.rollout(TENSORS.arange(count), reference, targets, judge, RULES)


def make_judge(contacts: list[RolloutContacts], release_step: int = 0) -> Judge:
    """Return a function that records the contacts, and releases the objects after a step."""

    def judge(rows: AnyArray, found: RolloutContacts) -> RolloutEnd:
        contacts.append(found)
        count = len(rows)
        released = TENSORS.full(count, len(contacts) == release_step, "bool")
        return RolloutEnd(TENSORS.full(count, 1, "int64"), released, TENSORS.zeros(count, "bool"))

    return judge


def test_grasps_agree_with_the_c_engine() -> None:
    worlds, contacts = WarpWorldBatch(CONFIG, 3, TENSORS), list[RolloutContacts]()
    roll_out(worlds, find_grasp_center(), 3, make_judge(contacts))
    assert to_numpy(contacts[-1].fingers_touch[0]).all(axis=-1).tolist() == [True, True, False]
    assert len(contacts) == STEPS, "one group has different objects"
    assert worlds.are_grasped(TENSORS.arange(3)).tolist() == [True, True, False]
    assert worlds.read_contacts(0, False).both_fingers_touch
    assert not worlds.read_contacts(2, False).both_fingers_touch
    state = worlds.read_state(TENSORS.arange(3))
    for row, scene in enumerate(load_scenes()):
        world = start_single(scene, find_grasp_center())
        for _ in range(STEPS):
            world.step(CLOSED)
        expected = world.read_state()
        # Single precision changes the forces of the impact by some percent; without contact there is no difference.
        positions, turns = (1e-6, 1e-6) if row == 2 else (1e-3, 5e-3)
        np.testing.assert_allclose(state.robot_joint_position[row], expected.robot_joint_position, atol=positions)
        np.testing.assert_allclose(state.object_poses[row, 0, :3], expected.object_poses[0, :3], atol=positions)
        np.testing.assert_allclose(state.object_poses[row, 0, 3:], expected.object_poses[0, 3:], atol=turns)


def test_released_objects_lie_on_the_table() -> None:
    world = start_single(load_scenes()[0], ON_THE_TABLE)
    world.release_target()
    expected = []
    for _ in range(STEPS):
        world.step(CLOSED)
        expected.append(world.read_contacts(released=True).object_supported)
    assert any(expected)
    worlds, contacts = WarpWorldBatch(CONFIG, 3, TENSORS), list[RolloutContacts]()
    roll_out(worlds, ON_THE_TABLE, 1, make_judge(contacts, release_step=1))
    supported = [bool(found.object_supported[0, 0]) for found in contacts]
    assert supported[1:] == expected[:-1], "an object falls from the step after its release on"


def test_a_failed_simulation_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SimulationError, match="Nan"):
        roll_out(WarpWorldBatch(CONFIG, 3, TENSORS), (0.4, np.nan, 1.0), 1, make_judge([]))
    monkeypatch.setattr(warp_group, "_MAX_CONTACTS", 1)
    message = r"failed: too many pairs of near bodies\. To go on, use backend='threads'"
    with pytest.raises(SimulationError, match=message):
        roll_out(WarpWorldBatch(CONFIG, 3, TENSORS), find_grasp_center(), 1, make_judge([]))
