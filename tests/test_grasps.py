import pickle
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.grasps import load_grasps
from handover_marl.errors import DataFormatError, UnsafeFileError
from tests.fake_layout import evil_grasps, write_grasps


def save(path: Path, content: object) -> Path:
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    return path


def test_reads_official_files(tmp_path: Path) -> None:
    write_grasps(tmp_path / "g.npy", n=7)
    grasps = load_grasps(tmp_path / "g.npy")
    assert grasps.shape == (7, 4, 4)
    assert grasps.dtype == np.float64
    np.testing.assert_array_equal(grasps[:, 1, 3], np.float64(np.float32(-0.1)))


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_reads_every_pickle_protocol(tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "g.npy"
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
        pickle.dump({"transforms": np.eye(4)[None]}, stream, protocol=protocol)
    np.testing.assert_array_equal(load_grasps(path), np.eye(4)[None])


def test_foreign_code_is_refused_and_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "was_run"
    evil_grasps(tmp_path / "g.npy", marker)
    with pytest.raises(UnsafeFileError, match=r"g\.npy.*foreign code"):
        load_grasps(tmp_path / "g.npy")
    assert not marker.exists()


@pytest.mark.parametrize("builtin", ["eval", "getattr", "__import__"])
def test_builtins_are_refused(tmp_path: Path, builtin: str) -> None:
    path = tmp_path / "g.npy"
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
        stream.write(f"cbuiltins\n{builtin}\n(S'1+1'\ntR.".encode())
    with pytest.raises(UnsafeFileError, match=builtin):
        load_grasps(path)


@pytest.mark.parametrize("length", [0, 5, 60, 200])
def test_truncated_files(tmp_path: Path, length: int) -> None:
    path = tmp_path / "g.npy"
    write_grasps(path)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(DataFormatError, match=r"g\.npy.*Copy it again"):
        load_grasps(path)


@pytest.mark.parametrize(
    "content",
    [
        {"other": np.eye(4)[None]},
        {"transforms": np.eye(3)[None]},
        {"transforms": np.full((2, 4, 4), np.nan)},
        {"transforms": "text"},
        {"transforms": [1, "x"]},
        [1, 2, 3],
    ],
)
def test_wrong_content(tmp_path: Path, content: object) -> None:
    with pytest.raises(DataFormatError, match=r"g\.npy"):
        load_grasps(save(tmp_path / "g.npy", content))


def test_plain_arrays_are_no_grasp_files(tmp_path: Path) -> None:
    np.save(tmp_path / "g.npy", np.eye(4)[None])
    with pytest.raises(DataFormatError, match="pickled dict"):
        load_grasps(tmp_path / "g.npy")
