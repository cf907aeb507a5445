"""Tests of imports with missing, superfluous or moved recordings.

The other recordings keep their scene numbers, and an import of the complete data completes the folder.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from handover_marl.datasets.dexycb.importer import ImportReport, import_dexycb
from handover_marl.datasets.dexycb.raw_files import read_sequence_names
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.raw_files import RawScene, all_files, write_mano
from tests.evaluation.deadline import ends_within

pytestmark = pytest.mark.slow

#: The first subject has some of DexYCB's recordings, the other one a hundred recordings with other names.
DEXYCBS, OTHER = SUBJECTS[0], SUBJECTS[3]
NAMES = read_sequence_names()[DEXYCBS][4:8]
OTHER_NAMES = [f"20200903_{100000 + rank}" for rank in range(100)]
SCENES = (4, 5, 6, 7, 300, 301, 399)
FEW, MANY = (4, 5, 6, 7), (300, 301, 399)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with raw data `raw/`, models `mano/` and the result of their import `expected/`."""
    folder = tmp_path_factory.mktemp("given")
    write_mano(folder / "mano")
    for name in NAMES:
        RawScene(subject=0, name=name).write(folder / "raw")
    for rank, name in enumerate(OTHER_NAMES):
        RawScene(subject=3, name=name, side="left" if rank % 2 else "right").write(folder / "raw")
    assert imported(folder, folder / "raw", folder / "expected").scenes == SCENES
    return folder


def imported(given: Path, raw: Path, out: Path) -> ImportReport:
    with ends_within(60):
        return import_dexycb(raw, given / "mano", out, scenes=SCENES, workers=1, progress=False)


def gone(name: str) -> Callable[[Path], object]:
    return lambda raw: shutil.rmtree(raw / name)


def loop(name: str) -> Callable[[Path], object]:
    def put(raw: Path) -> None:
        shutil.rmtree(raw / name)
        (raw / name).symlink_to(Path(name).name)

    return put


def moved(name: str) -> Callable[[Path], object]:
    """Return a damage that moves a folder out of the raw data and puts a link to it in its place."""

    def put(raw: Path) -> None:
        (raw / name).rename(raw.parent / "elsewhere")
        (raw / name).symlink_to(raw.parent / "elsewhere")

    return put


def a_file(name: str) -> Callable[[Path], object]:
    def put(raw: Path) -> None:
        shutil.rmtree(raw / name)
        (raw / name).touch()

    return put


def one_more(name: str) -> Callable[[Path], object]:
    return lambda raw: shutil.copytree(raw / DEXYCBS / NAMES[0], raw / name)


UNKNOWN = "so that their scene numbers, which are ranks, are unknown"
#: Function that damages the data, imported scenes, subjects with hand models, pattern of the fault, by kind.
DAMAGES: dict[str, tuple[Callable[[Path], object], tuple[int, ...], tuple[str, ...], str]] = {
    "no calibration": (gone("calibration"), (), (), "calibration is missing, without which no recording"),
    "a subject that is missing": (gone(OTHER), FEW, (DEXYCBS,), rf"{OTHER} is missing; expand"),
    "a subject that is a file": (a_file(OTHER), FEW, (DEXYCBS,), rf"{OTHER} cannot be read \(Not a directory\)"),
    "a subject that is a link to itself": (loop(OTHER), FEW, (DEXYCBS,), rf"{OTHER} cannot be read"),
    "one of DexYCB's missing": (
        gone(f"{DEXYCBS}/{NAMES[1]}"),
        (4, 6, 7, *MANY),
        (DEXYCBS, OTHER),
        f"lacks .*and 94 more, 97 of 100 recordings; expand DexYCB's {DEXYCBS}",
    ),
    "one of DexYCB's that is a link to itself": (
        loop(f"{DEXYCBS}/{NAMES[1]}"),
        (4, 6, 7, *MANY),
        (DEXYCBS, OTHER),
        "97 of 100 recordings",
    ),
    "99 recordings": (gone(f"{OTHER}/{OTHER_NAMES[50]}"), FEW, (DEXYCBS,), f"holds 99 .*{UNKNOWN}; complete"),
    "101 recordings": (one_more(f"{OTHER}/20200903_235959"), FEW, (DEXYCBS,), f"holds 101 .*{UNKNOWN}; remove"),
    "a copy among DexYCB's": (
        one_more(f"{DEXYCBS}/{NAMES[0]} (copy)"),
        SCENES,
        (DEXYCBS, OTHER),
        r"holds '.*\(copy\)' beside DexYCB's recordings, which was left out",
    ),
    "a copy among others": (one_more(f"{OTHER}/copy"), FEW, (DEXYCBS,), "holds 'copy', which no recording is called"),
    "the first recording without poses": (
        lambda raw: (raw / OTHER / OTHER_NAMES[0] / "pose.npz").unlink(),
        (*FEW, 301, 399),
        (DEXYCBS,),
        f"hands of {OTHER}: .* lacks its first recording",
    ),
    "a subject on another disk": (moved(OTHER), SCENES, (DEXYCBS, OTHER), f"{SUBJECTS[1]} is missing"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_layout(given: Path, tmp_path: Path, kind: str) -> None:
    damage, scenes, subjects, message = DAMAGES[kind]
    raw, out = tmp_path / "raw", tmp_path / "out"
    shutil.copytree(given / "raw", raw)
    damage(raw)
    found = imported(given, raw, out)
    assert found.scenes == scenes
    assert found.hands == tuple(f"{subject}_{side}" for subject in subjects for side in ("right", "left"))
    assert len([fault for fault in found.faults if re.search(message, fault)]) == 1
    assert not found.is_complete
    files, expected = all_files(out), all_files(given / "expected")
    assert files.items() <= expected.items()
    assert sum("dex-ycb-cache" in name for name in files) == 2 * len(scenes)
    # An import of the undamaged data completes the folder.
    assert imported(given, given / "raw", out).scenes == SCENES
    assert all_files(out) == expected
