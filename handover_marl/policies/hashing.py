"""Hashes of policies, so that results of different policies are never mixed.

A hash covers the library's version, the source files of the packages that define a policy, and the values, arrays
and files that it holds. It is equal in every process.
"""

import functools
import hashlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from handover_marl.version import __version__

_LIBRARY = "handover_marl"
_SITE_FOLDERS = {"site-packages", "dist-packages"}
_PLAIN = (int, float, complex, str, bytes, type(None))
_DEFINITIONS = (type, ModuleType, FunctionType, BuiltinFunctionType)
_MAX_DEPTH = 30


def hash_policy(policy_class: type, state: object = None, weights: bytes = b"") -> str:
    """Compute the hash of a policy, CODE or CODE.WEIGHTS; each part has 8 hex digits.

    Args:
        policy_class: Class of the policy.
        state: Options of the constructor, or attributes of an instance.
        weights: Weights or their hashes; empty if the policy has none.
    """
    code = hash_object((__version__, policy_class, state))[:8]
    return f"{code}.{hashlib.sha256(weights).hexdigest()[:8]}" if weights else code


def hash_object(value: object, arrays_only: bool = False) -> str:
    """Compute a hash (64 hex digits) of a value, function, PyTorch module, class or other object.

    Functions and classes count with the source files of their package, or with the version of an installed package;
    functions with the variables that they use; objects with their attributes.

    Args:
        value: Value to hash.
        arrays_only: Whether to include nothing but arrays and tensors. Objects of this library are then left out,
            since its code computes what they hold from options and files.

    Returns:
        Hash; empty if there is nothing to include.
    """
    parts = list(_describe("", value, {}, arrays_only))
    return hashlib.sha256(b"\0".join(parts)).hexdigest() if parts else ""


def hash_package(module: str) -> str:
    """Return a hash of the Python files of a module's package, or the version of an installed package.

    For a module outside a package, the hash covers the files in its folder. It is empty for this library, the
    standard library, and code without a file.
    """
    top = module.partition(".")[0]
    folders = _find_folders(top)
    if top == _LIBRARY or not folders:
        return ""
    package = sys.modules[top]
    version = getattr(package, "__version__", "")
    if version and _is_installed(top):
        return str(version)
    pattern = "**/*.py" if hasattr(package, "__path__") else "*.py"
    digest = hashlib.sha256()
    for path in (path for folder in folders for path in sorted(folder.glob(pattern)) if path.is_file()):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def list_packages(function: object) -> tuple[str, ...]:
    """Return the top-level packages from which a function or object is imported, except installed packages.

    Code that is pickled and not imported, such as the code of a script, is left out.
    """
    if isinstance(function, functools.partial):
        return list_packages(function.func)
    function = function.__self__ if isinstance(function, MethodType) else function
    owner: Any = function if isinstance(function, (type, FunctionType)) else type(function)
    top = str(owner.__module__).partition(".")[0]
    is_pickled = top == "__main__" or "<" in owner.__qualname__ or top not in sys.modules
    return () if is_pickled or _is_installed(top) else (top,)


def is_library_class(policy_class: type) -> bool:
    """Check whether a class is defined in this library, whose version covers it."""
    return policy_class.__module__.partition(".")[0] == _LIBRARY


def _find_folders(top: str) -> list[Path]:
    """Return the folders of a top-level package or module; none for the standard library and typed code."""
    module = sys.modules.get(top)
    if top in sys.stdlib_module_names and top != "__main__":
        return []
    file = getattr(module, "__file__", None)
    return [Path(path) for path in getattr(module, "__path__", ())] or ([Path(file).parent] if file else [])


def _is_installed(top: str) -> bool:
    if top == _LIBRARY or (top in sys.stdlib_module_names and top != "__main__"):
        return True
    return any(_SITE_FOLDERS & set(folder.parts) for folder in _find_folders(top))


