"""Tests of the installation of files from the third-party archive, and of stand-ins for them."""

import contextlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.shipped import find_object_urdf, load_object_grasps
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dexycb.assets import write_object_assets
from handover_marl.datasets.dexycb.stand_ins import install_third_party, write_stand_ins
from handover_marl.datasets.official import load_grasps
from handover_marl.datasets.official_files import (
    PANDA_FILES,
    is_stand_in_file,
    list_required_files,
)
from handover_marl.episode.episode import Episode
from handover_marl.geometry.model_files.urdf import list_mesh_references
from tests.datasets.dexycb.raw_files import all_files
from tests.execution.test_archives import tar
from tests.fake_layout import FakeScene, write_layout

FILES = {
    "003_cracker_box/textured_simple.obj": b"v 0 0 0\n",
    "003_cracker_box/texture_map.png": b"png",
    "grasps/003_cracker_box.npy": b"grasps",
    "franka_panda/meshes/visual/link1.obj": b"v 1 1 1\n",
}


def test_files_are_installed(tmp_path: Path) -> None:
    entries = {f"./handover/data/assets/{path}": content for path, content in FILES.items()} | {
        "LICENSE": b"",
        "x/y/z.obj": b"",
    }
    (note,) = install_third_party(tar(tmp_path / "a.tar.gz", "w:gz", entries), tmp_path / "assets")
    assert f"1 of the {len(FILES)} " in note
    assert "grasps/003_cracker_box.npy" in note, "the one whose sum is known"
    assert all_files(tmp_path / "assets") == FILES


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
    install_third_party(tar(tmp_path / "a.tar", "w", {"assets/grasps/025_mug.npy": b"original"}), assets)
    write_stand_ins(tmp_path, assets, workers=1, progress=False)
    assert (assets / "grasps/025_mug.npy").read_bytes() == b"original"
