"""Hash of what a policy is constructed with: arrays, tensors, and the files that it opens."""

import contextlib
import hashlib
import os
import site
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from handover_marl.policies.hashing.source_hash import is_library_class

_MAX_DEPTH = 8
# Files of programs and devices are not weights; code is covered by `hash_policy`.
_IGNORED_SUFFIXES = (".py", ".pyc", ".so", ".pyd", ".pth")
_IGNORED_FOLDERS = ("/dev", "/proc", "/sys")
_WITHOUT_ARRAYS = (type, ModuleType, FunctionType, MethodType, str, bytes, int, float, complex)
_recorders: list[set[str]] = []
_hook_installed = False


@contextlib.contextmanager
def record_opened_files() -> Iterator[set[str]]:
    """Record the paths of all files that Python code opens during a `with` block.

    Files that libraries open in C code, without Python's `open`, are not recorded.
    """
    global _hook_installed
    if not _hook_installed:
        # Python cannot remove audit hooks; this one does nothing outside of the block.
        sys.addaudithook(_record_open)
        _hook_installed = True
    paths: set[str] = set()
    _recorders.append(paths)
    try:
        yield paths
    finally:
        _recorders.remove(paths)


def _record_open(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and _recorders and isinstance(arguments[0], str):
        for paths in _recorders:
            paths.add(arguments[0])


def hash_constructed_state(policy: object, opened: set[str]) -> bytes:
    """Compute a hash of a policy's arrays and tensors, and of data files that it opened.

    Args:
        policy: Constructed policy. Arrays, tensors and objects with a `state_dict` are found in its
            attributes, in containers, and in attributes of its objects.
        opened: Paths of the files that were opened during the construction. Code, and files of the
            Python installation, are left out.

    Returns:
        Digest (32 bytes), or empty bytes if there is nothing to hash.
    """
    digest, found = hashlib.sha256(), False
    for path in sorted(map(Path, opened)):
        if _is_data_file(path):
            with contextlib.suppress(OSError), path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
                found = True
    for name, array in _find_arrays(policy, "", set(), 0):
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        found = True
    return digest.digest() if found else b""


def _is_data_file(path: Path) -> bool:
    installed = {sys.prefix, sys.base_prefix, *sysconfig.get_paths().values(), *site.getsitepackages()}
    resolved = os.path.realpath(path)
    folders = (*_IGNORED_FOLDERS, *(os.path.realpath(folder) for folder in installed))
    inside = any(resolved.startswith(folder + os.sep) for folder in folders)
    return not inside and path.suffix not in _IGNORED_SUFFIXES and Path(resolved).is_file()


def _find_arrays(value: Any, name: str, seen: set[int], depth: int) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Yield (name, array) of the arrays in a value, in the order of their names."""
    if id(value) in seen or depth > _MAX_DEPTH or isinstance(value, _WITHOUT_ARRAYS):
        return
    # Objects of this library hold nothing but what its code computes from options and files.
    if depth and is_library_class(type(value)):
        return
    seen.add(id(value))
    array = convert_array(value)
    if array is not None:
        yield name, array
        return
    parts: Mapping[Any, Any]
    if callable(getattr(value, "state_dict", None)):
        parts = value.state_dict()
    elif isinstance(value, Mapping):
        parts = value
    elif isinstance(value, (list, tuple)):
        parts = dict(enumerate(value))
    else:
        parts = getattr(value, "__dict__", {})
    for key in sorted(parts, key=str):
        yield from _find_arrays(parts[key], f"{name}.{key}", seen, depth + 1)


def convert_array(value: Any) -> np.ndarray[Any, Any] | None:
    """Convert an array or tensor to a NumPy array; return None for other values and arrays of objects."""
    if callable(getattr(value, "detach", None)):  # tensors of PyTorch
        value = value.detach().cpu()
        if str(getattr(value, "dtype", "")) == "torch.bfloat16":  # NumPy has no such type
            value = value.float()
    if not hasattr(value, "__array__") or not hasattr(value, "dtype"):
        return None
    array = np.asarray(value)
    return None if array.dtype.hasobject else array
