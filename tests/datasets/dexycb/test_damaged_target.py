"""Tests of imports to folders that have other files or cannot be written to.

Existing files are not changed, and no partly written files stay.
"""

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.dexycb.importer import ImportReport, import_dexycb
from handover_marl.datasets.dexycb.raw_files import read_sequence_names
from handover_marl.datasets.scene_files import CACHE_FOLDER
from handover_marl.errors import ResultsError
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.raw_files import RawScene, all_files, hand_poses, object_poses, write_mano
from tests.evaluation.deadline import ends_within

pytestmark = pytest.mark.slow

N_SCENES = 14
HANDS = f"assets/{SUBJECTS[0]}_right"


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with raw data `raw/`, models `mano/` and the result of their import `expected/`."""
    folder = tmp_path_factory.mktemp("given")
    write_mano(folder / "mano")
    for name in read_sequence_names()[SUBJECTS[0]][:N_SCENES]:
        RawScene(name=name).write(folder / "raw")
    imported(folder, folder / "expected")
    return folder


def imported(given: Path, out: Path) -> ImportReport:
    with ends_within(60):
        return import_dexycb(given / "raw", given / "mano", out, workers=1, progress=False)


def altered(path: Path) -> None:
    """Change one number of the motion in a pose file."""
    with np.load(path) as archive:
        arrays = {name: archive[name].copy() for name in archive.files}
    arrays["pose_m"][3, 0, 5] += 1e-6
    np.savez_compressed(path, **arrays)


def instead(put: Callable[[Path], object]) -> Callable[[Path], object]:
    def spoil(path: Path) -> None:
        path.unlink()
        put(path)

    return spoil


def sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 40)


def pointing_at(target: str) -> Callable[[Path], object]:
    return lambda path: path.symlink_to(target)


POSE, META = "pose", "meta"
#: Which of a scene's files is changed before the second import, and function that changes it, by kind.
SPOILS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "poses of other content": (POSE, altered),
    "half of the poses": (POSE, lambda path: path.write_bytes(path.read_bytes()[:500])),
    "poses that are empty": (POSE, lambda path: path.write_bytes(b"")),
    "a folder for poses": (POSE, instead(Path.mkdir)),
    "a link to nowhere for poses": (POSE, instead(pointing_at("nowhere.npz"))),
    "a link to itself for poses": (POSE, instead(lambda path: path.symlink_to(path.name))),
    "a pipe for poses": (POSE, instead(os.mkfifo)),
    "a terabyte for poses": (POSE, sparse),
    "meta of other content": (META, lambda path: path.write_text(path.read_text().replace("2, 5", "5, 2"))),
    "a link to nowhere for meta": (META, instead(pointing_at("nowhere.json"))),
    "a pipe for meta": (META, instead(os.mkfifo)),
    "a device for meta": (META, instead(pointing_at("/dev/zero"))),
    "a terabyte for meta": (META, sparse),
}


def file_of(out: Path, number: int, which: str) -> Path:
    return out / CACHE_FOLDER / f"{which}_{number:03d}.{'npz' if which == POSE else 'json'}"


def state(path: Path) -> tuple[int, int, int]:
    found = path.lstat()
    return found.st_mode, found.st_size, found.st_mtime_ns


def test_existing_files_are_checked_and_kept(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    imported(given, out)
    spoilt = {kind: file_of(out, number, which) for number, (kind, (which, _)) in enumerate(SPOILS.items())}
    for kind, path in spoilt.items():
        SPOILS[kind][1](path)
    before = {kind: state(path) for kind, path in spoilt.items()}
    listed = sorted(path.name for path in (out / CACHE_FOLDER).iterdir())
    found = imported(given, out)
    assert found.scenes == tuple(range(len(SPOILS), N_SCENES))
    for kind, path in spoilt.items():
        reported = [fault for fault in found.faults if f"{path} exists, but differs from the result" in fault]
        assert len(reported) == 1, kind
        assert state(path) == before[kind], kind
    assert sorted(path.name for path in (out / CACHE_FOLDER).iterdir()) == listed
    for path in spoilt.values():
        path.rmdir() if path.is_dir() else path.unlink()
    assert imported(given, out).scenes == tuple(range(N_SCENES))
    assert all_files(out) == all_files(given / "expected")


def refused(given: Path, out: Path, message: str) -> None:
    with pytest.raises(ResultsError, match=message) as caught:
        imported(given, out)
    assert str(out) in str(caught.value)


def test_invalid_target_folders(given: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / CACHE_FOLDER).write_text("mine")
    (tmp_path / "assets" / HANDS).mkdir(parents=True)
    (tmp_path / "assets" / HANDS / "mano.urdf").mkdir()
    refused(given, tmp_path / "file", r"cannot make the folder .*file")
    refused(given, tmp_path / "file" / "below", "cannot make the folder .*Not a directory")
    refused(given, tmp_path / "cache", f"cannot make the folder .*{CACHE_FOLDER} .*File exists")
    refused(given, tmp_path / "assets", r"mano\.urdf exists with other content")
    refused(given, Path("/proc/nowhere"), "cannot make the folder /proc/nowhere")
    assert (tmp_path / "file").read_text() == (tmp_path / "cache" / CACHE_FOLDER).read_text() == "mine"
    for folder in ("cache", "assets"):
        assert not list((tmp_path / folder).rglob("*.part"))


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder whose cache is a file system of 64 kB; skip the test where mounting is not permitted."""
    cache = tmp_path / "out" / CACHE_FOLDER
    cache.mkdir(parents=True)
    if os.system(f"mount -t tmpfs -o size=64k none {cache} 2>/dev/null"):
        pytest.skip("nothing may be mounted here")
    yield tmp_path / "out"
    os.system(f"umount {cache}")


