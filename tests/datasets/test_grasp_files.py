import pickle
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.datasets.grasp_files import load_grasps, load_pickled_dict
from handover_marl.errors import DataFormatError, UnsafeFileError
from tests.fake_layout import evil_grasps, spoil, write_grasps


def save(path: Path, content: object) -> Path:
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    return path


def test_reads_official_files(tmp_path: Path) -> None:
    write_grasps(tmp_path / "g.npy", n=7)
    grasps = load_grasps(tmp_path / "g.npy")
    assert grasps.shape == (7, 4, 4)
    assert grasps.dtype == np.float64
    np.testing.assert_array_equal(grasps[:, 1, 3], np.float64(np.float32(-0.1)))


def with_header(path: Path, pickled: bytes) -> Path:
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
        stream.write(pickled)
    return path


ARRAYS = {
    "float32": np.arange(32, dtype=np.float32).reshape(2, 4, 4),
    "float16": np.arange(3, dtype=np.float16),
    "big endian": np.arange(6, dtype=">f8"),
    "big endian int": np.arange(6, dtype=">i2"),
    "unsigned": np.arange(6, dtype=np.uint8),
    "bool": np.array([True, False]),
    "text": np.array(["grasp", "ä"]),
    "bytes": np.array([b"abc", b"d"]),
    "Fortran order": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "permuted axes": np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    "strided": np.arange(10)[::3],
    "scalar": np.array(3.5),
    "empty": np.zeros((0, 4, 4)),
    "objects": np.array([[1, "a"], [None, b"b"]], dtype=object),
    "objects, Fortran order": np.asfortranarray(np.array([[1, "a"], [None, b"b"]], dtype=object)),
}


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("boxed", [True, False])
def test_reads_what_numpy_writes(tmp_path: Path, protocol: int, boxed: bool) -> None:
    content: Any = {b"transforms": np.eye(4)[None], **ARRAYS}
    pickled = pickle.dumps(np.array(content, dtype=object) if boxed else content, protocol=protocol)
    path = with_header(tmp_path / "g.npy", pickled)
    np.testing.assert_array_equal(load_grasps(path), np.eye(4)[None])
    loaded = load_pickled_dict(path)
    assert list(loaded) == list(map(str, ["transforms", *ARRAYS]))
    for name, array in ARRAYS.items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array)


def test_reads_python_2_pickles(tmp_path: Path) -> None:
    dtype = b"cnumpy\ndtype\n(U\x02f4K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
    state = b"(K\x01(K\x01K\x04K\x04t" + dtype + b"\x89U\x40" + np.eye(4, dtype="<f4").tobytes() + b"tb"
    path = with_header(tmp_path / "g.npy", b"\x80\x02}(U\x0atransforms" + array + state + b"u.")
    np.testing.assert_array_equal(load_grasps(path), np.eye(4)[None])


class Calls:
    """Object that is pickled as the call of a function, with an optional state."""

    def __init__(self, call: Callable[..., Any], arguments: tuple[Any, ...], state: Any = None) -> None:
        self.reduced = (call, arguments) if state is None else (call, arguments, state)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


def array(dtype: Any, data: Any, shape: Any = (1,)) -> Calls:
    reconstruct = np.zeros(1).__reduce__()[0]
    return Calls(reconstruct, (np.ndarray, (0,), b"b"), (1, shape, dtype, False, data))


def dtype(name: str, *state: Any) -> Calls:
    return Calls(np.dtype, (name, False, True), (3, *state))


