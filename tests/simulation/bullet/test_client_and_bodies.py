"""Tests of PyBullet's client and window, of bodies, and of inverse kinematics, which equals HandoverSim's."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
import pytest

from handover_marl.assets.shipped import PANDA_URDF
from handover_marl.config import HandConfig, ObjectConfig, PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.errors import SimulationError
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.geometry.rotations import compute_rotation_angles
from handover_marl.geometry.ycb import SCENE_CLASSES
from handover_marl.simulation.bullet import client as client_module
from handover_marl.simulation.bullet.bodies import HAND_MASK, TABLE_MASK, HandBody, ObjectBody, PandaBody
from handover_marl.simulation.bullet.bodies import compute_object_masks as compute_masks
from handover_marl.simulation.bullet.client import connect
from handover_marl.simulation.bullet.kinematics import BulletIKSolver, BulletIKStep
from handover_marl.simulation.bullet.sleepable_bodies import read_bounding_spheres


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X11 is Linux's way to a screen")
def test_missing_x_server_is_an_error_also_without_stderr() -> None:
    code = (
        "import os, sys; os.close(2); sys.stderr = None\n"
        "from handover_marl.errors import SimulationError\n"
        "from handover_marl.simulation.bullet.client import connect\n"
        "connect()\n"
        "try:\n    connect(window=True)\n"
        "except SimulationError as error:\n    print('error:', error)\n"
    )
    env = {**os.environ, "DISPLAY": ":77"}
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True, env=env)
    assert "error:" in done.stdout
    assert "xvfb-run" in done.stdout
    assert "rgb_array" in done.stdout


def test_second_window_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(mode: int) -> int:
        raise pybullet.error("Only one local in-process GUI/GUI_SERVER connection allowed.")

    monkeypatch.setattr(client_module, "_require_screen", lambda: None)
    monkeypatch.setattr(pybullet, "connect", refuse)
    with pytest.raises(SimulationError, match="close the other environment"):
        connect(window=True)


def test_bounding_spheres_are_those_of_the_present_mesh(tmp_path: Path) -> None:
    urdf, mesh, radii = tmp_path / "thing.urdf", tmp_path / "thing.obj", []
    shape = '<collision><geometry><mesh filename="thing.obj"/></geometry></collision>'
    urdf.write_text(f'<robot name="thing"><link name="thing">{shape}</link></robot>')
    for size in (0.1, 0.2):
        corners = [(0.0, 0.0, 0.0), (size, 0.0, 0.0), (0.0, size, 0.0), (0.0, 0.0, size)]
        faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        mesh.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + faces)
        os.utime(mesh, (size, size))
        radii.append(read_bounding_spheres(urdf)[-1].radius)
    assert radii[1] > 1.5 * radii[0]


def test_close_after_the_server_has_gone() -> None:
    client = connect()
    client.disconnect()
    client.close()
    client.close()


URDFS = {"table": "table/table.urdf", "object": "003_cracker_box/model_normalized.urdf"}


@pytest.mark.parametrize(
    ("kind", "arguments", "other", "expected", "found"),
    [
        (ObjectBody, (2, ObjectConfig(), [0.0] * 6), "table", 6, 0),
        (HandBody, ([0.0] * 51, HandConfig()), "object", 51, 6),
        (PandaBody, (PandaConfig(),), "object", 9, 6),
    ],
)
def test_models_that_are_something_else(
    fake_data: Path, kind: type[Any], arguments: tuple[Any, ...], other: str, expected: int, found: int
) -> None:
    message = f"'{other}' loaded as {kind.__name__} must have {expected} moving joints, got {found}"
    with pytest.raises(SimulationError, match=message):
        kind(connect(), fake_data / "assets" / URDFS[other], *arguments)


@pytest.mark.slow
def test_a_panda_without_a_link(tmp_path: Path) -> None:
    urdf = shutil.copytree(PANDA_URDF.parent, tmp_path / "panda") / PANDA_URDF.name
    urdf.write_text(urdf.read_text().replace('"panda_leftfinger"', '"renamed"'))
    with pytest.raises(SimulationError, match=r"loaded as PandaBody has no link 'panda_leftfinger'.*renamed"):
        PandaBody(connect(), urdf, PandaConfig())


def test_masks_of_objects() -> None:
    """The masks of YCB classes are HandoverSim's; no two bodies share a bit."""
    assert compute_masks(SCENE_CLASSES[:5]) == [2, 4, 8, 16, 32]
    assert compute_masks((21, 1)) == [2**20, 2]
    for class_ids in ((1, 1, 1), (150, 7, 22, 7), tuple(range(22, 51))):
        masks = [TABLE_MASK, HAND_MASK, *compute_masks(class_ids)]
        assert all(mask.bit_count() == 1 and mask < 2**31 for mask in masks)
        assert len(set(masks)) == len(masks)
    with pytest.raises(SimulationError, match="at most 29 objects, got 30"):
        compute_masks(range(22, 52))


DATA = SyntheticDataset()
START = PandaConfig().start_joints
BASE = np.array([*PandaConfig().base_position, *PandaConfig().base_orientation])
POSE = np.array([0.55, -0.05, 1.25, -0.5, 0.5, 0.5, 0.5])


@pytest.mark.parametrize("orientation", [None, POSE[3:]])
def test_single_queries_equal_those_in_the_world(orientation: np.ndarray | None) -> None:
    kinematics, episode = BulletIKStep(DATA.panda_urdf, PandaConfig()), Episode("exact")
    episode.reset(DATA.load_scene(9))
    episode.advance(np.array([0.4, *START[1:]], dtype=np.float32), 57)
    world = episode.world
    target = [POSE[:3].tolist()] if orientation is None else [POSE[:3].tolist(), orientation.tolist()]
    panda = world._loaded_workcell.panda
    expected = world._client.calculateInverseKinematics(panda.id, panda.hand_link, *target)
    for _ in range(2):
        found = kinematics.solve_step(world.read_joints_float64(), POSE[:3], orientation)
        np.testing.assert_array_equal(found, expected)
        # Another query in between must not change the next solution.
        kinematics.solve_step(world.read_joints_float64(), POSE[:3] + 0.1)
    rounded = kinematics.solve_step(world.read_joints_float64().astype(np.float32), POSE[:3], orientation)
    assert (rounded != expected).any(), "float32 joints are not enough"
    solver = BulletIKSolver(DATA.panda_urdf, PandaConfig())
    arm = solver.solve(START, POSE[:3], orientation)
    assert arm is not None
    panda.reset_joints([*arm, 0.04, 0.04])
    pose = episode.observe()["gripper_pose"]
    assert np.linalg.norm(pose[:3] - POSE[:3]) < 2e-3
    assert orientation is None or compute_rotation_angles(pose[3:], orientation) < 0.11
    assert solver.solve(START, (3.0, 0.0, 1.0)) is None
    np.testing.assert_array_equal(solver.solve(START, POSE[:3], orientation), arm)
    episode.close()


def test_poses_transform_to_the_base_and_back() -> None:
    kinematics = BulletIKStep(DATA.panda_urdf, PandaConfig())
    inside = kinematics.to_base_frame(POSE.astype(np.float32))
    back = kinematics.to_world_frame(inside)
    for found, expected in ((inside, compose(invert_pose(BASE), POSE)), (back, POSE)):
        np.testing.assert_allclose(found[:3], expected[:3], atol=2e-7)
        assert compute_rotation_angles(found[3:], expected[3:]) < 1e-3
        np.testing.assert_array_equal(found, found.astype(np.float32))