def cached(out: Path) -> dict[str, bytes]:
    return {name: data for name, data in all_files(out).items() if name.startswith(CACHE_FOLDER)}


def check_partial(given: Path, out: Path) -> None:
    """Check that some but not all of the cached files exist and that they are complete."""
    found, expected = cached(out), cached(given / "expected")
    assert 0 < len(found) < len(expected)
    assert found.items() <= expected.items()


def test_full_disk(given: Path, mounted: Path) -> None:
    refused(given, mounted, r"cannot write .*\(No space left on device\).*free space")
    check_partial(given, mounted)
    os.system(f"mount -o remount,size=10m {mounted / CACHE_FOLDER}")
    assert imported(given, mounted).scenes == tuple(range(N_SCENES))
    assert all_files(mounted) == all_files(given / "expected")


def test_read_only_disk(given: Path, mounted: Path) -> None:
    os.system(f"mount -o remount,ro {mounted / CACHE_FOLDER}")
    refused(given, mounted, r"cannot write .*\(Read-only file system\)")
    assert not cached(mounted)
    os.system(f"mount -o remount,rw,size=10m {mounted / CACHE_FOLDER}")
    assert imported(given, mounted).scenes == tuple(range(N_SCENES))


@pytest.mark.parametrize(("code", "message"), [(errno.EROFS, "Read"), (errno.EDQUOT, "quota"), (errno.EIO, "error")])
def test_failing_writes(given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, message: str) -> None:
    """An import whose first write fails reports the error and leaves no file, and the next import is complete.

    Unlike the tests of a full or read-only disk, this test also runs where mounting is not permitted.
    """

    def fail(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        refused(given, tmp_path / "out", f"cannot write .*{message}")
    assert not all_files(tmp_path / "out")
    assert imported(given, tmp_path / "out").scenes == tuple(range(N_SCENES))


def test_limited_file_size(given: Path, tmp_path: Path) -> None:
    """An import reports a file that exceeds a limit of the file size, and keeps the complete scenes.

    The limit acts like a quota: the system stops the write of one long recording's file half-way.
    """
    raw, out, limit = tmp_path / "raw", tmp_path / "out", 200_000
    for number, name in enumerate(read_sequence_names()[SUBJECTS[0]][:3]):
        n_keyframes = 72 if number == 2 else 6
        RawScene(name=name, objects=object_poses(n_keyframes, 2), hand=hand_poses(n_keyframes)).write(raw)
    # Some models are larger than the limit, so they are written before without it.
    import_dexycb(raw, given / "mano", out, scenes=[0], workers=1, progress=False)
    code = "import sys; from handover_marl.cli import main; sys.exit(main(sys.argv[1:]))"
    options = ["--dexycb", raw, "--mano", given / "mano", "--out", out, "--workers", "1", "--no-progress"]
    done = subprocess.run(
        [sys.executable, "-c", code, "import", *map(str, options)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "pose_002.npz (File too large)" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in (out / CACHE_FOLDER).iterdir()) == [
        *("meta_000.json", "meta_001.json", "pose_000.npz", "pose_001.npz")
    ]
    assert import_dexycb(raw, given / "mano", out, workers=1, progress=False).scenes == (0, 1, 2)
    assert file_of(out, 2, POSE).stat().st_size > limit
