import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handover_marl.execution.reading import check_archive, check_plain_file, read_arrays, read_plain_file, read_yaml
from tests.unreadable import UNREADABLE, check_refusal

READERS: dict[str, Callable[[Path], object]] = {
    "check": check_plain_file,
    "bytes": read_plain_file,
    "archive": lambda path: check_archive(path, 1000),
    "arrays": read_arrays,
    "YAML": lambda path: read_yaml(path, 1000),
}


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_plain_file_is_not_opened(reader: str, kind: str, tmp_path: Path) -> None:
    check_refusal(READERS[reader], tmp_path / "file", kind, ValueError)


def test_content_of_a_plain_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"0" * 1000)
    (tmp_path / "link").symlink_to(path)
    assert read_plain_file(tmp_path / "link", 1000) == b"0" * 1000
    with pytest.raises(ValueError, match=r"it is larger than 0.000999 MB"):
        read_plain_file(path, 999)
    with pytest.raises(FileNotFoundError):
        read_plain_file(tmp_path / "none")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: 1\nb: 2\na: 3\n", "the key 'a' twice"),
        ("a: {b: 1, b: 1}", "the key 'b' twice"),
        ("a: &x 1\nb: *x", "aliases"),
    ],
)
def test_yaml_with_duplicate_keys_or_aliases(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=fault):
        read_yaml(tmp_path / "a.yaml", 1000)
    (tmp_path / "a.yaml").write_text("a: {b: 1}\nb: [{b: 1}, {b: 2}]")
    assert read_yaml(tmp_path / "a.yaml", 1000) == {"a": {"b": 1}, "b": [{"b": 1}, {"b": 2}]}


def test_valid_archives(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("one", b"0" * 600)
        archive.writestr("two", b"0" * 401)
    check_archive(path, 1001)
    with pytest.raises(ValueError, match="unpacks to more than"):
        check_archive(path, 1000)
    check_archive(path.read_bytes(), 1001)
    with pytest.raises(ValueError, match="unpacks to more than"):
        check_archive(path.read_bytes(), 1000)
    path.write_bytes(b"PK")
    with pytest.raises(zipfile.BadZipFile):
        check_archive(path, 1000)


def zipped(path: Path, members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # two members of one name
        for name, data in members:
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_archives_with_other_compression(tmp_path: Path, method: int) -> None:
    path = zipped(tmp_path / "a.npz", [("one", bytes(100))], method)
    with pytest.raises(ValueError, match="another method than deflate"):
        check_archive(path, 1000)


def test_archives_with_duplicate_or_large_members(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.npz", [("one", b"1"), ("one", b"2")])
    with pytest.raises(ValueError, match="two files of the same name"):
        check_archive(path, 1000)
    many = zipped(tmp_path / "many.npz", [(f"{number}", b"") for number in range(20_000)])
    with pytest.raises(ValueError, match=r"larger than 1\.001 MB"):
        check_archive(many, 1000)


def test_members_that_are_not_arrays(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.npz", [("one.npy", b"text")])
    with pytest.raises(TypeError, match="one is not an array"):
        read_arrays(path, ("one",), 1000)
    np.savez(path, one=np.arange(3))
    np.testing.assert_array_equal(read_arrays(path, ("one",), 1000)["one"], [0, 1, 2])
