"""Tests of reading archives from untrusted sources: links and paths outside are never read."""

import io
import os
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from handover_marl.datasets.dexycb import stand_ins
from handover_marl.datasets.dexycb.stand_ins import find_plain_files, open_folder
from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError

CONTENT = {"assets/a.obj": b"v 0 0 0\n", "assets/grasps/b.npy": b"\x93NUMPY", "README": b""}


def tar(path: Path, mode: str, *extra: tarfile.TarInfo, content: Mapping[str, bytes] = CONTENT) -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, data in content.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
        for entry in extra:
            archive.addfile(entry)
    return path


def zipped(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in CONTENT.items():
            archive.writestr(name, content)
    return path


def folder(path: Path) -> Path:
    for name, content in CONTENT.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def contents(source: Path) -> dict[str, bytes]:
    with open_folder(source) as found:
        return {str(path.relative_to(found)): path.read_bytes() for path in find_plain_files(found)}


def test_files_are_read_from_folders_and_archives(tmp_path: Path) -> None:
    for number, mode in enumerate(("w", "w:gz")):
        assert contents(tar(tmp_path / f"archive {number}", mode)) == CONTENT
    assert contents(zipped(tmp_path / "a.zip")) == CONTENT
    source = folder(tmp_path / "unpacked")
    (source / "assets/link.obj").symlink_to("/etc/passwd")
    (source / "assets/more").symlink_to("/etc")
    os.mkfifo(source / "assets/pipe.obj")
    assert contents(source) == CONTENT, "links are ignored"


def test_archives_that_unpack_to_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stand_ins, "MAX_UNPACKED_BYTES", sum(map(len, CONTENT.values())) - 1)
    for source in (tar(tmp_path / "a.tar.gz", "w:gz"), zipped(tmp_path / "a.zip")):
        with pytest.raises(DataFormatError, match="unpacks to more than"):
            contents(source)


def link(name: str, kind: bytes, target: str) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname = kind, target
    return entry


@pytest.mark.parametrize(
    "entry",
    [
        link("assets/x", tarfile.SYMTYPE, "/etc/passwd"),
        link("assets/x", tarfile.LNKTYPE, "/etc/passwd"),
        link("assets/x", tarfile.FIFOTYPE, ""),
        tarfile.TarInfo("assets/../../x"),
    ],
)
def test_unsafe_entries_are_refused(entry: tarfile.TarInfo, tmp_path: Path) -> None:
    source = tar(tmp_path / "a.tar.gz", "w:gz", entry)
    with pytest.raises(UnsafeFileError, match="refused to unpack"):
        contents(source)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tar.gz"]


def test_other_files_as_archives(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name in ("nothing.tar.gz", "pipe"):
        with pytest.raises(DataNotFoundError, match="must be a folder or an archive"):
            contents(tmp_path / name)
    whole = zipped(tmp_path / "a.zip").read_bytes()
    for text in (b"<html>not found</html>", whole[:-30], whole.replace(b"v 0 0 0", b"v 1 0 0")):
        (tmp_path / "a.zip").write_bytes(text)
        with pytest.raises(DataFormatError, match="not a readable archive"):
            contents(tmp_path / "a.zip")
