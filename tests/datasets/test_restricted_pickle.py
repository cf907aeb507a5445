import pickle
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.restricted_pickle import load_restricted
from handover_marl.errors import UnsafeFileError

ARRAYS = {
    "float32": np.arange(32, dtype=np.float32).reshape(2, 4, 4),
    "big endian": np.arange(6, dtype=">f8"),
    "Fortran order": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "permuted axes": np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    "scalar": np.array(3.5),
    "empty": np.zeros((0, 4, 4)),
}


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_reads_what_numpy_writes(protocol: int) -> None:
    found = load_restricted(pickle.dumps(ARRAYS, protocol=protocol))
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
        np.testing.assert_array_equal(found[name], array)


def call(module: str, name: str, argument: str) -> bytes:
    """Return a pickle that calls a function with a text."""
    return f"c{module}\n{name}\n(S'{argument}'\ntR.".encode()


UNSAFE = {
    "os.system": call("os", "system", "touch was_run"),
    "eval of Python 2": call("__builtin__", "eval", "open('was_run', 'w')"),
    "getattr": b"cbuiltins\ngetattr\n(cnumpy\nndarray\nS'__subclasses__'\ntR.",
    "an attribute of an allowed class": b"\x80\x04\x8c\x05numpy\x8c\x0fdtype.__class__\x93.",
    "numpy's loader": call("numpy", "load", "was_run"),
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
    data = {**UNSAFE, **DAMAGED}[what]
    error, message = (UnsafeFileError, "^asks for ") if what in UNSAFE else (Exception, None)
    with pytest.raises(error, match=message):
        load_restricted(data)
    assert not list(tmp_path.iterdir())
    # The functions that pickles may use are as before.
    test_reads_what_numpy_writes(2)
