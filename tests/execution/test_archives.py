"""Tests of reading archives from untrusted sources: links, paths outside and oversized files are never read."""

import contextlib
import gzip
import io
import os
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, UnsafeFileError
from handover_marl.execution import archives
from handover_marl.execution.archives import read_members

CONTENT = {"assets/a.obj": b"v 0 0 0\n", "assets/grasps/b.npy": b"\x93NUMPY", "README": b""}


def tar(path: Path, mode: str, entries: dict[str, bytes] | None = None, *extra: tarfile.TarInfo) -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, content in (CONTENT if entries is None else entries).items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
        for entry in extra:
            archive.addfile(entry)
    return path


def zipped(path: Path, entries: dict[str, bytes] | None = None) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (CONTENT if entries is None else entries).items():
            archive.writestr(name, content)
    return path


def folder(path: Path) -> Path:
    for name, content in CONTENT.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def contents(source: Path) -> dict[str, bytes]:
    return {str(member.path): member.read() for member in read_members(source)}


@pytest.mark.parametrize(
    "make",
    [
        lambda path: tar(path / "a.tar", "w"),
        lambda path: tar(path / "a.tar.gz", "w:gz"),
        lambda path: tar(path / "a.tar.bz2", "w:bz2"),
        lambda path: tar(path / "a.tar.xz", "w:xz"),
        lambda path: tar(path / "called otherwise", "w:gz"),
        lambda path: zipped(path / "a.zip"),
        lambda path: folder(path / "unpacked"),
    ],
)
def test_files_are_read_from_folders_and_archives(make: Callable[[Path], Path], tmp_path: Path) -> None:
    assert contents(make(tmp_path)) == CONTENT


def link(name: str, kind: bytes, target: str) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname = kind, target
    return entry


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        (link("assets/x", tarfile.SYMTYPE, "/etc/passwd"), "a link"),
        (link("assets/x", tarfile.SYMTYPE, "a.obj"), "a link"),
        (link("assets/x", tarfile.LNKTYPE, "assets/a.obj"), "a link"),
        (link("assets/x", tarfile.CHRTYPE, ""), "a device"),
        (link("assets/x", tarfile.FIFOTYPE, ""), "a device"),
        (tarfile.TarInfo("/etc/x"), "outside the archive"),
        (tarfile.TarInfo("assets/../../x"), "outside the archive"),
        (tarfile.TarInfo("assets\\..\\x"), "outside the archive"),
    ],
)
def test_paths_outside_of_an_archive_are_refused(entry: tarfile.TarInfo, why: str, tmp_path: Path) -> None:
    source = tar(tmp_path / "a.tar.gz", "w:gz", None, entry)
    with pytest.raises(UnsafeFileError, match=why):
        contents(source)


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x"])
def test_paths_outside_of_a_zip_archive_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(UnsafeFileError, match="outside the archive"):
        contents(zipped(tmp_path / "a.zip", {name: b""}))


def test_links_in_a_zip_archive_are_refused(tmp_path: Path) -> None:
    entry = zipfile.ZipInfo("assets/x")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(UnsafeFileError, match="a link"):
        contents(tmp_path / "a.zip")


def test_links_in_a_folder_are_ignored(tmp_path: Path) -> None:
    source = folder(tmp_path / "unpacked")
    (source / "assets/link.obj").symlink_to("/etc/passwd")
    (source / "assets/more").symlink_to("/etc")
    os.mkfifo(source / "assets/pipe.obj")
    assert contents(source) == CONTENT


class Zeros(io.RawIOBase):
    def __init__(self, size: int) -> None:
        self.left = size

    def read(self, size: int = -1, /) -> bytes:
        size = min(size, self.left)
        self.left -= size
        return bytes(size)


def bomb(path: Path, sizes: list[int]) -> Path:
    """Write a gzip archive of files of zeros, which is much smaller than its content."""
    with gzip.open(path, "wb", 1) as packed, tarfile.open(fileobj=packed, mode="w") as archive:  # type: ignore[arg-type]
        for number, size in enumerate(sizes):
            entry = tarfile.TarInfo(f"assets/{number}.obj")
            entry.size = size
            archive.addfile(entry, Zeros(size))  # type: ignore[arg-type]
    return path


def test_decompression_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "MAX_FILE_BYTES", 1_000_000)
    monkeypatch.setattr(archives, "MAX_ARCHIVE_BYTES", 3_000_000)
    with pytest.raises(UnsafeFileError, match=r"has 2 MB"):
        contents(bomb(tmp_path / "one.tar.gz", [2_000_000]))
    with pytest.raises(UnsafeFileError, match="more than 3 MB"):
        contents(bomb(tmp_path / "many.tar.gz", [900_000] * 4))
    assert len(contents(bomb(tmp_path / "fits.tar.gz", [900_000] * 3))) == 3
    with pytest.raises(UnsafeFileError, match=r"has 2 MB"):
        contents(zipped(tmp_path / "one.zip", {"assets/a.obj": bytes(2_000_000)}))
    with pytest.raises(UnsafeFileError, match="more than 3 MB"):
        contents(zipped(tmp_path / "many.zip", {f"{n}": bytes(900_000) for n in range(4)}))


def test_large_headers_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An archive with a large PAX header is refused, because readers load a header into memory as a whole."""
    monkeypatch.setattr(archives, "MAX_FILE_BYTES", 100_000)
    entry = tarfile.TarInfo("assets/a.obj")
    entry.pax_headers = {"comment": "x" * 200_000}
    with tarfile.open(tmp_path / "a.tar", "w", format=tarfile.PAX_FORMAT) as archive:
        archive.addfile(entry)
    with pytest.raises(UnsafeFileError, match="unpacks to more"):
        contents(tmp_path / "a.tar")


def test_too_many_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "MAX_FILES", 2)
    for source in (tar(tmp_path / "a.tar", "w"), zipped(tmp_path / "a.zip"), folder(tmp_path / "unpacked")):
        with pytest.raises(UnsafeFileError, match="more than 2 files"):
            contents(source)


def test_wrong_sizes_in_a_zip_archive(tmp_path: Path) -> None:
    source = zipped(tmp_path / "a.zip", {"assets/a.obj": bytes(5000)})
    data = source.read_bytes()
    # The header of the entry and the central directory both contain the size 5,000.
    assert data.count((5000).to_bytes(4, "little")) == 2
    source.write_bytes(data.replace((5000).to_bytes(4, "little"), (10).to_bytes(4, "little")))
    with pytest.raises(DataFormatError):
        contents(source)


def test_other_files_as_archives(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match="cannot read"):
        contents(tmp_path / "nothing.tar.gz")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DataNotFoundError, match="neither a folder nor an archive"):
        contents(tmp_path / "pipe")
    (tmp_path / "text.tar.gz").write_text("<html>not found</html>")
    with pytest.raises(DataFormatError, match="not a readable archive"):
        contents(tmp_path / "text.tar.gz")


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), kind=st.sampled_from(["w", "w:gz", "zip"]))
def test_damaged_archives_are_reported(data: st.DataObject, kind: str, tmp_path: Path) -> None:
    """A truncated archive, or one with a changed byte, is read or raises an error of the library."""
    source = tmp_path / "a"
    zipped(source) if kind == "zip" else tar(source, kind)
    whole = bytearray(source.read_bytes())
    if data.draw(st.booleans()):
        del whole[data.draw(st.integers(0, len(whole) - 1)) :]
    else:
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    source.write_bytes(whole)
    with contextlib.suppress(HandoverError):
        contents(source)
