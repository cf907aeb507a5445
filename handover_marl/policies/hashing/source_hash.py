"""Hashes of code and weights of policies, so that results of different policies are never mixed."""

import functools
import hashlib
import importlib.util
import inspect
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path
from types import CodeType

import handover_marl

_LIBRARY = "handover_marl"
# Packages of the library that may be installed from folders beside its own.
_SEPARATE = ("assets", "givers", "receivers")
_SITE_FOLDERS = ("site-packages", "dist-packages")
_STANDARD_LIBRARY = Path(sysconfig.get_path("stdlib"))
_PLAIN = (int, float, str, bytes, tuple, type(None))


def hash_policy(policy_class: type, state: bytes = b"", weights: bytes = b"") -> str:
    """Compute the hash of a policy: "LIBRARY.PACKAGE" or "LIBRARY.PACKAGE.WEIGHTS".

    Each part has 8 hex digits. LIBRARY covers the library's files (`hash_library`), PACKAGE the
    class, its state and the packages of its author (`hash_packages`), WEIGHTS its weights.

    Args:
        policy_class: Class of the policy.
        state: Options or state of an instance, as bytes.
        weights: Weights as bytes, or their hash; empty if the policy has none.
    """
    digest = hashlib.sha256(state)
    digest.update(f"{policy_class.__module__}:{policy_class.__qualname__}".encode())
    digest.update(hash_packages(policy_class).encode())
    for base in _list_own_classes(policy_class):
        if find_source_file(base.__module__) is None or "<locals>" in base.__qualname__:
            digest.update(describe_class(base).encode())
    parts = [hash_library(), digest.hexdigest()[:8]]
    if weights:
        parts.append(hashlib.sha256(weights).hexdigest()[:8])
    return ".".join(parts)


def is_library_class(policy_class: type) -> bool:
    """Check whether a class is defined in this library, so that `hash_library` covers it."""
    return _get_package(policy_class) == _LIBRARY


@functools.cache
def hash_library() -> str:
    """Compute a hash (8 hex digits) of this library's Python files, read once per process."""
    folders = [Path(folder) for folder in handover_marl.__path__]
    for name in _SEPARATE:
        spec = importlib.util.find_spec(f"{_LIBRARY}.{name}")
        folders += map(Path, (spec and spec.submodule_search_locations) or ())
    return _hash_folders(sorted(set(folders)), "**/*.py")[:8]


def hash_packages(policy_class: type) -> str:
    """Compute a hash (8 hex digits) of the packages that define a class and its base classes.

    The hash covers all Python files of the top-level packages in which the classes are defined; for a module
    outside a package, all in its folder. This library and the standard library are left out.
    """
    digest = hashlib.sha256()
    for top in sorted({_get_package(base) for base in _list_own_classes(policy_class)} - {_LIBRARY}):
        digest.update(hash_package(top).encode())
    return digest.hexdigest()[:8]


def _list_own_classes(policy_class: type) -> list[type]:
    """Return a class and its base classes, without those of the standard library."""
    return [base for base in policy_class.__mro__ if _get_package(base) not in sys.stdlib_module_names]


def _get_package(policy_class: type) -> str:
    return policy_class.__module__.partition(".")[0]


def is_installed_package(name: str) -> bool:
    """Return whether a top-level package is this library, the standard library or installed by pip."""
    if name == _LIBRARY or (name in sys.stdlib_module_names and name != "__main__"):
        return True
    module = sys.modules.get(name)
    folders = list(getattr(module, "__path__", None) or ())
    place = folders[0] if folders else getattr(module, "__file__", None)
    return isinstance(place, str) and any(folder in Path(place).parts for folder in _SITE_FOLDERS)


def hash_package(name: str) -> str:
    """Compute a hash of all Python files of a top-level package; empty if it has no files.

    For a module outside a package, the hash covers all files in its folder.
    """
    folders = getattr(sys.modules.get(name), "__path__", None)
    if folders is not None:
        return _hash_folders(map(Path, folders), "**/*.py")
    path = find_source_file(name)
    if path is None:
        return ""
    if path.parent.name in _SITE_FOLDERS:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return _hash_folders([path.parent], "*.py")


def _hash_folders(folders: Iterable[Path], pattern: str) -> str:
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.glob(pattern)):
            if path.is_file():
                name = path.relative_to(folder).as_posix()
                digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def find_source_file(module: str) -> Path | None:
    """Find the file of a user's module; None for code typed at a prompt or run by a profiler."""
    name = getattr(sys.modules.get(module), "__file__", None)
    if not isinstance(name, str):
        return None
    path = Path(name)
    # The standard library, whose files need not be readable, has the main module of a profiled script.
    if _STANDARD_LIBRARY in path.parents and not any(folder in path.parts for folder in _SITE_FOLDERS):
        return None
    return path if path.is_file() else None


def describe_class(policy_class: type) -> str:
    """Return the code of a class without a source file as text, for its hash.

    The text includes the plain values (numbers, text, tuples) and helper functions that its methods use.
    """
    texts = []
    for name, value in sorted(vars(policy_class).items()):
        function = inspect.unwrap(getattr(value, "fget", None) or getattr(value, "__func__", value))
        if not inspect.isfunction(function):
            texts.append(f"{name}={value!r}" if isinstance(value, _PLAIN) else name)
            continue
        used = inspect.getclosurevars(function)
        values = sorted({**used.globals, **used.nonlocals}.items())
        texts += [f"{key}={item!r}" for key, item in values if isinstance(item, _PLAIN)]
        helpers = [item for _, item in values if inspect.isfunction(item)]
        texts += [describe_code(item.__code__) for item in (function, *helpers)]
    return "\n".join(texts)


def describe_code(code: CodeType) -> str:
    """Return compiled code as text, for the hash of a function without a source file."""
    return f"{code.co_name} {code.co_code!r} {code.co_names!r} {list(map(_describe_constant, code.co_consts))}"


def _describe_constant(constant: object) -> str:
    if isinstance(constant, CodeType):
        return describe_code(constant)
    # The order of a set of strings differs between processes.
    return repr(sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant)
