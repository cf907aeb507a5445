import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.importing.cache_writer import CachedScene, write_scene
from handover_marl.errors import DataFormatError, ResultsError

META = {
    "name": "20200709-subject-01/20200709_141754",
    "ycb_ids": [2, 5],
    "ycb_grasp_ind": 1,
    "mano_sides": ["right"],
    "mano_betas": [[0.1] * 10],
}


def scene(number: int = 7) -> CachedScene:
    # Neither is in C order.
    pose_y = np.asfortranarray(np.arange(5 * 2 * 6, dtype=np.float32).reshape(5, 2, 6))
    pose_m = np.zeros((5, 1, 102), dtype=np.float32)[:, :, ::2]
    return CachedScene(number, META, pose_y, pose_m)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_files_of_a_scene(tmp_path: Path) -> None:
    write_scene(scene(), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["meta_007.json", "pose_007.npz"]
    text = (tmp_path / "meta_007.json").read_text()
    assert text == json.dumps(META)
    assert text.startswith('{"name": "20200709-subject-01/20200709_141754", "ycb_ids": [2, 5], "ycb_grasp_ind": 1, ')
    with np.load(tmp_path / "pose_007.npz", allow_pickle=False) as archive:
        assert archive.files == ["pose_y", "pose_m"]
        for name in archive.files:
            assert archive[name].flags.c_contiguous
            np.testing.assert_array_equal(archive[name], getattr(scene(), name))
    assert b"'fortran_order': False" in _unpacked(tmp_path / "pose_007.npz")


def _unpacked(path: Path) -> bytes:
    with zipfile.ZipFile(path) as archive:
        assert {part.compress_type for part in archive.infolist()} == {zipfile.ZIP_DEFLATED}
        return archive.read("pose_y.npy")[:128]


def test_equal_files_stay_as_they_are(tmp_path: Path) -> None:
    write_scene(scene(), tmp_path)
    # Another program's archive of the same arrays.
    with (tmp_path / "pose_007.npz").open("wb") as stream:
        np.savez(stream, pose_m=scene().pose_m, pose_y=scene().pose_y)
    before = contents(tmp_path)
    write_scene(scene(), tmp_path)
    assert contents(tmp_path) == before


def test_a_scene_half_there_is_completed(tmp_path: Path) -> None:
    write_scene(scene(), tmp_path)
    before = contents(tmp_path)
    for name in before:
        (tmp_path / name).unlink()
        write_scene(scene(), tmp_path)
        assert sorted(contents(tmp_path)) == sorted(before)


@pytest.mark.parametrize("change", [np.float32(1e-45), np.float32(-0.0)])
def test_other_motion_is_not_overwritten(tmp_path: Path, change: np.float32) -> None:
    write_scene(scene(), tmp_path)
    other = scene()
    other.pose_m[4, 0, 3] = change
    before = contents(tmp_path)
    with pytest.raises(DataFormatError, match=r"pose_007\.npz is there already, but is not.*remove it"):
        write_scene(other, tmp_path)
    assert contents(tmp_path) == before


def test_other_meta_is_not_overwritten(tmp_path: Path) -> None:
    write_scene(scene(), tmp_path)
    (tmp_path / "meta_007.json").write_text(json.dumps(META) + "\n")
    with pytest.raises(DataFormatError, match=r"meta_007\.json is there already"):
        write_scene(scene(), tmp_path)


@pytest.mark.parametrize("name", ["meta_007.json", "pose_007.npz"])
def test_what_is_no_such_file_stays(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(DataFormatError, match=f"{name} is there already"):
        write_scene(scene(), tmp_path)
    (tmp_path / name).rmdir()
    (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(DataFormatError, match=f"{name} is there already"):
        write_scene(scene(), tmp_path)


@pytest.mark.parametrize(
    "arrays", [{"pose_y": scene().pose_y}, {"pose_y": scene().pose_y[:4], "pose_m": scene().pose_m}]
)
def test_other_arrays(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    np.savez(tmp_path / "pose_007.npz", **arrays)
    with pytest.raises(DataFormatError, match=r"pose_007\.npz is there already"):
        write_scene(scene(), tmp_path)


def test_a_folder_that_is_gone(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    shutil.rmtree(tmp_path / "cache")
    with pytest.raises(ResultsError, match="cannot write"):
        write_scene(scene(), tmp_path / "cache")
