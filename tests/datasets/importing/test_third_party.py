"""The third-party archive's files: where they go, and what stands in for them."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.assets.object_models import object_urdf
from handover_marl.assets.shipped_grasps import load_object_grasps
from handover_marl.datasets import OfficialDataset, official_files
from handover_marl.datasets.importing.object_assets import write_object_assets
from handover_marl.datasets.importing.stand_ins import convex_parts, write_stand_ins
from handover_marl.datasets.importing.third_party import place_third_party
from handover_marl.datasets.official_files import (
    PANDA_FILES,
    Origin,
    file_origin,
    needed_files,
    stands_in,
    third_party_sums,
)
from handover_marl.datasets.pickled_grasps import load_grasps
from handover_marl.episode.episode import Episode
from handover_marl.errors import DataFormatError, ResultsError, UnsafeFileError
from handover_marl.models.obj_files import read_obj
from handover_marl.models.urdf_shapes import named_meshes
from tests.datasets.importing.test_archives import link, tar
from tests.fake_layout import FakeScene, write_layout
from tests.playing import play

FILES = {
    "003_cracker_box/textured_simple.obj": b"v 0 0 0\n",
    "003_cracker_box/texture_map.png": b"png",
    "grasps/003_cracker_box.npy": b"grasps",
    "franka_panda/meshes/visual/link1.obj": b"v 1 1 1\n",
}


def test_the_list_names_what_scenes_need() -> None:
    needed = needed_files()
    assert len([path for path in needed if path.endswith("model_normalized_convex.obj")]) == 21
    assert len([path for path in needed if path.startswith("grasps/")]) == 19
    assert set(PANDA_FILES.values()) <= set(needed)
    assert not [path for path in needed if path.endswith((".png", ".mtl"))]
    sums = [known for known in third_party_sums().values() if known]
    assert all(len(known) == 64 and int(known, 16) >= 0 for known in sums)


@pytest.mark.parametrize("root", ["", "assets/", "./handover/data/assets/"])
def test_files_go_where_they_belong(root: str, tmp_path: Path) -> None:
    entries = {f"{root}{path}": content for path, content in FILES.items()} | {"LICENSE": b"", "x/y/z.obj": b""}
    placed = place_third_party(tar(tmp_path / "a.tar.gz", "w:gz", entries), tmp_path / "assets")
    assert set(placed.files) == set(FILES)
    assert placed.different == ("grasps/003_cracker_box.npy",), "the one whose sum is known"
    found = {str(path.relative_to(tmp_path / "assets")): path.read_bytes() for path in walk(tmp_path / "assets")}
    assert found == FILES


def walk(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_nothing_is_written_before_all_was_looked_at(tmp_path: Path) -> None:
    entries = {f"assets/{path}": content for path, content in FILES.items()}
    bad = tar(tmp_path / "a.tar.gz", "w:gz", entries, link("assets/zzz", b"2", "/etc/passwd"))
    with pytest.raises(UnsafeFileError):
        place_third_party(bad, tmp_path / "assets")
    assert not (tmp_path / "assets").exists()
    assert not (tmp_path / "zzz").is_symlink()


def test_what_is_there_stays(tmp_path: Path) -> None:
    place_third_party(tar(tmp_path / "a.tar", "w", FILES), tmp_path / "assets")
    place_third_party(tar(tmp_path / "a.tar", "w", FILES), tmp_path / "assets")
    (tmp_path / "assets/003_cracker_box/textured_simple.obj").write_bytes(b"mine")
    with pytest.raises(ResultsError, match="other content"):
        place_third_party(tar(tmp_path / "a.tar", "w", FILES), tmp_path / "assets")
    assert (tmp_path / "assets/003_cracker_box/textured_simple.obj").read_bytes() == b"mine"


def test_archives_that_leave_it_open_which_file_is_meant(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match="none of the files"):
        place_third_party(tar(tmp_path / "a.tar", "w", {"README": b""}), tmp_path / "assets")
    both = {f"old/{path}": b"old" for path in FILES} | {f"new/{path}": b"new" for path in FILES}
    with pytest.raises(DataFormatError, match="'old' and in 'new'"):
        place_third_party(tar(tmp_path / "a.tar", "w", both), tmp_path / "assets")
    assert not (tmp_path / "assets").exists()


def test_origins_are_told_from_content(monkeypatch: pytest.MonkeyPatch) -> None:
    path = "grasps/003_cracker_box.npy"
    known = {path: hashlib.sha256(b"the original").hexdigest()}
    monkeypatch.setattr(official_files, "third_party_sums", lambda: known)
    assert file_origin(path, b"the original") is Origin.ORIGINAL
    assert file_origin(path, b"another") is Origin.UNKNOWN
    assert file_origin(path, f"# {official_files.STAND_IN}".encode()) is Origin.STAND_IN
    assert file_origin("foreign", b"the original") is Origin.UNKNOWN


@pytest.fixture(scope="module")
def stood_in(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`assets/` with what stands in where DexYCB has models of two objects."""
    folder = tmp_path_factory.mktemp("stood_in")
    for name in ("003_cracker_box", "061_foam_brick"):
        (folder / "models" / name).mkdir(parents=True)
        shutil.copy(
            object_urdf(name).parent / "model_normalized_convex.obj", folder / "models" / name / "textured_simple.obj"
        )
    (folder / "models" / "025_mug").mkdir()
    (folder / "models" / "025_mug" / "textured_simple.obj").write_text("no mesh")
    faults = write_stand_ins(folder / "models", folder / "assets", workers=1, progress=False)
    assert len(faults) == 1
    assert "025_mug" in faults[0]
    return folder / "assets"


