"""Hash of a function or PyTorch module: its code, the values that it uses, and its arrays."""

import dataclasses
import dis
import functools
import hashlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from handover_marl.policies.hashing.source_hash import (
    describe_class,
    describe_code,
    find_source_file,
    hash_package,
    is_installed_package,
    is_library_class,
)
from handover_marl.policies.hashing.state_hash import convert_array

_PLAIN = (int, float, complex, str, bytes, type(None))
_WITHOUT_ARRAYS = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType)
_MAX_DEPTH = 12


def hash_function(function: object) -> str:
    """Compute a hash (64 hex digits) of a function, a PyTorch module or another callable object.

    The hash covers the code of functions and classes that are not in an installed package, the values of variables
    that they use, default arguments, attributes of objects, arrays and tensors. Installed packages
    count with their version. The hash is equal in every process.

    Args:
        function: Function, bound method, `functools.partial`, PyTorch module, class or callable object.
    """
    digest = hashlib.sha256()
    for part in _Description().describe(function, "", 0):
        digest.update(part + b"\0")
    return digest.hexdigest()


def list_packages(function: object) -> tuple[str, ...]:
    """Return the top-level packages from which a function or object is imported, except installed packages.

    Code that is pickled and not imported, such as the code of a script, is left out.
    """
    if isinstance(function, functools.partial):
        return list_packages(function.func)
    owner: Any = function if isinstance(function, (type, FunctionType)) else type(function)
    if isinstance(function, MethodType):
        owner = type(function.__self__)
    top = str(owner.__module__).partition(".")[0]
    is_pickled = top == "__main__" or "<" in owner.__qualname__ or top not in sys.modules
    return () if is_pickled or is_installed_package(top) else (top,)


class _Description:
    """Description of a value as bytes; each object is described once."""

    def __init__(self) -> None:
        self._seen: set[int] = set()
        # Kept, so that no object gets the number of one that was deleted.
        self._kept: list[object] = []

    def describe(self, value: Any, name: str, depth: int) -> Iterator[bytes]:
        """Yield descriptions of a value and of the values that it refers to."""
        if isinstance(value, _PLAIN):
            yield f"{name}={value!r}".encode()
            return
        if depth > _MAX_DEPTH or id(value) in self._seen:
            return
        self._seen.add(id(value))
        self._kept.append(value)
        array = None if isinstance(value, _WITHOUT_ARRAYS) else convert_array(value)
        if array is not None:
            yield f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes()
        elif isinstance(value, ModuleType):
            yield from self._describe_package(value.__name__)
        elif isinstance(value, BuiltinFunctionType):
            yield f"{name}={value.__qualname__}".encode()
        else:
            yield from self._describe_object(value, name, depth + 1)

    def _describe_object(self, value: Any, name: str, depth: int) -> Iterator[bytes]:
        if isinstance(value, FunctionType):
            yield from self._describe_function(value, depth)
        elif isinstance(value, type):
            yield from self._describe_type(value, depth)
        elif isinstance(value, MethodType):
            yield from self.describe(value.__func__, name, depth)
            yield from self.describe(value.__self__, name, depth)
        elif isinstance(value, functools.partial):
            for part in (value.func, value.args, value.keywords):
                yield from self.describe(part, f"{name}.partial", depth)
        elif isinstance(value, (Mapping, list, tuple)):
            items = value.items() if isinstance(value, Mapping) else enumerate(value)
            for key, item in sorted(items, key=lambda pair: str(pair[0])):
                yield from self.describe(item, f"{name}.{key}", depth)
        elif isinstance(value, (set, frozenset)):
            yield f"{name}={sorted(map(repr, value))}".encode()
        else:
            yield from self._describe_type(type(value), depth)
            # Other objects of this library hold only what its code computes from options and files.
            if is_library_class(type(value)) and not dataclasses.is_dataclass(value):
                return
            for key, item in sorted(getattr(value, "__dict__", {}).items()):
                yield from self.describe(item, f"{name}.{key}", depth)

    def _describe_function(self, function: FunctionType, depth: int) -> Iterator[bytes]:
        yield f"{function.__module__}:{function.__qualname__}".encode()
        yield from self._describe_package(function.__module__)
        if is_installed_package(function.__module__.partition(".")[0]):
            return
        if find_source_file(function.__module__) is None or "<" in function.__qualname__:
            yield describe_code(function.__code__).encode()
        yield from self.describe((function.__defaults__, function.__kwdefaults__), function.__qualname__, depth)
        for key, item in sorted(_find_variables(function).items()):
            yield from self.describe(item, key, depth)

    def _describe_type(self, owner: type, depth: int) -> Iterator[bytes]:
        for base in owner.__mro__:
            top = base.__module__.partition(".")[0]
            yield f"{base.__module__}:{base.__qualname__}".encode()
            if top in sys.stdlib_module_names and top != "__main__":
                continue
            yield from self._describe_package(base.__module__)
            if is_installed_package(top) or id(base) in self._seen:
                continue
            self._seen.add(id(base))
            if find_source_file(base.__module__) is None or "<" in base.__qualname__:
                yield describe_class(base).encode()
            for key, item in sorted(vars(base).items()):
                if isinstance(item, FunctionType):
                    yield from self._describe_variables(item, depth)
                elif hasattr(item, "__array__") and not isinstance(item, type):
                    yield from self.describe(item, key, depth)

    def _describe_variables(self, function: FunctionType, depth: int) -> Iterator[bytes]:
        for key, item in sorted(_find_variables(function).items()):
            yield from self.describe(item, key, depth)

    def _describe_package(self, module: str) -> Iterator[bytes]:
        top = module.partition(".")[0]
        if top in sys.stdlib_module_names and top != "__main__":
            return
        if is_installed_package(top):
            yield f"{top} {getattr(sys.modules.get(top), '__version__', '')}".encode()
        else:
            yield f"{top} {hash_package(top)}".encode()


def _find_variables(function: FunctionType) -> dict[str, Any]:
    """Return the variables of other scopes that a function and the functions inside it use, by name."""
    names = set(_list_global_names(function.__code__))
    found = {name: function.__globals__[name] for name in names if name in function.__globals__}
    cells = inspect.getclosurevars(function).nonlocals
    return {**found, **cells}


def _list_global_names(code: CodeType) -> Iterator[str]:
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME") and isinstance(instruction.argval, str):
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _list_global_names(constant)
