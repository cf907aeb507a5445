"""Tests of hashes of the library's files, of an author's package, and of weights."""

import collections.abc
import subprocess
import sys
import sysconfig
import time
from pathlib import Path
from types import ModuleType

import pytest

from handover_marl.policies.hashing.source_hash import hash_library, hash_packages, hash_policy
from handover_marl.receivers import Receiver
from handover_marl.receivers.hold import HoldReceiver


class Mine(HoldReceiver):
    name = "mine"


def test_parts() -> None:
    parts = hash_policy(HoldReceiver).split(".")
    assert parts[0] == hash_library()
    assert len(parts) == 2
    assert all(len(part) == 8 for part in parts)
    with_weights = hash_policy(HoldReceiver, weights=b"1").split(".")
    assert with_weights[:2] == parts
    assert hash_policy(HoldReceiver, weights=b"2") != hash_policy(HoldReceiver, weights=b"1")
    assert hash_policy(HoldReceiver, state=b"1").split(".")[1] != parts[1]


def test_packages_of_authors() -> None:
    assert hash_packages(HoldReceiver) == hash_packages(Receiver)
    assert hash_packages(Mine) != hash_packages(HoldReceiver)


def test_the_standard_library_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    library = Path(sysconfig.get_path("stdlib"))

    class Mixed(Mine, collections.abc.Sized, metaclass=type(Mine)):
        pass

    expected = hash_policy(Mixed)
    stat = Path.stat

    def refuse(path: Path, **options: bool) -> object:
        if path.parent == library:
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", refuse)
    assert hash_policy(Mixed) == expected
    # While a profiler runs a script, the file of the main module is that of the profiler.
    profiled = type("Profiled", (Mine,), {"__module__": "profiled_script"})
    monkeypatch.setitem(sys.modules, "profiled_script", ModuleType("profiled_script"))
    expected = hash_policy(profiled)
    sys.modules["profiled_script"].__file__ = str(library / "cProfile.py")
    assert hash_policy(profiled) == expected


def test_hashing_imports_nothing_and_is_quick() -> None:
    """Hashing the library takes less than 1 s, and imports neither further modules of the library nor MuJoCo."""
    code = (
        "import sys, handover_marl.policies.hashing.source_hash as source_hash\n"
        "before = set(sys.modules)\n"
        "source_hash.hash_library()\n"
        "print(sorted(name for name in set(sys.modules) - before if name.startswith(('handover_marl', 'mujoco'))))\n"
    )
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == "[]"
    hash_library.cache_clear()
    started = time.perf_counter()
    hash_library()
    assert time.perf_counter() - started < 1.0