POINTERS = b"A" * 8
PLAIN = ("<", None, None, None, -1, -1, 0)
HOSTILE = {
    "array of pointers": Calls(np.ndarray, ((1,), np.dtype("O"), POINTERS)),
    "array from a buffer": Calls(np.ndarray, ((1,), np.dtype("int64"), POINTERS)),
    "objects out of bytes": array(np.dtype("O"), POINTERS),
    "objects out of text": array(np.dtype("O"), "A" * 8, (8,)),
    "too few objects": array(np.dtype("O"), [1], (2,)),
    "hidden object field": array(dtype("V8", "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0), POINTERS),
    "field of a number": array(dtype("f8", "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0), POINTERS),
    "sub-array": array(dtype("f8", "|", (np.dtype("O"), (1,)), None, None, 8, 1, 0), POINTERS),
    "odd object size": array(dtype("O8", "|", None, None, None, 1, 1, 63), [1]),
    "odd number size": array(dtype("f8", "<", None, None, None, 4, 1, 0), POINTERS),
    "odd byte order": array(dtype("f8", "?", None, None, None, -1, -1, 0), POINTERS),
    "void": array(np.dtype("V8"), POINTERS),
    "comma-separated type": array(dtype("f4,O", *PLAIN), POINTERS),
    "shape beyond the data": array(np.dtype("f8"), POINTERS, (1 << 20,)),
    "negative shape": array(np.dtype("f8"), POINTERS, (-1, -1)),
    "overflowing shape": array(np.dtype("f8"), POINTERS, (1 << 40, 1 << 40)),
    "shape of another type": array(np.dtype("f8"), POINTERS, 1),
    "text beyond Unicode": array(np.dtype("U2"), POINTERS),
    "no type": array(None, POINTERS),
    "type is text": array("O", POINTERS),
    "state of a function": Calls(np.zeros(1).__reduce__()[0], (), (None, {"__defaults__": (1,)})),
}


def test_hostile_arrays_are_refused(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.npy" for number in range(len(HOSTILE))]
    for path, hostile in zip(paths, HOSTILE.values(), strict=True):
        with_header(path, pickle.dumps({"transforms": hostile}))
    # Files that are not refused may crash the interpreter, so another process reads them.
    load = (
        "import sys, pathlib; from handover_marl.datasets.grasp_files import *; from handover_marl.errors import *\n"
        "for path in sys.argv[1:]:\n"
        "    try: print('loaded', load_pickled_dict(pathlib.Path(path))['transforms'], flush=True)\n"
        "    except DataFormatError as error: print(f'refused: {error}', flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", load, *map(str, paths)], capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"it crashed with: {list(HOSTILE)[len(lines)]}"
    for name, path, line in zip(HOSTILE, paths, lines, strict=True):
        assert line.startswith(f"refused: {path}"), name


@pytest.mark.parametrize(
    "pickled",
    [
        # The pickle requests a function of the reader and sets its defaults by BUILD, which sets attributes.
        b"\x80\x02cnumpy._core.multiarray\n_reconstruct\n(N}U\x0c__defaults__K\x01stb.",
        b"\x80\x02cnumpy\nndarray\n(N}U\x05_callK\x01stb.",
        # The memo index would take 32 GiB.
        b"\x80\x02}r\xff\xff\xff\x7f.",
        b"\x80\x02}p2147483647\n.",
        # The key is nested so deeply that hashing it would overflow the stack.
        b"\x80\x02})" + b"\x85" * 500_000 + b"K\x01s.",
        b"\x80\x02}(\x8c\x01\xe9K\x01u.",
        b"\x80\x02}(U\x01\xe9K\x01u.",
        b"\x80\x02}(K\x01K\x01u.",
    ],
)
def test_hostile_pickles_are_refused(tmp_path: Path, pickled: bytes) -> None:
    with pytest.raises(DataFormatError, match=r"g\.npy.*not a readable grasp file"):
        load_pickled_dict(with_header(tmp_path / "g.npy", pickled))
    test_reads_python_2_pickles(tmp_path)


def flip_bytes(folder: Path) -> None:
    """Read randomly damaged files of every pickle protocol; errors other than the library's end the process."""
    path, rng = folder / "g.npy", random.Random(0)
    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        content = {
            "transforms": np.eye(4)[None],
            "names": np.array(["a", 1], dtype=object),
            "text": ARRAYS["text"],
        }
        whole = with_header(path, pickle.dumps(np.array(content, dtype=object), protocol=protocol)).read_bytes()
        for _ in range(1500):
            path.write_bytes(spoil(whole, rng))
            try:
                str(load_pickled_dict(path))
                load_grasps(path)
            except DataFormatError as error:
                assert str(path) in str(error)  # noqa: PT017


def test_flipped_bytes_never_crash(tmp_path: Path) -> None:
    script = "import sys, pathlib; from tests.datasets.test_grasp_files import *; flip_bytes(pathlib.Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, str(tmp_path)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_foreign_code_is_refused_and_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "was_run"
    evil_grasps(tmp_path / "g.npy", marker)
    with pytest.raises(UnsafeFileError, match=r"g\.npy.*foreign code"):
        load_grasps(tmp_path / "g.npy")
    assert not marker.exists()


@pytest.mark.parametrize("operation", ["\x82\x01", "Pid\n", "(ios\nsystem\n"], ids=["EXT1", "PERSID", "INST"])
def test_operations_that_could_run_code_are_refused(tmp_path: Path, operation: str) -> None:
    with pytest.raises(DataFormatError, match=r"g\.npy"):
        load_grasps(with_header(tmp_path / "g.npy", b"\x80\x02" + operation.encode("latin1") + b"."))


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
        {"transforms": np.array([[["1"] * 4] * 4])},
        {"transforms": np.ones((1, 4, 4), dtype=object)},
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
