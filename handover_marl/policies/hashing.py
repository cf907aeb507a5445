"""Hashes of policies, so that results of different policies are never mixed.

A hash covers the library's version, the source files that define a policy, and the values, arrays and files that the
policy holds. The hash is equal in every process, also in a script with the policy's code. Code without a source file,
as at a prompt or in a notebook, gets another hash every time, so that an evaluation of it cannot be resumed.
"""

import contextlib
import functools
import hashlib
import inspect
import secrets
import sys
from collections.abc import Iterator, Mapping
from modulefinder import ModuleFinder
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from handover_marl.execution.reading import cached_by_file, read_mtime
from handover_marl.version import __version__

_LIBRARY, _SCRIPT = "handover_marl", "__main__"
_SITE_FOLDERS = {"site-packages", "dist-packages"}
_PLAIN = (int, float, complex, str, bytes, type(None))
_DEFINITIONS = (type, ModuleType, FunctionType, BuiltinFunctionType)
_MAX_DEPTH = 60


def hash_policy(policy: object, state: object, weights: bytes = b"") -> str:
    """Compute the hash of a policy, CODE or CODE.WEIGHTS; each part has 8 hex digits.

    Args:
        policy: The policy; its arrays count as weights unless its class is one of this library.
        state: Options of the constructor, or attributes of an instance; they are hashed with the code.
        weights: Weights or their hashes; empty if the policy has none.
    """
    code = hash_object((__version__, type(policy), state))[:8]
    if _get_package(type(policy)) != _LIBRARY:
        weights += hash_object(policy, arrays_only=True).encode()
    return f"{code}.{hashlib.sha256(weights).hexdigest()[:8]}" if weights else code


def hash_object(value: object, arrays_only: bool = False) -> str:
    """Compute a hash (64 hex digits) of a value, function, PyTorch module, class or other object.

    A function or class is hashed with its package (`hash_package`). Unless the package is installed, variables that a
    function uses, and numbers and texts in a class, are hashed, too. Other objects are hashed with their attributes.

    Args:
        value: Value to hash.
        arrays_only: Whether to hash only arrays and tensors, except those in objects of this library, which are
            computed from options and files.

    Returns:
        Hash; empty if there is nothing to hash.
    """
    parts = list(_describe(value, {}, arrays_only))
    return hashlib.sha256(b"\0".join(parts)).hexdigest() if parts else ""


def hash_package(name: str) -> str:
    """Return the version of a top-level package or module if it is installed and has one, else a hash of its files.

    The hash covers all Python files of a package, or the file of a module, and modules and packages in the same folder
    that these files import, directly or not. A package of the standard library without a version gets "", code without
    a file gets a random hash.
    """
    package, folders = sys.modules.get(name), _find_folders(name)
    if _is_installed(name):
        version = __version__ if name == _LIBRARY else getattr(package, "__version__", "")
        if version or name in sys.stdlib_module_names:
            return str(version)
    if hasattr(package, "__path__"):
        files = [path for folder in folders for path in sorted(folder.rglob("*.py")) if path.is_file()]
        files += sorted({path for folder in folders for path in _find_beside(tuple(files), folder.parent)} - {*files})
    else:
        files = sorted(_find_imported_files((Path(getattr(package, "__file__", "")),), folders[0])) if folders else []
    digest = hashlib.sha256(b"" if folders else secrets.token_bytes())
    for path in files:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def find_package(function: object) -> str:
    """Return the name of the top-level package from which other processes import a function, class or object.

    The name is empty if other processes unpickle the code instead, as for code of a script.
    """
    if isinstance(function, functools.partial):
        return find_package(function.func)
    function = function.__self__ if isinstance(function, MethodType) else function
    owner: Any = function if isinstance(function, (type, FunctionType)) else type(function)
    name = _get_package(owner)
    return "" if owner.__module__ == _SCRIPT or "<" in owner.__qualname__ or name not in sys.modules else name


def _get_package(definition: Any) -> str:
    """Return the top-level package or module of a function or class; "__main__" for a script not run in a package."""
    module = definition.__module__ or "builtins"
    package, is_in_package, _ = _get_import_name(module).partition(".")
    return package if is_in_package else module


def _get_import_name(module: str) -> str:
    """Return the name by which other programs import a module; for "__main__", the name of the module that runs."""
    main = sys.modules.get(_SCRIPT) if module == _SCRIPT else None
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    return str(spec.name) if spec is not None else Path(file).name.partition(".")[0] if file else module


def _find_imported_files(files: tuple[Path, ...], folder: Path) -> set[Path]:
    """Return `files` and, unless `folder` is installed, its Python files that they import, directly or not."""
    finder = ModuleFinder([str(folder)], excludes=[_LIBRARY])
    for file in () if _SITE_FOLDERS & set(folder.parts) else files:
        # Compiled code, code for another Python, or a relative import in a folder without __init__.py.
        with contextlib.suppress(AttributeError, ImportError, SyntaxError, ValueError):
            if file.parent == folder or not (file.parent / "__init__.py").is_file():
                finder.run_script(str(file))
            else:
                finder.import_hook(".".join(file.relative_to(folder).with_suffix("").parts).removesuffix(".__init__"))
    imported = (getattr(module, "__file__", None) for module in finder.modules.values())
    return {*files, *map(Path, filter(None, imported))}


