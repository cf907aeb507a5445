import errno
import os
import re
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.datasets.dexycb.raw_files import find_sequences, read_sequence_names
from handover_marl.errors import DataNotFoundError
from handover_marl.geometry.ycb import SUBJECTS


def write_subject(raw: Path, number: int, n: int = 100) -> list[Path]:
    """Create recordings of a subject with empty files, and return their folders in the order of their names."""
    folders = [raw / SUBJECTS[number] / f"{SUBJECTS[number][:8]}_{9000 + 7 * k:06d}" for k in range(n)]
    for folder in reversed(folders):
        folder.mkdir(parents=True)
        (folder / "meta.yml").touch()
        (folder / "pose.npz").touch()
    return folders


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Return a raw folder with all recordings of the subjects 0 and 3 and of no other subject."""
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
def test_unknown_folders(raw: Path, instead: bool) -> None:
    """A subject with an unknown folder is left out, even if it has 100 folders.

    With `instead`, the unknown folder replaces a recording.
    """
    (raw / SUBJECTS[0] / "backup").mkdir()
    if instead:
        shutil.rmtree(min((raw / SUBJECTS[0]).iterdir()))
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences] == list(range(300, 400))
    assert "holds 'backup', which no recording is called; remove" in layout.missing[0]


def test_unknown_files_are_ignored(raw: Path) -> None:
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
    assert "calibration is missing, without which no recording can be imported" in layout.missing[0]
    assert len(layout.missing) == 9
    assert not layout.sequences


@pytest.mark.parametrize("name", ["nowhere", "file", "empty"])
def test_no_raw_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataNotFoundError, match=rf"{name} is no raw DexYCB folder.*calibration/"):
        find_sequences(tmp_path / name)


def test_a_subject_that_is_a_file(raw: Path) -> None:
    (raw / SUBJECTS[1]).touch()
    assert any(f"{SUBJECTS[1]} cannot be read" in text for text in find_sequences(raw).missing)


def test_links_to_folders_are_accepted(raw: Path) -> None:
    moved = raw.with_name(f"{raw.name}-elsewhere")
    shutil.move(raw / SUBJECTS[0], moved)
    (raw / SUBJECTS[0]).symlink_to(moved)
    assert len(find_sequences(raw).sequences) == 200


def write_known(raw: Path, number: int, names: Iterable[str]) -> None:
    """Create recordings with these names and empty files, and an empty calibration folder."""
    (raw / "calibration").mkdir(exist_ok=True)
    for name in names:
        folder = raw / SUBJECTS[number] / name
        folder.mkdir(parents=True)
        (folder / "meta.yml").touch()
        (folder / "pose.npz").touch()


def test_sequence_names() -> None:
    names = [f"{subject}/{name}" for subject in SUBJECTS for name in read_sequence_names()[subject]]
    assert len(set(names)) == 1000
    assert names == sorted(names)
    assert all(re.fullmatch(r"(\d{8})-subject-\d\d/\1_[0-2]\d[0-5]\d[0-5]\d", name) for name in names)
    assert names[0] == "20200709-subject-01/20200709_141754"
    assert names[-1] == "20201022-subject-10/20201022_114909"


@pytest.mark.parametrize("number", range(10))
def test_official_names_have_the_same_number_by_rank_and_by_list(tmp_path: Path, number: int) -> None:
    names = read_sequence_names()[SUBJECTS[number]]
    write_known(tmp_path, number, names)
    layout = find_sequences(tmp_path)
    by_rank = [(100 * number + rank, f"{SUBJECTS[number]}/{name}") for rank, name in enumerate(sorted(names))]
    assert [(sequence.scene_id, sequence.name) for sequence in layout.sequences] == by_rank
    assert not any("holds" in text or "lacks" in text for text in layout.missing)


@given(ranks=st.sets(st.integers(0, 99), min_size=1, max_size=100))
@settings(max_examples=20)
def test_parts_of_dexycb_have_the_official_numbers(ranks: set[int]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        names = read_sequence_names()[SUBJECTS[6]]
        write_known(Path(folder), 6, [names[rank] for rank in ranks])
        layout = find_sequences(Path(folder))
    assert [(one.scene_id - 600, one.folder.name) for one in layout.sequences] == [
        (rank, names[rank]) for rank in sorted(ranks)
    ]
    reported = [text for text in layout.missing if "lacks" in text]
    assert len(reported) == (len(ranks) < 100)
    for text in reported:
        first = min(set(range(100)) - ranks)
        assert f"{SUBJECTS[6]} lacks '{names[first]}'" in text
        assert f"{100 - len(ranks)} of 100 recordings; expand DexYCB's {SUBJECTS[6]}.tar.gz again" in text


@pytest.mark.parametrize("stranger", ["backup", "20200813_000000", "20200709_141754"])
@pytest.mark.parametrize("missing", [0, 1])
def test_unknown_recordings_beside_dexycbs(tmp_path: Path, stranger: str, missing: int) -> None:
    """A recording with an unknown name is left out beside DexYCB's recordings, which keep their scene numbers.

    With `missing`, there are 100 recordings, and their ranks would be wrong scene numbers.
    """
    names = read_sequence_names()[SUBJECTS[1]]
    write_known(tmp_path, 1, [stranger, *names[missing:]])
    layout = find_sequences(tmp_path)
    assert [sequence.scene_id for sequence in layout.sequences] == list(range(100 + missing, 200))
    assert any(f"holds '{stranger}' beside DexYCB's recordings, which was left out" in text for text in layout.missing)


def test_single_official_names_are_ignored(tmp_path: Path) -> None:
    names = [f"20200709_{90000 + rank:06d}" for rank in range(97)]
    write_known(tmp_path, 0, [*names, *read_sequence_names()[SUBJECTS[0]][20:23]])
    assert [sequence.scene_id for sequence in find_sequences(tmp_path).sequences] == list(range(100))
    shutil.rmtree(tmp_path / SUBJECTS[0] / names[5])
    layout = find_sequences(tmp_path)
    assert not layout.sequences
    assert "holds 99 recordings instead of 100" in layout.missing[0]


def test_unreadable_folders(raw: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders that cannot be read are reported.

    The test simulates the system's error, since root may read every folder.
    """
    closed = raw / SUBJECTS[0] / "20200709_009007"
    stat = Path.stat

    def refuse(path: Path, **options: bool) -> os.stat_result:
        if path.parent == closed or path.parent.name == "closed":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", refuse)
    layout = find_sequences(raw)
    assert [sequence.scene_id for sequence in layout.sequences][:2] == [0, 2]
    assert any(
        "20200709_009007 cannot be read (Permission denied); check its rights" in text for text in layout.missing
    )
    with pytest.raises(DataNotFoundError, match="no raw DexYCB folder"):
        find_sequences(raw / "closed" / "dex-ycb")
