"""Unpickling of arrays from untrusted files: grasp files of HandoverSim and hand models of MANO.

A pickle can name any Python function to be called. Here it can only use the functions and classes in `ARRAY_NAMES` and
those that the caller of `load_restricted` allows.
"""

import functools
import io
import pickle
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from handover_marl.errors import UnsafeFileError
from handover_marl.execution.files import shorten_text

#: Functions and classes that a pickle may use, by the pair (module, name) that stands in the pickle.
AllowedNames: TypeAlias = Mapping[tuple[str, str], Callable[..., object]]

# NumPy's functions that make arrays; their modules have other names in other versions.
_RECONSTRUCT: Any = np.zeros(1).__reduce__()[0]
_FROM_BUFFER: Any = np.zeros(1).__reduce_ex__(5)[0]

#: Functions and classes that pickles of arrays, and of dicts of arrays, use in all versions of NumPy.
ARRAY_NAMES: AllowedNames = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _RECONSTRUCT for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _FROM_BUFFER for core in ("core", "_core")},
    # Pickles of protocol 2 store bytes as latin-1 text.
    ("_codecs", "encode"): lambda text, _: text.encode("latin1"),
    ("__builtin__", "bytes"): bytes,
    ("collections", "OrderedDict"): dict,
}


class _RestrictedUnpickler(pickle.Unpickler):
    def __init__(self, data: bytes, allowed: AllowedNames) -> None:
        # Arrays of Python 2 are stored as text.
        super().__init__(io.BytesIO(data), encoding="latin1")
        self._allowed = {**ARRAY_NAMES, **allowed}

    def find_class(self, module: str, name: str) -> Any:
        """Return an allowed function or class; raise `UnsafeFileError` for all others."""
        try:
            target = self._allowed[module, name]
        except KeyError:
            raise UnsafeFileError(f"asks for {shorten_text(f'{module}.{name}')}") from None
        # A pickle can set attributes of a function, hence a new object.
        return target if isinstance(target, type) else functools.partial(target)


def load_restricted(data: bytes, allowed: AllowedNames = ARRAY_NAMES) -> Any:
    """Load an untrusted pickle; raise `UnsafeFileError` if it uses a name that is not in `ARRAY_NAMES` or `allowed`."""
    return _RestrictedUnpickler(data, allowed).load()