# Cached, because reading a large package takes seconds.
_find_beside = cached_by_file(16, lambda files: tuple(map(read_mtime, files)))(_find_imported_files)


def _find_folders(name: str) -> list[Path]:
    """Return the folders of a top-level package or module; an empty list if it has no file."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    return [Path(path) for path in getattr(module, "__path__", ())] or ([Path(file).parent] if file else [])


def _is_installed(name: str) -> bool:
    if name == _LIBRARY or (name in sys.stdlib_module_names and name != _SCRIPT):
        return True
    return any(_SITE_FOLDERS & set(folder.parts) for folder in _find_folders(name))


def _describe(value: Any, seen: dict[int, tuple[int, object]], arrays_only: bool, depth: int = 0) -> Iterator[bytes]:
    """Yield the bytes to hash of a value and of all that it refers to; skip objects in `seen`, and add the others."""
    if isinstance(value, _PLAIN) and not arrays_only:
        yield repr(value).encode()
    if id(value) in seen and not isinstance(value, _PLAIN) and not arrays_only:
        yield f"object {seen[id(value)][0]}".encode()
    if isinstance(value, _PLAIN) or id(value) in seen or depth > _MAX_DEPTH:
        return
    seen[id(value)] = len(seen), value  # kept, so that no other object gets its id
    parts: list[Any] = []
    if isinstance(value, _DEFINITIONS):
        parts = [] if arrays_only else _list_parts_of_definition(value)
    elif (array := _convert_array(value)) is not None:
        yield f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes()
    elif not (arrays_only and depth and _get_package(type(value)) == _LIBRARY):
        parts = _list_parts(value)
    if not arrays_only:
        yield f"{len(parts)} parts".encode()
    for part in parts:
        yield from _describe(part, seen, arrays_only, depth + 1)


def _list_parts_of_definition(value: Any) -> list[Any]:
    """Return the parts to hash of a definition: name, package, a function's code, and variables if not installed."""
    if isinstance(value, ModuleType):
        return [value.__name__, hash_package(value.__name__.partition(".")[0])]
    packages = {_get_package(base) for base in (value.__mro__ if isinstance(value, type) else [value])}
    hashes = map(hash_package, sorted(packages, key=_get_import_name))
    parts = [_get_import_name(value.__module__), value.__qualname__, *hashes]
    is_own = not _is_installed(_get_package(value))
    if isinstance(value, FunctionType):
        # Several functions of a file may have one name, and `eval` may make them of any text.
        names: set[str] = set()
        parts.append(_list_parts_of_code(value.__code__, names))
        if is_own:
            variables = {name: value.__globals__[name] for name in names if name in value.__globals__}
            variables |= inspect.getclosurevars(value).nonlocals
            parts += [variables, value.__defaults__, value.__kwdefaults__]
    elif isinstance(value, type) and is_own:
        # A program may change attributes of a class, and the functions of a local class may be closures.
        kinds = (FunctionType, *_PLAIN) if "<" in value.__qualname__ else _PLAIN
        members = {key: getattr(part, "fget", part) for key, part in vars(value).items() if key != "__module__"}
        parts += [{key: part for key, part in members.items() if isinstance(part, kinds)}, value.__bases__]
    return parts


def _list_parts_of_code(code: CodeType, names: set[str]) -> list[Any]:
    """Return the parts to hash of a function's code and of functions in it; add the names that it reads to `names`."""
    names.update(code.co_names)
    constants = [
        _list_parts_of_code(part, names) if isinstance(part, CodeType) else part
        for part in code.co_consts
        if isinstance(part, (CodeType, tuple, frozenset, *_PLAIN))
    ]
    return [code.co_firstlineno, code.co_code, code.co_names, constants]


def _list_parts(value: Any) -> list[Any]:
    """Return the values to hash of a container or object: its elements, or class and attributes if it is picklable."""
    if isinstance(value, Mapping):
        return sorted(((str(key), part) for key, part in value.items()), key=lambda pair: pair[0])
    if isinstance(value, (list, tuple)):
        return list(value)
    if isinstance(value, (set, frozenset)):
        return sorted(value, key=repr)
    if callable(getattr(value, "state_dict", None)):  # a network, whose arrays need not be attributes
        return [type(value), vars(value), value.state_dict()]
    try:
        reduced = value.__reduce_ex__(2)
    except Exception:  # what cannot be pickled, such as a lock, does not decide on actions
        return []
    return [reduced] if isinstance(reduced, str) else [*reduced[:3], *map(list, filter(None, reduced[3:]))]


def _convert_array(value: Any) -> np.ndarray[Any, Any] | None:
    """Convert an array or tensor to a NumPy array; return None for other values and arrays of objects."""
    if callable(getattr(value, "detach", None)):  # tensors of PyTorch
        value = value.detach().cpu()
        value = value.float() if str(getattr(value, "dtype", "")) == "torch.bfloat16" else value  # unknown to NumPy
    array = np.asarray(value) if hasattr(value, "__array__") and hasattr(value, "dtype") else None
    return None if array is None or array.dtype.hasobject else array
