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
    with pytest.raises(DataNotFoundError, match="no folder of custom scenes"):
        read_scene_file(tmp_path / "none")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects": [{"name": "bottle"}]}, "number"),
        ({"objects": [{**vars(CONTENT.objects[0]), "name": "../x"}]}, "must be 1 to 64 .*, the first a letter or"),
        ({"setups": {"s0": dict.fromkeys(("train", "val", "test"), ())}}, "must not be one of s0, "),
        ({"setups": {"mine": {"train": [2], "val": [], "test": []}}}, "unknown scene 2; valid: 0, 1"),
        ({"setups": {"mine": {"train": [1], "val": [1], "test": []}}}, "scenes of mine must be different"),
        ({"setups": {"mine": dict.fromkeys(("train", "val", "test", "tset"), ())}}, "splits of setup mine must be"),
        ([], ""),
        *(
            ({"objects": [{**vars(CONTENT.objects[0]), "number": number}, vars(CONTENT.objects[1])]}, message)
            for number, message in ((23, "must be different"), *((n, "from 22 to 16777215") for n in (0, 5, 2**24)))
        ),
        *(
            ({"scenes": [{**vars(CONTENT.scenes[0]), key: value}, vars(CONTENT.scenes[1])]}, message)
            for key, value, message in (
                *(("name", "x", ""), ("name", "../1", "1 to 64")),
                ("name", "ben/2", "names of scenes must be different"),
                *(("side", "up", "unknown side 'up'; valid: left, right"), ("hand", 0, "unknown hand 0; valid: 1, 2")),
                *(("objects", ["cup", "cup"], "must be different"), ("objects", ["jar"], "unknown class 'jar'")),
                *(("objects", ["cup"] * number, "must be 1 to 5 classes") for number in (0, 6)),
            )
        ),
    ],
)
def test_damaged_files(tmp_path: Path, changes: Any, message: str) -> None:
    CONTENT.write(tmp_path)
    path = tmp_path / "scenes.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes} if changes else changes))
    with pytest.raises(DataFormatError, match=rf"scenes\.json: not a readable file .*{message}"):
        read_scene_file(tmp_path)
