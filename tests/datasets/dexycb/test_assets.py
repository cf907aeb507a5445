"""Tests of the files in `assets/`: hands, objects, table, files of the third-party archive, and stand-ins for them."""

import contextlib
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pybullet_data
import pytest

from handover_marl.assets.shipped import find_object_urdf, load_object_grasps
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dexycb import assets
from handover_marl.datasets.dexycb.assets import (
    format_numbers,
    install_third_party,
    write_object_assets,
    write_stand_ins,
    write_table_assets,
)
from handover_marl.datasets.official import PANDA_FILES, is_stand_in_file, list_required_files, load_grasps
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError
from handover_marl.geometry.model_files.urdf import list_mesh_references
from handover_marl.geometry.ycb import CLASS_NAMES
from tests.execution.test_archives import tar
from tests.helpers.equality import read_files
from tests.helpers.fake_layout import FakeScene, write_layout


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((0.0, -1000.0, 3.0), "0 -1000 3"),
        ((1.0, 0.1), "1." + "0" * 64 + " 0.1000000000000000055511151231257827021181583404541015625000000000"),
        ((-0.0,), "-0"),
    ],
)
def test_format_numbers(values: tuple[float, ...], text: str) -> None:
    assert format_numbers(*values) == text


def test_object_urdfs_and_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_object_assets(tmp_path)
    files = list(tmp_path.rglob("*.urdf"))
    assert sorted(path.parent.name for path in files) == sorted(CLASS_NAMES.values())
    (text,) = {path.read_text() for path in files}
    robot = ET.fromstring(text)
    assert len(robot.findall("link")) == 7
    meshes = [mesh.get("filename") for mesh in robot.iter("mesh")]
    assert meshes == ["textured_simple.obj", "model_normalized_convex.obj"]
    write_table_assets(tmp_path)
    source = Path(pybullet_data.getDataPath()) / "table"
    for name in ("table.obj", "table.mtl", "table.png"):
        assert (tmp_path / "table" / name).read_bytes() == (source / name).read_bytes()
    robot = ET.parse(tmp_path / "table" / "table.urdf").getroot()
    assert [box.get("size") for box in robot.findall("link/collision/geometry/box")] == ["1.77 0.73 0.04"]
    legs = [str(origin.get("xyz")) for origin in robot.findall("link/visual/origin")][1:]
    assert legs == [f"{x} {y} 0.44" for x in (-0.785, 0.785) for y in (-0.265, 0.265)]
    # Another table is refused.
    (tmp_path / "table.urdf").write_text((source / "table.urdf").read_text().replace("1.5 1 0.05", "1.5 1 0.06", 1))
    monkeypatch.setattr(assets, "find_table_folder", lambda: tmp_path)
    with pytest.raises(DataFormatError, match=r"1\.5 1 0\.05 1 times instead of 2"):
        write_table_assets(tmp_path / "assets")


FILES = {
    "003_cracker_box/textured_simple.obj": b"v 0 0 0\n",
    "003_cracker_box/texture_map.png": b"png",
    "grasps/003_cracker_box.npy": b"grasps",
    "franka_panda/meshes/visual/link1.obj": b"v 1 1 1\n",
}


def test_files_are_installed(tmp_path: Path) -> None:
    entries = {"LICENSE": b"", "x/y/z.obj": b""}
    entries |= {f"./handover/data/assets/{path}": content for path, content in FILES.items()}
    (note,) = install_third_party(tar(tmp_path / "a.tar.gz", "w:gz", content=entries), tmp_path / "assets")
    assert f"1 of the {len(FILES)} " in note
    assert "grasps/003_cracker_box.npy" in note, "the one whose sum is known"
    assert read_files(tmp_path / "assets") == FILES
    # Links in a folder are ignored.
    (tmp_path / "assets" / "025_mug").mkdir()
    (tmp_path / "assets" / "025_mug" / "texture_map.png").symlink_to("/etc/passwd")
    install_third_party(tmp_path / "assets", tmp_path / "others")
    assert read_files(tmp_path / "others") == FILES


@pytest.mark.slow
def test_stand_ins_are_marked_and_replaced_by_originals(tmp_path: Path) -> None:
    """DexYCB's model of one object gives stand-ins, a damaged one a fault; a scene of them is marked in results."""
    models, assets = tmp_path / "models", tmp_path / "assets"
    for name in ("003_cracker_box", "025_mug"):
        (models / name).mkdir(parents=True)
    mesh = find_object_urdf("061_foam_brick").with_name("model_normalized_convex.obj")
    shutil.copy(mesh, models / "003_cracker_box" / "textured_simple.obj")
    (models / "025_mug" / "textured_simple.obj").write_text("no mesh")
    (fault,) = write_stand_ins(models, assets, workers=1, progress=False)
    assert "025_mug" in fault
    reported = [path for path in list_required_files() if is_stand_in_file(assets / path)]
    assert len(reported) == 1 + 19 + 2
    assert not is_stand_in_file(assets / "003_cracker_box/textured_simple.obj"), "that is DexYCB's own"
    np.testing.assert_array_equal(load_grasps(assets / "grasps/025_mug.npy"), load_object_grasps("025_mug"))
    for path in PANDA_FILES.values():
        meshes = list_mesh_references(assets / path)
        assert meshes
        assert all(mesh.is_file() for _, mesh in meshes)
    folder = write_layout(tmp_path / "data", (FakeScene(5),))
    for name in ("franka_panda", "grasps", "003_cracker_box"):
        shutil.rmtree(folder / "assets" / name)
    shutil.copytree(assets, folder / "assets", dirs_exist_ok=True)
    write_object_assets(folder / "assets")
    dataset = OfficialDataset(folder, "panda_camera")
    notes = "hand of unknown origin, stand-in convex parts, stand-in grasps, stand-in Panda"
    assert dataset.describe_models(5) == notes
    with contextlib.closing(Episode("exact")) as episode:
        episode.reset(dataset.load_scene(5))
    # Originals replace stand-ins, and stand-ins do not replace originals.
    install_third_party(tar(tmp_path / "a.tar", "w", content={"assets/grasps/025_mug.npy": b"original"}), assets)
    write_stand_ins(tmp_path, assets, workers=1, progress=False)
    assert (assets / "grasps/025_mug.npy").read_bytes() == b"original"
