"""Tests of the file `scenes.json`: damaged files are refused."""

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


FAULTS: dict[str, tuple[str, Any, str]] = {
    "another format": ("format", "other", "format and version must be"),
    "the name of the folder": ("name", "a/b", "must be 1 to 64 letters"),
    "a missing field": ("objects", [{"name": "bottle"}], "number"),
    "a name outside of the folder": ("objects", [{**vars(CONTENT.objects[0]), "name": "../x"}], "must be 1 to 64"),
    "an unknown class": ("objects", [], "unknown class 'bottle'"),
    "a reserved setup": ("setups", {"s0": {}}, "must not be s0"),
    "a split without a scene": ("setups", {"mine": {"train": [2], "val": [], "test": []}}, "does not exist"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_damaged_files(tmp_path: Path, kind: str) -> None:
    key, value, message = FAULTS[kind]
    CONTENT.write(tmp_path)
    path = tmp_path / "scenes.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(DataFormatError, match=rf"scenes\.json: not a readable file .*{message}"):
        read_scene_file(tmp_path)


@pytest.mark.parametrize("text", ["", "[]"])
def test_other_files(tmp_path: Path, text: str) -> None:
    (tmp_path / "scenes.json").write_text(text)
    with pytest.raises(DataFormatError, match=r"scenes\.json"):
        read_scene_file(tmp_path)
    with pytest.raises(DataNotFoundError, match="no folder of custom scenes"):
        read_scene_file(tmp_path / "none")
