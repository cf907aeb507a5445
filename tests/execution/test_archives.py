"""Tests of reading archives from untrusted sources: links and paths outside are never read."""

import io
import os
import tarfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from handover_marl.datasets.dexycb.assets import open_folder
from handover_marl.errors import DataFormatError, DataNotFoundError

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


def folder(path: Path) -> Path:
    for name, content in CONTENT.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def contents(source: Path) -> dict[str, bytes]:
    with open_folder(source) as found:
        return {str(path.relative_to(found)): path.read_bytes() for path in found.rglob("*") if path.is_file()}


def test_files_are_read_from_folders_and_archives(tmp_path: Path) -> None:
    for number, mode in enumerate(("w", "w:gz")):
        assert contents(tar(tmp_path / f"archive {number}", mode)) == CONTENT
    assert contents(folder(tmp_path / "unpacked")) == CONTENT


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
    with pytest.raises(DataFormatError, match="not a readable tar archive"):
        contents(source)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tar.gz"]


def test_other_files_as_archives(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match=r"nothing\.tar\.gz does not exist"):
        contents(tmp_path / "nothing.tar.gz")
    os.mkfifo(tmp_path / "pipe")
    whole = tar(tmp_path / "a.tar.gz", "w:gz").read_bytes()
    for number, text in enumerate((b"<html>not found</html>", whole[:-30], whole[:20] + b"x" + whole[21:])):
        (tmp_path / str(number)).write_bytes(text)
    for name in ("pipe", "0", "1", "2"):
        with pytest.raises(DataFormatError, match="not a readable tar archive"):
            contents(tmp_path / name)
