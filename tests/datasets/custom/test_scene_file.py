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
        ({"objects": [{**vars(CONTENT.objects[0]), "name": "../x"}]}, "must be 1 to 64"),
        ({"setups": {"s0": dict.fromkeys(("train", "val", "test"), ())}}, "must not be one of s0, "),
        ({"setups": {"mine": {"train": [2], "val": [], "test": []}}}, "numbers of scenes that exist"),
        ([], ""),
        *(
            ({"objects": [{**vars(CONTENT.objects[0]), key: value}, vars(CONTENT.objects[1])]}, message)
            for key, value, message in (
                *(("number", 5, "number must be above 21"), ("number", 23, "numbers of objects must be different")),
                *(
                    ("number", True, "number must be"),
                    ("mass", -1.0, "mass must be 0.001 to 20"),
                    ("mass", "a", "mass"),
                ),
                *(("friction", 99, "friction"), ("n_grasps", 9, "at most n_candidates"), ("repairs", "a", "repairs")),
            )
        ),
        *(
            ({"scenes": [{**vars(CONTENT.scenes[0]), key: value}, vars(CONTENT.scenes[1])]}, message)
            for key, value, message in (
                *(("name", "x", "a subject and a recording"), ("name", "../1", "1 to 64")),
                *(("name", "ben/2", "names of scenes must be different"), ("side", "up", "side must be left or right")),
                *(("hand", 0, "1 to 10"), ("hand", True, "1 to 10"), ("objects", [], "1 to 5 different classes")),
                *(("objects", ["cup", "cup"], "1 to 5 different classes"), ("objects", [[1]], "")),
            )
        ),
        *(
            ({"setups": {"mine": {"train": train, "val": [1], "test": []}}}, message)
            for train, message in (
                ([True], "numbers"),
                ([0.0], "numbers"),
                ([1], "at most once"),
                ([0, 0], "ascending"),
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
