"""Tests of imports with damaged recordings.

Every kind of damage is reported in one sentence, all other recordings are imported correctly, and an import of
undamaged data completes the folder. One dataset has undamaged recordings and one recording for each kind of damage.
"""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from handover_marl.datasets.dexycb.importer import ImportReport, import_dexycb
from handover_marl.datasets.dexycb.raw_files import read_sequence_names
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.damaged_recordings import DAMAGES, HARMLESS, Files
from tests.datasets.dexycb.raw_files import RawScene, all_files, extrinsics_file, mano_file, write_mano
from tests.evaluation.deadline import ends_within

pytestmark = pytest.mark.slow

SUBJECT = 6
WHOLE = 4  # number of undamaged recordings at the beginning, of both hands
KINDS = [*DAMAGES, *HARMLESS]
RANKS = {kind: WHOLE + number for number, kind in enumerate(KINDS)}
NAMES = read_sequence_names()[SUBJECTS[SUBJECT]]


@dataclass(frozen=True)
class Runs:
    """Results of the imports.

    Attributes:
        found: Report of the import of the damaged dataset.
        files: Content of the data folder's files after that import, by path.
        again: Report of the import of the undamaged dataset into the same folder.
        files_again: Content of the files after that second import, by path.
        expected: Content of the files that the undamaged dataset gives in an empty folder, by path.
    """

    found: ImportReport
    files: dict[str, bytes]
    again: ImportReport
    files_again: dict[str, bytes]
    expected: dict[str, bytes]


def write_dataset(raw: Path) -> None:
    """Write an undamaged recording for each kind and `WHOLE` more, each with its own calibration."""
    for rank in range(WHOLE + len(KINDS)):
        name = NAMES[rank]
        RawScene(
            subject=SUBJECT,
            name=name,
            side="left" if rank % 2 else "right",
            extrinsics=name,
            mano=f"{name}_subject-07",
        ).write(raw)


def files_of(raw: Path, rank: int) -> Files:
    name = NAMES[rank]
    folder = raw / SUBJECTS[SUBJECT] / name
    return Files(
        meta=folder / "meta.yml",
        pose=folder / "pose.npz",
        extrinsics=extrinsics_file(raw, name),
        mano=mano_file(raw, f"{name}_subject-07"),
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("damage")
    mano, whole, raw = write_mano(folder / "mano"), folder / "whole", folder / "raw"
    write_dataset(whole)
    shutil.copytree(whole, raw)
    for kind, damage in [*((kind, damage) for kind, (damage, _) in DAMAGES.items()), *HARMLESS.items()]:
        damage(files_of(raw, RANKS[kind]))
    with pytest.MonkeyPatch.context() as patch, ends_within(120):
        patch.chdir(folder)
        expected = folder / "expected"
        import_dexycb(whole, mano, expected, workers=2, progress=False)
        found = import_dexycb(raw, mano, folder / "out", workers=2, progress=False)
        files = all_files(folder / "out")
        again = import_dexycb(whole, mano, folder / "out", workers=2, progress=False)
    assert not list(folder.rglob("was_run")), "code of the dataset was executed"
    return Runs(found, files, again, all_files(folder / "out"), all_files(expected))


def find_scene_assets(files: dict[str, bytes], rank: int) -> dict[str, bytes]:
    scene = 100 * SUBJECT + rank
    return {name: data for name, data in files.items() if re.search(rf"_{scene}\.(json|npz)$", name)}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damage(runs: Runs, kind: str) -> None:
    rank, message = RANKS[kind], DAMAGES[kind][1]
    reported = [fault for fault in runs.found.faults if NAMES[rank] in fault]
    assert len(reported) == 1
    assert re.search(message, reported[0])
    assert len(reported[0]) < 700
    assert reported[0].isprintable()
    assert 100 * SUBJECT + rank not in runs.found.scenes
    assert not find_scene_assets(runs.files, rank), "nothing of it is written"
    # The import of the undamaged dataset adds the scene.
    assert not any(NAMES[rank] in fault for fault in runs.again.faults)
    assert len(find_scene_assets(runs.files_again, rank)) == 2
    assert find_scene_assets(runs.files_again, rank) == find_scene_assets(runs.expected, rank)


@pytest.mark.parametrize("kind", HARMLESS)
def test_undamaged_files_that_are_not_read(runs: Runs, kind: str) -> None:
    rank = RANKS[kind]
    assert not any(NAMES[rank] in fault for fault in runs.found.faults)
    assert len(find_scene_assets(runs.files, rank)) == 2
    assert find_scene_assets(runs.files, rank) == find_scene_assets(runs.expected, rank)


def test_other_scenes_are_imported(runs: Runs) -> None:
    whole = [*range(WHOLE), *(RANKS[kind] for kind in HARMLESS)]
    assert runs.found.scenes == tuple(100 * SUBJECT + rank for rank in whole)
    assert runs.found.hands == (f"{SUBJECTS[SUBJECT]}_right", f"{SUBJECTS[SUBJECT]}_left")
    damaged = set().union(*(find_scene_assets(runs.expected, RANKS[kind]) for kind in DAMAGES))
    assert runs.files == {name: data for name, data in runs.expected.items() if name not in damaged}
    # Further faults are the nine missing subjects and the missing recordings of this subject.
    assert len(runs.found.faults) == len(DAMAGES) + 9 + 1


def test_next_import_completes_the_folder(runs: Runs) -> None:
    assert runs.again.scenes == tuple(100 * SUBJECT + rank for rank in range(WHOLE + len(KINDS)))
    assert len(runs.again.faults) == 9 + 1
    assert runs.files_again == runs.expected