def _describe(name: str, value: Any, seen: dict[int, object], arrays_only: bool, depth: int = 0) -> Iterator[bytes]:
    """Yield descriptions of a value and of the values that it refers to; each object is described once."""
    if isinstance(value, _PLAIN) or id(value) in seen or depth > _MAX_DEPTH:
        if isinstance(value, _PLAIN) and not arrays_only:
            yield f"{name}={value!r}".encode()
        return
    seen[id(value)] = value  # kept, so that no other object gets its number
    if isinstance(value, _DEFINITIONS):
        if not arrays_only:
            yield f"{name} {_describe_definition(value)}".encode()
            for key, part in sorted(_list_variables(value).items()):
                yield from _describe(key, part, seen, arrays_only, depth + 1)
        return
    array = _convert_array(value)
    if array is not None:
        yield f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes()
    elif not (arrays_only and depth and is_library_class(type(value))):
        for key, part in _list_parts(value):
            yield from _describe(f"{name}.{key}", part, seen, arrays_only, depth + 1)


def _describe_definition(value: Any) -> str:
    """Return the name of a function, class or module, and the hashes of the packages that define it."""
    if isinstance(value, ModuleType):
        return f"{value.__name__} {hash_package(value.__name__)}"
    modules = [base.__module__ for base in value.__mro__] if isinstance(value, type) else [str(value.__module__)]
    code = _describe_code(value.__code__) if isinstance(value, FunctionType) else ""
    packages = sorted({module.partition(".")[0] for module in modules})
    return f"{modules[0]}:{value.__qualname__} {list(map(hash_package, packages))} {code}"


def _describe_code(code: CodeType) -> str:
    """Return compiled code as text: several functions of a file may have one name, and typed code has no file."""
    constants = [sorted(map(repr, part)) if isinstance(part, frozenset) else part for part in code.co_consts]
    described = [_describe_code(part) if isinstance(part, CodeType) else repr(part) for part in constants]
    return f"{code.co_code!r} {code.co_names} {described}"


def _list_variables(value: Any) -> dict[str, Any]:
    """Return the variables that a function uses, or the members of a class that no file contains."""
    if not isinstance(value, (type, FunctionType)) or _is_installed(value.__module__.partition(".")[0]):
        return {}
    if isinstance(value, FunctionType):
        used = inspect.getclosurevars(value)
        return {**used.globals, **used.nonlocals, "": (value.__defaults__, value.__kwdefaults__)}
    if "<" not in value.__qualname__ and _find_folders(value.__module__.partition(".")[0]):
        return {}
    members = {key: getattr(part, "fget", None) or inspect.unwrap(part) for key, part in vars(value).items()}
    listed = {key: part for key, part in members.items() if isinstance(part, (FunctionType, *_PLAIN))}
    return {**listed, "": value.__bases__}


def _list_parts(value: Any) -> list[tuple[str, Any]]:
    """Return the named parts of an object or container."""
    if isinstance(value, Mapping):
        return sorted(((str(key), part) for key, part in value.items()), key=lambda pair: pair[0])
    if isinstance(value, (list, tuple, set, frozenset)):
        items = sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value
        return [(str(number), part) for number, part in enumerate(items)]
    if callable(getattr(value, "state_dict", None)):  # a network, whose arrays need not be attributes
        return [("class", type(value)), ("", vars(value)), ("state_dict()", value.state_dict())]
    try:
        reduced = value.__reduce_ex__(2)
    except Exception:  # what cannot be pickled, such as a lock, does not decide on actions
        return []
    if isinstance(reduced, str):
        return [("", reduced)]
    return [("", (*reduced[:3], *map(list, filter(None, reduced[3:]))))]


def _convert_array(value: Any) -> np.ndarray[Any, Any] | None:
    """Convert an array or tensor to a NumPy array; return None for other values and arrays of objects."""
    if callable(getattr(value, "detach", None)):  # tensors of PyTorch
        value = value.detach().cpu()
        if str(getattr(value, "dtype", "")) == "torch.bfloat16":  # NumPy has no such type
            value = value.float()
    if not hasattr(value, "__array__") or not hasattr(value, "dtype"):
        return None
    array = np.asarray(value)
    return None if array.dtype.hasobject else array
