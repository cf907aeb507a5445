"""Tests of grasp files of HandoverSim, and of the restricted unpickling that they and MANO's files need."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.official import load_grasps
from handover_marl.datasets.restricted_pickle import load_restricted
from handover_marl.errors import DataFormatError, HandoverError, UnsafeFileError
from tests.helpers.fake_layout import write_grasps


def test_reads_official_files(tmp_path: Path) -> None:
    write_grasps(tmp_path / "g.npy", n=7)
    grasps = load_grasps(tmp_path / "g.npy")
    assert (grasps.shape, grasps.dtype) == ((7, 4, 4), np.float64)
    np.testing.assert_array_equal(grasps[:, 1, 3], np.float64(np.float32(-0.1)))


def write_pickle(path: Path, content: bytes) -> None:
    """Write a file of NumPy with a pickled object."""
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
        stream.write(content)


def test_reads_python_2_pickles(tmp_path: Path) -> None:
    dtype = b"cnumpy\ndtype\n(U\x02f4K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
    state = b"(K\x01(K\x01K\x04K\x04t" + dtype + b"\x89U\x40" + np.eye(4, dtype="<f4").tobytes() + b"tb"
    write_pickle(tmp_path / "g.npy", b"\x80\x02}(U\x0atransforms" + array + state + b"u.")
    np.testing.assert_array_equal(load_grasps(tmp_path / "g.npy"), np.eye(4)[None])


@pytest.mark.parametrize(
    "content",
    [0, 200, [1], {"other": np.eye(4)[None]}]
    + [{"transforms": array} for array in (np.eye(3)[None], np.full((2, 4, 4), np.nan))]
    + [{"transforms": np.diag(scales)[None]} for scales in ([2.0, 2, 2, 1], [-1.0, 1, 1, 1])]
    + [{"transforms": np.eye(4)[None] + offset} for offset in (500.0 * np.eye(4, k=3), 0.5 * np.eye(4, k=-3))],
)
def test_damaged_files(tmp_path: Path, content: object) -> None:
    path = tmp_path / "g.npy"
    if isinstance(content, int):
        write_grasps(path)
        path.write_bytes(path.read_bytes()[:content])
    else:
        np.save(path, np.array(content, dtype=object), allow_pickle=True)
    with pytest.raises(DataFormatError, match=r"g\.npy.*copy it again"):
        load_grasps(path)


ARRAYS = {
    "float32": np.arange(32, dtype=np.float32).reshape(2, 4, 4),
    "big endian": np.arange(6, dtype=">f8"),
    "Fortran order": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "permuted axes": np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    "scalar": np.array(3.5),
    "empty": np.zeros((0, 4, 4)),
}


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_unpickles_what_numpy_writes(protocol: int) -> None:
    found = load_restricted(pickle.dumps(ARRAYS, protocol=protocol))
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
        np.testing.assert_array_equal(found[name], array)


UNSAFE = {
    "os.system": b"cos\nsystem\n(S'touch was_run'\ntR.",
    "eval of Python 2": b"c__builtin__\neval\n(S\"open('was_run', 'w')\"\ntR.",
    "getattr": b"cbuiltins\ngetattr\n(cnumpy\nndarray\nS'__subclasses__'\ntR.",
    "an attribute of an allowed class": b"\x80\x04\x8c\x05numpy\x8c\x0fdtype.__class__\x93.",
    "a class by its name on the stack": b"\x80\x04\x8c\nsubprocess\x8c\x05Popen\x93(\x8c\rtouch was_runt\x81.",
    "an instance of Python 2": b"(S'touch was_run'\nios\nsystem\n.",
    "a chain of reductions": b"ccopyreg\n_reconstructor\n(cnumpy\nndarray\ncbuiltins\nobject\nNtR.",
}
DAMAGED = {
    "nothing": b"",
    "an extension": b"\x82\x01.",
    "attributes of an allowed function": b"cnumpy._core.multiarray\n_reconstruct\n(N}U\x0c__defaults__K\x01stb.",
    "a truncated array": pickle.dumps(ARRAYS)[:-20],
}


@pytest.mark.parametrize("what", [*UNSAFE, *DAMAGED])
def test_other_pickles_are_refused_and_run_nothing(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    error, message = (UnsafeFileError, "^asks for ") if what in UNSAFE else (Exception, None)
    with pytest.raises(error, match=message):
        load_restricted({**UNSAFE, **DAMAGED}[what])
    write_pickle(tmp_path / "g.npy", {**UNSAFE, **DAMAGED}[what])
    with pytest.raises(UnsafeFileError if what in UNSAFE else HandoverError, match=r"g\.npy"):
        load_grasps(tmp_path / "g.npy")
    assert [path.name for path in tmp_path.iterdir()] == ["g.npy"]
    # The functions that pickles may use are as before.
    test_unpickles_what_numpy_writes(2)
