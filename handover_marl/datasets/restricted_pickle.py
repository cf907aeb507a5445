"""Unpickling of data from untrusted files: a pickle gets the functions and classes that the caller allows, no others.

Nothing is imported and no code of the file runs. A file can still stall the process: the keys of a dict can be nested
such that hashing them does not end.
"""

import functools
import io
import pickle
import pickletools
from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeAlias

from handover_marl.errors import UnsafeFileError

# Largest number of operations, which bounds how deep data are nested. Official files have 120 to 460.
_MAX_OPERATIONS = 10_000
_MAX_MESSAGE_TEXT = 80  # characters

#: What a pickle may call or create, by the module and name that it asks for.
AllowedNames: TypeAlias = Mapping[tuple[str, str], Callable[..., object]]


class PickledRecord:
    """Inert replacement of an object whose class is not imported.

    Attributes:
        state: Unchecked state of the object.
    """

    state: Mapping[object, object] = {}

    def __setstate__(self, state: object) -> None:
        """Set the state, which must be a dict."""
        if not isinstance(state, dict):
            reject("the state of an object is no dict")
        self.state = state


class _RestrictedUnpickler(pickle.Unpickler):
    def __init__(self, data: bytes, allowed: AllowedNames) -> None:
        # Text of Python 2 becomes bytes, since arrays are stored as text there.
        super().__init__(io.BytesIO(data), encoding="bytes")
        self._allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        """Return an allowed function or class.

        Raises:
            UnsafeFileError: The name is not allowed.
        """
        try:
            target = self._allowed[module, name]
        except KeyError:
            raise UnsafeFileError(f"asks for {sanitize_text(f'{module}.{name}')}") from None
        # A pickle can set attributes of a function, hence a new object; it cannot set those of these classes.
        return target if isinstance(target, type) else functools.partial(target)


def load_restricted(data: bytes, allowed: AllowedNames) -> object:
    """Load a pickle from an untrusted source without importing anything.

    Args:
        data: Pickle of any protocol.
        allowed: Functions and classes that the pickle may use. Classes need a method `__setstate__`.

    Raises:
        UnsafeFileError: The pickle asks for another name; the message is the rest of a sentence that starts with "the
            pickle".
        Exception: The pickle is damaged; any type may be raised.
    """
    for count, (operation, argument, _) in enumerate(pickletools.genops(data)):
        # `pickle` allocates memory for all memo indices up to the largest one.
        index = int(argument or 0) if operation.name in ("PUT", "LONG_BINPUT") else 0
        if count >= _MAX_OPERATIONS or not 0 <= index < _MAX_OPERATIONS:
            reject("the pickle is far more intricate than a dict of arrays")
    return _RestrictedUnpickler(data, allowed).load()


def reject(reason: str) -> NoReturn:
    """Raise `pickle.UnpicklingError` with a reason."""
    raise pickle.UnpicklingError(reason)


def sanitize_text(text: str) -> str:
    """Return untrusted text for an error message: printable, at most 80 characters."""
    return (text if text.isprintable() else ascii(text))[:_MAX_MESSAGE_TEXT]


def decode_name(value: object) -> str:
    """Return a name in a pickle as text; Python 2 pickles hold names as bytes.

    Raises:
        pickle.UnpicklingError: The value is not text.
    """
    if isinstance(value, bytes):
        return value.decode("ascii")
    if isinstance(value, str):
        return value
    reject(f"expected text, found {type(value).__name__}")
