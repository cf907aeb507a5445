import shutil
from pathlib import Path

import pytest

from handover_marl.datasets.importing.raw_layout import find_sequences
from handover_marl.errors import DataNotFoundError
from handover_marl.models.ycb import SUBJECTS


def write_subject(raw: Path, number: int, n: int = 100) -> list[Path]:
    """Recordings of a subject, their files empty."""
    folders = [raw / SUBJECTS[number] / f"{SUBJECTS[number][:8]}_{9000 + 7 * k:06d}" for k in range(n)]
    for folder in reversed(folders):
        folder.mkdir(parents=True)
        (folder / "meta.yml").touch()
        (folder / "pose.npz").touch()
    return folders


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Subjects 0 and 3 complete, no other."""
    (tmp_path / "calibration").mkdir()
    write_subject(tmp_path, 0)
    write_subject(tmp_path, 3)
    return tmp_path


def test_scene_numbers_are_ranks(raw: Path) -> None:
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences] == [*range(100), *range(300, 400)]
    assert not layout.ignored
    sequence = layout.sequences[102]
    assert sequence.name == "20200903-subject-04/20200903_009014"
    assert sequence.folder == raw / sequence.name
    assert sequence.subject == "20200903-subject-04"
    assert sequence.calibration == raw / "calibration"
    missing = [subject for number, subject in enumerate(SUBJECTS) if number not in (0, 3)]
    assert len(layout.missing) == len(missing) == 8
    for subject, sentence in zip(missing, layout.missing, strict=True):
        assert f"{subject} is missing; expand DexYCB's {subject}.tar.gz" in sentence


@pytest.mark.parametrize("n", [0, 1, 99])
def test_too_few_recordings(raw: Path, n: int) -> None:
    for folder in sorted((raw / SUBJECTS[0]).iterdir())[n:]:
        shutil.rmtree(folder)
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences] == list(range(300, 400))
    assert f"{SUBJECTS[0]} holds {n} recordings instead of 100" in layout.missing[0]
    assert "complete the download" in layout.missing[0]


def test_too_many_recordings(raw: Path) -> None:
    (raw / SUBJECTS[3] / "20200903_235959").mkdir()
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences] == list(range(100))
    assert any(f"{SUBJECTS[3]} holds 101 recordings" in text and "remove" in text for text in layout.missing)


@pytest.mark.parametrize("instead", [False, True])
def test_strange_folders(raw: Path, instead: bool) -> None:
    """Also in the place of a recording, where the number would be right by chance."""
    (raw / SUBJECTS[0] / "backup").mkdir()
    if instead:
        shutil.rmtree(min((raw / SUBJECTS[0]).iterdir()))
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences] == list(range(300, 400))
    assert "holds 'backup', which no recording is called; remove" in layout.missing[0]


def test_strange_files_are_passed_over(raw: Path) -> None:
    (raw / SUBJECTS[0] / "00_README.txt").touch()
    (raw / SUBJECTS[0] / ".DS_Store").touch()
    (raw / SUBJECTS[0] / ".cache").mkdir()
    for name in "abc":
        (raw / SUBJECTS[3] / name).touch()
    (raw / SUBJECTS[3] / "d").touch()
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences] == [*range(100), *range(300, 400)]
    assert len(layout.ignored) == 2
    assert "'.DS_Store', '.cache', '00_README.txt'" in layout.ignored[0]
    assert "'a', 'b', 'c' and 1 more" in layout.ignored[1]


def test_recordings_without_their_files(raw: Path) -> None:
    folders = sorted((raw / SUBJECTS[0]).iterdir())
    (folders[4] / "pose.npz").unlink()
    (folders[5] / "pose.npz").unlink()
    (folders[5] / "meta.yml").unlink()
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences][:5] == [0, 1, 2, 3, 6]
    assert f"{folders[4]} lacks pose.npz; expand" in layout.missing[0]
    assert f"{folders[5]} lacks meta.yml and pose.npz; expand" in layout.missing[1]


def test_missing_calibration(raw: Path) -> None:
    (raw / "calibration").rmdir()
    layout = find_sequences(raw)
    assert "calibration is missing" in layout.missing[0]
    assert len(layout.sequences) == 200


@pytest.mark.parametrize("name", ["nowhere", "file", "empty"])
def test_no_raw_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataNotFoundError, match=rf"{name} is no raw DexYCB folder.*calibration/"):
        find_sequences(tmp_path / name)


def test_a_subject_that_is_a_file(raw: Path) -> None:
    (raw / SUBJECTS[1]).touch()
    assert any(f"{SUBJECTS[1]} cannot be read" in text for text in find_sequences(raw).missing)


def test_links_to_folders_count(raw: Path) -> None:
    moved = raw.with_name(f"{raw.name}-elsewhere")
    shutil.move(raw / SUBJECTS[0], moved)
    (raw / SUBJECTS[0]).symlink_to(moved)
    assert len(find_sequences(raw).sequences) == 200
