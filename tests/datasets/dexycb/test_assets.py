import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pybullet_data
import pytest

from handover_marl.datasets.dexycb import assets
from handover_marl.datasets.dexycb.assets import (
    build_hand_urdf,
    format_numbers,
    write_hand_assets,
    write_object_assets,
    write_table_assets,
)
from handover_marl.errors import DataFormatError
from handover_marl.geometry.model_files.obj_files import read_obj
from handover_marl.geometry.ycb import CLASS_NAMES
from tests.datasets.dexycb.mano_files import made_up_hand, made_up_model

SUBJECT = "20200709-subject-01"
BETAS = np.linspace(-1.0, 1.0, 10)


def numbers(text: str | None) -> list[float]:
    assert text is not None
    return [float(word) for word in text.split()]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((0.0, -1000.0, 3.0), "0 -1000 3"),
        ((0.5,), "0.5" + "0" * 63),
        ((1.0, 0.1), "1." + "0" * 64 + " 0.1000000000000000055511151231257827021181583404541015625000000000"),
        ((-0.0,), "-0"),
    ],
)
def test_format_numbers(values: tuple[float, ...], text: str) -> None:
    assert format_numbers(*values) == text


def test_links_and_joints_of_the_hand() -> None:
    rng = np.random.default_rng(0)
    joints = rng.uniform(-0.1, 0.1, (16, 3))
    robot = ET.fromstring(build_hand_urdf(joints))
    links, found = robot.findall("link"), robot.findall("joint")
    assert [link.get("name") for link in links] == [f"link{number}" for number in range(53)]
    assert [joint.get("name") for joint in found] == [f"joint{number}" for number in range(1, 53)]
    kinds = ["prismatic"] * 3 + ["continuous"] * 3 + ["fixed"] + ["revolute"] * 45
    assert [joint.get("type") for joint in found] == kinds

    place = {"link0": np.zeros(3)}
    for joint in found:
        parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
        assert parent is not None and child is not None and origin is not None  # noqa: PT018
        place[str(child.get("link"))] = place[str(parent.get("link"))] + numbers(origin.get("xyz"))
    bodies = [link for link in links if link.find("visual") is not None]
    assert [link.get("name") for link in bodies] == [f"link{7 + 3 * joint}" for joint in range(16)]
    for joint_number, body in enumerate(bodies):
        np.testing.assert_allclose(place[str(body.get("name"))], joints[joint_number], atol=1e-15)
        meshes = [str(mesh.get("filename")) for mesh in body.iter("mesh")]
        assert meshes == [f"meshes/{kind}/mesh{joint_number + 1}.obj" for kind in ("visual", "collision")]
    masses = [numbers(mass.get("value"))[0] for mass in robot.iter("mass")]
    assert [mass for mass in masses if mass] == [0.2] + [0.02] * 15


def test_meshes_of_a_hand(tmp_path: Path) -> None:
    weights = made_up_hand()["weights"] * 0.5
    for joint in (4, 7, 10):
        mine = np.flatnonzero(weights[:, joint])
        weights[mine[:10], joint] = 0.71
    model = dataclasses.replace(made_up_model(), weights=weights)
    folder = write_hand_assets(tmp_path, SUBJECT, model, BETAS)
    assert folder == tmp_path / f"{SUBJECT}_right"
    vertices = model.shape_vertices(BETAS)
    joints = model.regress_joints(vertices)
    for joint in range(16):
        seen = read_obj(folder / f"meshes/visual/mesh{joint + 1}.obj")
        touched = read_obj(folder / f"meshes/collision/mesh{joint + 1}.obj")
        expected = vertices[weights[:, joint] > 0.2] - joints[joint]
        np.testing.assert_allclose(seen.vertices, expected, atol=1e-6)
        if joint in (4, 7, 10):
            np.testing.assert_array_equal(touched.vertices, seen.vertices[:10])
        else:
            np.testing.assert_array_equal(touched.vertices, seen.vertices)
        kept = np.flatnonzero(weights[:, joint] > 0.2)
        wanted = [face for face in model.faces.tolist() if set(face) <= set(kept.tolist())]
        np.testing.assert_array_equal(kept[seen.faces], wanted)


def test_object_urdfs(tmp_path: Path) -> None:
    write_object_assets(tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(path.parent.name for path in files) == sorted(CLASS_NAMES.values())
    (text,) = {path.read_text() for path in files}
    robot = ET.fromstring(text)
    assert len(robot.findall("link")) == 7
    meshes = [mesh.get("filename") for mesh in robot.iter("mesh")]
    assert meshes == ["textured_simple.obj", "model_normalized_convex.obj"]


def test_table_files(tmp_path: Path) -> None:
    write_table_assets(tmp_path)
    source = Path(pybullet_data.getDataPath()) / "table"
    for name in ("table.obj", "table.mtl", "table.png"):
        path = tmp_path / "table" / name
        assert not path.is_symlink()
        assert path.read_bytes() == (source / name).read_bytes()
    robot = ET.parse(tmp_path / "table" / "table.urdf").getroot()
    top = robot.find("link/collision/geometry/box")
    assert top is not None
    assert top.get("size") == "1.77 0.73 0.04"
    legs = [str(origin.get("xyz")) for origin in robot.findall("link/visual/origin")][1:]
    assert [numbers(leg) for leg in legs] == [[x, y, 0.44] for x in (-0.785, 0.785) for y in (-0.265, 0.265)]


def test_changed_table_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = (Path(pybullet_data.getDataPath()) / "table" / "table.urdf").read_text()
    (tmp_path / "table.urdf").write_text(original.replace("1.5 1 0.05", "1.5 1 0.06", 1))
    monkeypatch.setattr(assets, "find_table_folder", lambda: tmp_path)
    with pytest.raises(DataFormatError, match=r"1\.5 1 0\.05 1 times instead of 2"):
        write_table_assets(tmp_path / "assets")