def test_convex_parts_fill_the_model(stood_in: Path) -> None:
    parts = read_obj(stood_in / "003_cracker_box/model_normalized_convex.obj")
    whole = read_obj(stood_in / "003_cracker_box/textured_simple.obj")
    assert np.abs(parts.vertices.min(axis=0) - whole.vertices.min(axis=0)).max() < 0.005
    assert np.abs(parts.vertices.max(axis=0) - whole.vertices.max(axis=0)).max() < 0.005
    assert all(len(np.unique(group)) <= 64 for group in parts.groups)
    assert (
        convex_parts(stood_in / "003_cracker_box/textured_simple.obj")
        == (stood_in / "003_cracker_box/model_normalized_convex.obj").read_text()
    ), "the same again"


def test_stand_ins_say_so(stood_in: Path) -> None:
    told = [path for path in needed_files() if stands_in(stood_in / path)]
    assert len(told) == 2 + 19 + 2
    assert not stands_in(stood_in / "003_cracker_box/textured_simple.obj"), "that is DexYCB's own"
    grasps = load_grasps(stood_in / "grasps/025_mug.npy")
    np.testing.assert_array_equal(grasps, load_object_grasps("025_mug"))
    for path in PANDA_FILES.values():
        meshes = named_meshes(stood_in / path)
        assert meshes
        assert all(mesh.is_file() for _, mesh in meshes)


def test_the_original_takes_the_place_of_a_stand_in(stood_in: Path, tmp_path: Path) -> None:
    assets = tmp_path / "assets"
    shutil.copytree(stood_in, assets)
    place_third_party(tar(tmp_path / "a.tar", "w", {"assets/grasps/025_mug.npy": b"original"}), assets)
    assert (assets / "grasps/025_mug.npy").read_bytes() == b"original"
    # And the other way round nothing happens.
    write_stand_ins(tmp_path, assets, workers=1, progress=False)
    assert (assets / "grasps/025_mug.npy").read_bytes() == b"original"


@pytest.mark.parametrize("robot", ["panda", "panda_camera"])
def test_a_scene_of_stand_ins_is_played_and_says_so(stood_in: Path, tmp_path: Path, robot: str) -> None:
    folder = write_layout(tmp_path / "data", (FakeScene(5),))
    for name in ("franka_panda", "grasps", "003_cracker_box"):
        shutil.rmtree(folder / "assets" / name)
    shutil.copytree(stood_in, folder / "assets", dirs_exist_ok=True)
    write_object_assets(folder / "assets")
    dataset = OfficialDataset(folder, robot)
    scene = dataset.scene(5)
    assert (
        dataset.models_in_words(5) == "hand of unknown origin, stand-in convex parts, stand-in grasps, stand-in Panda"
    )
    receiver = receivers.make("yang2021", dataset)
    episode = Episode("exact")
    play(episode, scene, receiver)
    assert episode.steps > 3000
    episode.close()
