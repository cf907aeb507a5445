"""Equality of nested results, of folders and of scenes, for tests."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.datasets.dataset import Scene


def assert_equal(first: Any, second: Any) -> None:
    """Check that nested containers have the same types and keys, and that all their arrays and numbers are equal."""
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal(first[key], second[key])
    elif isinstance(first, (list, tuple)) or (isinstance(first, np.ndarray) and first.dtype == object):
        for one, other in zip(first, second, strict=True):
            assert_equal(one, other)
    else:
        np.testing.assert_array_equal(first, second, strict=True)


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder, also of hidden ones, by relative path."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def hash_scene(scene: Scene) -> str:
    """Return the first digits of a hash of a scene's motion and description."""
    info = repr(scene.info).replace(", side=", f", subject={scene.info.subject!r}, side=")
    content = scene.object_dof.tobytes() + scene.hand_dof.tobytes() + info.encode()
    return hashlib.sha256(content).hexdigest()[:16]
