from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, VISUAL_NAME, find_object_urdf
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.geometry.model_files.obj_files import read_obj
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.bullet.client import BulletClient, connect
from tests.assets.ycb_bounds import YCB_BOUNDS

NAMES = tuple(CLASS_NAMES.values())


@pytest.fixture
def client() -> BulletClient:
    return connect()


@pytest.mark.parametrize("name", NAMES)
def test_urdf_has_the_official_structure(client: BulletClient, name: str) -> None:
    body = client.loadURDF(str(find_object_urdf(name)), useFixedBase=True)
    infos = [client.getJointInfo(body, joint) for joint in range(client.getNumJoints(body))]
    assert [info[2] for info in infos] == [client.JOINT_PRISMATIC] * 3 + [client.JOINT_REVOLUTE] * 3
    assert [info[12].decode() for info in infos] == [f"link{number}" for number in range(1, 7)]
    assert [info[13] for info in infos] == [tuple(axis) for axis in np.eye(3).tolist() * 2]
    dynamics = client.getDynamicsInfo(body, 5)
    assert dynamics[:2] == (0.5, 0.9)
    assert [len(client.getCollisionShapeData(body, link)) for link in range(-1, 5)] == [0] * 6
    assert len(client.getVisualShapeData(body)) == 1


@pytest.mark.parametrize("name", ["025_mug", "037_scissors", "061_foam_brick"])
def test_every_convex_part_collides(client: BulletClient, name: str) -> None:
    body = client.loadURDF(str(find_object_urdf(name)), useFixedBase=True)
    ball = client.createMultiBody(0, client.createCollisionShape(client.GEOM_SPHERE, radius=1e-4))
    for part in read_solid(find_object_urdf(name)).parts:
        client.resetBasePositionAndOrientation(ball, part.vertices.mean(axis=0).tolist(), (0, 0, 0, 1))
        assert client.getClosestPoints(ball, body, 0.0)


@pytest.mark.parametrize("name", NAMES)
def test_size_and_frame_are_those_of_the_scans(name: str) -> None:
    for file in (VISUAL_NAME, COLLISION_NAME):
        vertices = read_obj(OBJECTS_ROOT / name / file).vertices
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        np.testing.assert_allclose(bounds, YCB_BOUNDS[name], rtol=0, atol=0.003)


@pytest.mark.parametrize(
    ("name", "point"),
    [
        ("024_bowl", (0.0, 0.0, 0.02)),
        ("025_mug", (-0.004, 0.0, 0.0)),
        ("025_mug", (0.047, 0.0, 0.0)),  # between wall and handle
        ("037_scissors", (0.012, -0.036, 0.0)),  # inside a loop
        ("052_extra_large_clamp", (-0.04, -0.004, 0.0)),  # between the jaws
        ("019_pitcher_base", (0.045, 0.045, 0.02)),  # between body and handle
    ],
)
def test_openings_are_open(client: BulletClient, name: str, point: tuple[float, float, float]) -> None:
    client.loadURDF(str(find_object_urdf(name)), useFixedBase=True)
    ball = client.createMultiBody(0, client.createCollisionShape(client.GEOM_SPHERE, radius=0.004), -1, point)
    client.performCollisionDetection()
    assert not client.getContactPoints(ball)


@pytest.mark.parametrize("name", ["003_cracker_box", "024_bowl", "035_power_drill"])
def test_rebuild_gives_the_shipped_bytes(tmp_path: Path, name: str) -> None:
    pytest.importorskip("trimesh")
    from handover_marl.assets.building.objects import build_object

    rebuilt = build_object(name, tmp_path)
    shipped = OBJECTS_ROOT / name
    assert sorted(path.name for path in rebuilt.iterdir()) == sorted(path.name for path in shipped.iterdir())
    for path in rebuilt.iterdir():
        assert path.read_bytes() == (shipped / path.name).read_bytes(), path.name
