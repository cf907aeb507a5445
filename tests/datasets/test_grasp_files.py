from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.official import load_grasps
from handover_marl.errors import DataFormatError, UnsafeFileError
from tests.fake_layout import evil_grasps, write_grasps


def test_reads_official_files(tmp_path: Path) -> None:
    write_grasps(tmp_path / "g.npy", n=7)
    grasps = load_grasps(tmp_path / "g.npy")
    assert grasps.shape == (7, 4, 4)
    assert grasps.dtype == np.float64
    np.testing.assert_array_equal(grasps[:, 1, 3], np.float64(np.float32(-0.1)))


def test_reads_python_2_pickles(tmp_path: Path) -> None:
    dtype = b"cnumpy\ndtype\n(U\x02f4K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
    state = b"(K\x01(K\x01K\x04K\x04t" + dtype + b"\x89U\x40" + np.eye(4, dtype="<f4").tobytes() + b"tb"
    with (tmp_path / "g.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
        stream.write(b"\x80\x02}(U\x0atransforms" + array + state + b"u.")
    np.testing.assert_array_equal(load_grasps(tmp_path / "g.npy"), np.eye(4)[None])


def test_foreign_code_is_refused_and_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "was_run"
    evil_grasps(tmp_path / "g.npy", marker)
    with pytest.raises(UnsafeFileError, match=r"g\.npy.*foreign code"):
        load_grasps(tmp_path / "g.npy")
    assert not marker.exists()


@pytest.mark.parametrize("length", [0, 60, 200])
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
        [1, 2, 3],
    ],
)
def test_wrong_content(tmp_path: Path, content: object) -> None:
    np.save(tmp_path / "g.npy", np.array(content, dtype=object), allow_pickle=True)
    with pytest.raises(DataFormatError, match=r"g\.npy"):
        load_grasps(tmp_path / "g.npy")
