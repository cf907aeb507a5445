"""Tests of imports that are killed or interrupted.

The files that they wrote are complete, none of their processes stays alive, and the next import adds what is missing.
"""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from handover_marl.datasets.dexycb.importer import import_dexycb
from handover_marl.datasets.dexycb.raw_files import read_sequence_names
from handover_marl.datasets.scene_files import CACHE_FOLDER
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.raw_files import RawScene, all_files, hand_poses, object_poses, write_mano

pytestmark = pytest.mark.slow

N_SCENES = 24
N_KEYS = 24  # number for which an import takes long enough to be killed half-way
_CODE = """
import signal, sys
from handover_marl.cli import main
# Tests that run in the background have Ctrl-C ignored, and so would this.
signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == "__main__":
    sys.exit(main(["import", *sys.argv[1:]]))
"""


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with raw data `raw/`, models `mano/` and the result of their import `expected/`."""
    folder = tmp_path_factory.mktemp("given")
    write_mano(folder / "mano")
    for name in read_sequence_names()[SUBJECTS[2]][:N_SCENES]:
        RawScene(subject=2, name=name, objects=object_poses(N_KEYS, 2), hand=hand_poses(N_KEYS)).write(folder / "raw")
    import_dexycb(folder / "raw", folder / "mano", folder / "expected", workers=1, progress=False)
    return folder


@pytest.fixture
def started(given: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Yield a process that runs the import to `out/` with two workers."""
    options = {"--dexycb": given / "raw", "--mano": given / "mano", "--out": tmp_path / "out", "--workers": 2}
    script = tmp_path / "script.py"
    script.write_text(_CODE)
    arguments = [str(part) for option in options.items() for part in option]
    with subprocess.Popen(
        [sys.executable, str(script), *arguments, "--no-progress"], stderr=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.kill()


def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.01)


def cached(out: Path) -> list[Path]:
    return list((out / CACHE_FOLDER).glob("meta_*"))


def leave_half(out: Path) -> None:
    """Write a temporary file, as it remains of a worker that is killed while it writes a file."""
    (out / CACHE_FOLDER / ".pose_205.npz.5rpomakf.part").write_bytes(b"half")


def workers(parent: int) -> list[int]:
    """Return the process ids of the workers of an import."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [int(child) for child in children if b"popen_loky" in Path(f"/proc/{child}/cmdline").read_bytes()]


def runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def check_half_way(given: Path, out: Path) -> None:
    """Check that only some of the files exist and that all but the temporary ones are complete."""
    found = {name: data for name, data in all_files(out).items() if not name.endswith(".part")}
    expected = all_files(given / "expected")
    assert 0 < len(found) < len(expected)
    assert found.items() <= expected.items()


def check_goes_on(given: Path, out: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in cached(out)}
    again = import_dexycb(given / "raw", given / "mano", out, workers=1, progress=False)
    assert len(again.scenes) == N_SCENES
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert all_files(out) == all_files(given / "expected"), "also no temporary file"


@pytest.mark.parametrize("n_done", [1, 12])
def test_killed_import(given: Path, tmp_path: Path, started: subprocess.Popen[str], n_done: int) -> None:
    out = tmp_path / "out"
    until(lambda: len(cached(out)) >= n_done)
    processes = workers(started.pid)
    assert len(processes) == 2
    started.kill()
    assert started.wait() == -signal.SIGKILL
    until(lambda: not any(map(runs, processes)), 20.0)
    check_half_way(given, out)
    check_goes_on(given, out)


def test_import_killed_while_writing_models(given: Path, tmp_path: Path, started: subprocess.Popen[str]) -> None:
    out = tmp_path / "out"
    until(lambda: list((out / "assets").glob("*_right/meshes/visual/*.obj")))
    started.kill()
    started.wait()
    check_half_way(given, out)
    check_goes_on(given, out)


def test_killed_worker(given: Path, tmp_path: Path, started: subprocess.Popen[str]) -> None:
    out = tmp_path / "out"
    until(lambda: len(cached(out)) >= 5)
    processes = workers(started.pid)
    os.kill(processes[0], signal.SIGKILL)
    leave_half(out)
    _, reported = started.communicate(timeout=60)
    assert started.returncode == 0
    assert re.search("a worker process died .* while scenes: .*; retrying", reported)
    assert not any(map(runs, processes))
    assert all_files(out) == all_files(given / "expected")


def test_worker_killed_at_its_start(given: Path, tmp_path: Path, started: subprocess.Popen[str]) -> None:
    until(lambda: workers(started.pid))
    os.kill(workers(started.pid)[0], signal.SIGKILL)
    _, reported = started.communicate(timeout=60)
    assert started.returncode == 0
    assert re.search("a worker process died .* while scenes: .*; retrying", reported)
    assert all_files(tmp_path / "out") == all_files(given / "expected")


def test_script_without_main_guard(given: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    paths = (str(given / "raw"), str(given / "mano"), str(tmp_path / "out"))
    script.write_text(
        "from handover_marl.datasets.dexycb.importer import import_dexycb\n"
        f"import_dexycb(*{paths!r}, workers=2, progress=False)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=60, cwd=tmp_path
    )
    assert done.returncode == 0
    assert all_files(tmp_path / "out") == all_files(given / "expected")


def test_interrupted_import(given: Path, tmp_path: Path, started: subprocess.Popen[str]) -> None:
    out = tmp_path / "out"
    until(lambda: len(cached(out)) >= 5)
    processes = workers(started.pid)
    leave_half(out)
    started.send_signal(signal.SIGINT)
    started.communicate(timeout=60)
    assert started.returncode == 130
    assert not any(map(runs, processes))
    check_half_way(given, out)
    assert not list(out.rglob("*.part"))
    check_goes_on(given, out)


def test_worker_killed_while_writing_a_file(given: Path, tmp_path: Path) -> None:
    """The next import removes the temporary files of a process that was killed while it wrote files."""
    out = tmp_path / "out"
    import_dexycb(given / "raw", given / "mano", out, scenes=[200], workers=1, progress=False)
    code = (
        "import os, sys, signal, pathlib; from handover_marl.execution import files; "
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL); "
        "files.create_exclusively(pathlib.Path(sys.argv[1]), bytes(1000))"
    )
    for path in (out / CACHE_FOLDER / "pose_201.npz", out / "assets" / f"{SUBJECTS[2]}_left" / "mano.urdf"):
        path.unlink(missing_ok=True)
        subprocess.run([sys.executable, "-c", code, str(path)], check=False)
        assert len(list(path.parent.glob(f".{path.name}.*.part"))) == 1
    check_goes_on(given, out)
