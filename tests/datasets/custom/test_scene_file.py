"""Tests of the file `scenes.json`: damaged files are refused with an error that names the field."""

import json
from pathlib import Path
from typing import Any

import pytest

from handover_marl.datasets.custom.scene_file import CustomObject, CustomScene, SceneFile, read_scene_file
from handover_marl.errors import DataFormatError, DataNotFoundError

CONTENT = SceneFile(
    "bottles",
    (CustomObject("bottle", 22, 0.3, 0.9, 5, 8, ("flipped",)), CustomObject("cup", 23, 0.1, 0.5)),
    (
        CustomScene("anna/1", "right", 6, ("bottle", "025_mug")),
        CustomScene("ben/2", "left", None, ("cup",), ("gaps filled",)),
    ),
    {"mine": {"train": (0,), "val": (1,), "test": ()}},
)


def test_content_is_read_as_it_was_written(tmp_path: Path) -> None:
    CONTENT.write(tmp_path)
    assert read_scene_file(tmp_path) == CONTENT
    assert CONTENT.object_names[23] == "cup"
    assert CONTENT.scenes[1].subject == "ben"


FAULTS: list[tuple[str, Any, str]] = [
    ("format", "other", r"format must be 'handover_marl scenes', got 'other'"),
    ("version", 2, "version must be 1, or install the version that wrote it, got 2"),
    ("version", True, "version must be 1"),
    ("name", "a/b", "name must be 1 to 64 letters"),
    ("objects", {}, "objects must be a list"),
    ("objects.0", [], r"objects\[0\] must be a mapping"),
    ("objects.0.name", "025_mug", r"objects\[0\]\.name must not be the name of a YCB class"),
    ("objects.0.name", "../x", r"objects\[0\]\.name must be 1 to 64 letters"),
    ("objects.0.number", 21, r"objects\[0\]\.number must be an integer from 22"),
    ("objects.0.number", 22.0, r"objects\[0\]\.number must be an integer"),
    ("objects.1.number", 22, r"objects\[1\]\.number must differ from all others, got 22"),
    ("objects.1.name", "bottle", r"objects\[1\]\.name must differ from all others"),
    ("objects.0.mass", -1, r"objects\[0\]\.mass must be a number from 0\.001 to 20, got -1"),
    ("objects.0.mass", float("nan"), r"objects\[0\]\.mass must be a number"),
    ("objects.0.friction", "low", r"objects\[0\]\.friction must be a number"),
    ("objects.0.n_grasps", -1, r"objects\[0\]\.n_grasps must be an integer"),
    ("objects.0.n_grasps", 9, r"objects\[0\]\.n_grasps must be an integer from 0 to 8"),
    ("objects.0.repairs", "none", r"objects\[0\]\.repairs must be a list"),
    ("objects.0.repairs", ["\x1b[31m"], r"objects\[0\]\.repairs\[0\] must be text without control characters"),
    ("objects.0.color", "red", r"objects\[0\]\.color must be left out"),
    ("scenes.0.name", "anna", r"scenes\[0\]\.name must be SUBJECT/RECORDING, got 'anna'"),
    ("scenes.1.name", "anna/1", r"scenes\[1\]\.name must differ from all others"),
    ("scenes.0.side", "both", r"scenes\[0\]\.side must be 'right' or 'left', got 'both'"),
    ("scenes.0.hand", 11, r"scenes\[0\]\.hand must be an integer from 1 to 10"),
    ("scenes.0.objects", [], r"scenes\[0\]\.objects must be 1 to 5 class names"),
    ("scenes.0.objects", ["can"], r"scenes\[0\]\.objects\[0\] must be a class in `objects` or a YCB class"),
    ("setups", [], "setups must be a mapping"),
    ("setups.s0", {}, r"setups\.s0 must not be s0"),
    ("setups.mine.val", [2], r"setups\.mine\.val\[0\] must be an integer from 0 to 1, got 2"),
    ("setups.mine.test", [0], r"setups\.mine\.test must be ascending numbers of no other split"),
    ("setups.mine.train", [0, 0], r"setups\.mine\.train must be ascending"),
    ("setups.mine.dev", [], r"setups\.mine\.dev must be left out"),
]


@pytest.mark.parametrize(("field", "value", "message"), FAULTS)
def test_damaged_fields(field: str, value: Any, message: str, tmp_path: Path) -> None:
    CONTENT.write(tmp_path)
    path = tmp_path / "scenes.json"
    content = json.loads(path.read_text())
    place: Any = content
    *parents, last = (int(part) if part.isdigit() else part for part in field.split("."))
    for part in parents:
        place = place[part]
    place[last] = value
    path.write_text(json.dumps(content))
    with pytest.raises(DataFormatError, match=message):
        read_scene_file(tmp_path)


@pytest.mark.parametrize("field", ["format", "name", "objects", "setups", "scenes"])
def test_missing_fields(field: str, tmp_path: Path) -> None:
    CONTENT.write(tmp_path)
    path = tmp_path / "scenes.json"
    content = json.loads(path.read_text())
    del content[field]
    path.write_text(json.dumps(content))
    with pytest.raises(DataFormatError, match=f"{field} must have"):
        read_scene_file(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{", "3", '{"name": 1, "name": 2}', "[" * 100_000, "\x00"])
def test_files_of_another_kind(text: str, tmp_path: Path) -> None:
    (tmp_path / "scenes.json").write_text(text)
    with pytest.raises(DataFormatError, match=r"scenes\.json"):
        read_scene_file(tmp_path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match="is no folder of custom scenes"):
        read_scene_file(tmp_path)
