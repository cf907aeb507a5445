import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handover_marl.execution.reading import check_archive, check_plain_file, read_arrays, read_plain_file, read_yaml
from tests.helpers.unreadable import UNREADABLE, check_refusal

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


def test_yaml(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: {b: 1}\nb: [{b: 1}, {b: 2}]")
    assert read_yaml(path, 1000) == {"a": {"b": 1}, "b": [{"b": 1}, {"b": 2}]}
    for text in ("a: [", "!!python/object/apply:os.getcwd []", "a: 2000-99-99", "a: &b [1]\nc: *b"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"Error"):
            read_yaml(path, 1000)


def test_archives(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("one.npy", b"0" * 600)
        archive.writestr("two.npy", b"0" * 401)
    for source in (path, path.read_bytes()):
        check_archive(source, 1001)
        with pytest.raises(ValueError, match="unpacks to more than"):
            check_archive(source, 1000)
        with pytest.raises(TypeError, match=r"one\.npy|one is not an array"):
            read_arrays(source, ("one",), 2000)
    path.write_bytes(b"PK")
    with pytest.raises(zipfile.BadZipFile):
        check_archive(path, 1000)
    np.savez(path, one=np.arange(3))
    np.testing.assert_array_equal(read_arrays(path, ("one",), 1000)["one"], [0, 1, 2])
