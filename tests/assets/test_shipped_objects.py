from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.shipped import COLLISION_NAME, OBJECTS_ROOT, VISUAL_NAME, find_object_urdf
from handover_marl.geometry.model_files.obj_files import read_obj
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.bullet.client import connect

#: Lowest and highest corner (m) of the scanned object's bounding box in its frame, by YCB class
#: name; measured on the YCB-Video models (Calli et al., 2015; Xiang et al., 2018).
YCB_BOUNDS = {
    "002_master_chef_can": ((-0.0525, -0.0508, -0.0737), (0.0499, 0.0519, 0.0665)),
    "003_cracker_box": ((-0.0364, -0.0836, -0.1116), (0.0352, 0.0803, 0.1019)),
    "004_sugar_box": ((-0.0239, -0.0484, -0.0924), (0.0256, 0.0456, 0.0836)),
    "005_tomato_soup_can": ((-0.0341, -0.0323, -0.0593), (0.0336, 0.0354, 0.0426)),
    "006_mustard_bottle": ((-0.0499, -0.0357, -0.0839), (0.0473, 0.0308, 0.1075)),
    "007_tuna_fish_can": ((-0.0428, -0.0429, -0.0208), (0.0428, 0.0424, 0.0127)),
    "008_pudding_box": ((-0.0703, -0.0604, -0.0224), (0.0676, 0.0682, 0.0163)),
    "009_gelatin_box": ((-0.0461, -0.0500, -0.0186), (0.0432, 0.0510, 0.0115)),
    "010_potted_meat_can": ((-0.0534, -0.0308, -0.0498), (0.0488, 0.0293, 0.0338)),
    "011_banana": ((-0.0358, -0.1014, -0.0169), (0.0732, 0.0769, 0.0198)),
    "019_pitcher_base": ((-0.0797, -0.0787, -0.1471), (0.0692, 0.0662, 0.0956)),
    "021_bleach_cleanser": ((-0.0562, -0.0314, -0.1120), (0.0461, 0.0363, 0.1385)),
    "024_bowl": ((-0.0803, -0.0815, -0.0245), (0.0808, 0.0795, 0.0306)),
    "025_mug": ((-0.0503, -0.0457, -0.0391), (0.0669, 0.0472, 0.0424)),
    "035_power_drill": ((-0.1010, -0.1146, -0.0265), (0.0833, 0.0726, 0.0308)),
    "036_wood_block": ((-0.0534, -0.0492, -0.1200), (0.0506, 0.0543, 0.0858)),
    "037_scissors": ((-0.0551, -0.0726, -0.0078), (0.0410, 0.1289, 0.0079)),
    "040_large_marker": ((-0.0105, -0.0583, -0.0098), (0.0105, 0.0625, 0.0092)),
    "051_large_clamp": ((-0.0705, -0.0834, -0.0191), (0.0497, 0.0875, 0.0199)),
    "052_extra_large_clamp": ((-0.1044, -0.0717, -0.0185), (0.1052, 0.0925, 0.0179)),
    "061_foam_brick": ((-0.0261, -0.0389, -0.0172), (0.0266, 0.0388, 0.0339)),
}
NAMES = tuple(CLASS_NAMES.values())


@pytest.mark.parametrize("name", NAMES)
def test_urdf_has_the_official_structure_and_the_size_of_the_scan(name: str) -> None:
    client = connect()
    body = client.loadURDF(str(find_object_urdf(name)), useFixedBase=True)
    infos = [client.getJointInfo(body, joint) for joint in range(client.getNumJoints(body))]
    assert [info[2] for info in infos] == [client.JOINT_PRISMATIC] * 3 + [client.JOINT_REVOLUTE] * 3
    assert [info[12].decode() for info in infos] == [f"link{number}" for number in range(1, 7)]
    assert [info[13] for info in infos] == [tuple(axis) for axis in np.eye(3).tolist() * 2]
    assert client.getDynamicsInfo(body, 5)[:2] == (0.5, 0.9)
    assert [len(client.getCollisionShapeData(body, link)) for link in range(-1, 5)] == [0] * 6
    assert len(client.getVisualShapeData(body)) == 1
    for file in (VISUAL_NAME, COLLISION_NAME):
        vertices = read_obj(OBJECTS_ROOT / name / file).vertices
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        np.testing.assert_allclose(bounds, YCB_BOUNDS[name], rtol=0, atol=0.003)


@pytest.mark.parametrize(
    ("name", "point"),
    [
        ("024_bowl", (0.0, 0.0, 0.02)),
        ("025_mug", (0.047, 0.0, 0.0)),  # between wall and handle
        ("037_scissors", (0.012, -0.036, 0.0)),  # inside a loop
        ("052_extra_large_clamp", (-0.04, -0.004, 0.0)),  # between the jaws
        ("019_pitcher_base", (0.045, 0.045, 0.02)),  # between body and handle
    ],
)
def test_openings_are_open(name: str, point: tuple[float, float, float]) -> None:
    client = connect()
    client.loadURDF(str(find_object_urdf(name)), useFixedBase=True)
    ball = client.createMultiBody(0, client.createCollisionShape(client.GEOM_SPHERE, radius=0.004), -1, point)
    client.performCollisionDetection()
    assert not client.getContactPoints(ball)


@pytest.mark.parametrize("name", ["024_bowl", "035_power_drill"])
def test_rebuild_gives_the_shipped_bytes(tmp_path: Path, name: str) -> None:
    pytest.importorskip("trimesh")
    from handover_marl.assets.building.objects import build_object

    rebuilt = build_object(name, tmp_path)
    shipped = OBJECTS_ROOT / name
    assert sorted(path.name for path in rebuilt.iterdir()) == sorted(path.name for path in shipped.iterdir())
    for path in rebuilt.iterdir():
        assert path.read_bytes() == (shipped / path.name).read_bytes(), path.name
