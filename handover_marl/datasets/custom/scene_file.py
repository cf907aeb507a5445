"""File `scenes.json` in a folder of custom scenes: objects, scenes and splits.

```
scenes.json                   this file
objects/CLASS/                model_normalized.urdf, model_normalized_convex.obj, textured_simple.obj, grasps.npz
motion/000000.npz             motion of scene 0, see `handover_marl.datasets.custom.dataset`
```
"""

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from handover_marl.assets.hand_model import SIDES, SUBJECTS
from handover_marl.config import MAX_OBJECTS
from handover_marl.datasets.splits import SETUPS, SPLITS
from handover_marl.errors import DataNotFoundError
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import read_plain_file, report_damage
from handover_marl.geometry.panda import OPEN
from handover_marl.geometry.ycb import CLASS_NAMES, LARGEST_YCB_CLASS

FORMAT_NAME: Final = "handover_marl scenes"
FORMAT_VERSION: Final = 1
SCENE_FILE: Final = "scenes.json"
#: Setup with all scenes in every split.
ALL_SCENES: Final = "all"
#: Names that setups of custom scenes cannot have.
RESERVED_SETUPS: Final = (*SETUPS, ALL_SCENES)

#: Smallest and largest mass (kg) and lateral friction of objects.
MASS, FRICTION = (1e-3, 20.0), (0.0, 10.0)

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_MAX_BYTES = 64_000_000


@dataclass(frozen=True)
class CustomObject:
    """Object class that a user has defined.

    Attributes:
        name: Class name.
        number: Class number, from 22 on.
        mass: Mass (kg).
        friction: Lateral friction coefficient.
        n_grasps: Number of robot grasps that held the object in simulation.
        n_candidates: Number of robot grasps that were simulated.
        repairs: Changes that were made to the user's mesh.

    Raises:
        ValueError: A value is out of its range, also in `CustomScene` and `SceneFile`.
    """

    name: str
    number: int
    mass: float
    friction: float
    n_grasps: int = 0
    n_candidates: int = 0
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_file_name(self.name, CLASS_NAMES.values())
        _require(_is_index(self.number) and self.number > LARGEST_YCB_CLASS, "number", "above 21", self.number)
        for name, (low, high) in (("mass", MASS), ("friction", FRICTION)):
            value = getattr(self, name)
            _require(type(value) in (int, float) and low <= value <= high, name, f"{low:g} to {high:g}", value)
        counts = self.n_grasps, self.n_candidates
        _require(all(map(_is_index, counts)) and counts[0] <= counts[1], "n_grasps", "at most n_candidates", counts)
        _check_repairs(self.repairs)

    def __str__(self) -> str:
        grasps = f"{self.n_grasps} grasps held in simulation, of {self.n_candidates} that were tried"
        lines = [f"object {self.name}: class {self.number}, {self.mass:.3g} kg, friction {self.friction:g}; {grasps}"]
        if not self.n_grasps:
            lines.append(f"  warning: without grasps, most receivers fail; the gripper opens {2000 * OPEN:.0f} mm")
        return "\n".join([*lines, *(f"  mesh: {repair}" for repair in self.repairs)])


@dataclass(frozen=True)
class CustomScene:
    """Scene that a user has defined, without its motion.

    Attributes:
        name: `<subject>/<recording>`.
        side: Hand of the giver, "right" or "left".
        hand: Number of the shipped hand, 1 to 10, or None for a scene without a hand.
        objects: Class names of the objects, the handed-over one first.
        repairs: Changes that were made to the user's motion.
    """

    name: str
    side: str
    hand: int | None
    objects: tuple[str, ...]
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        parts = self.name.split("/") if isinstance(self.name, str) else ()
        _require(len(parts) == 2, "name", "a subject and a recording, such as 'anna/1'", self.name)
        for part in parts:
            check_file_name(part)
        _require(self.side in SIDES, "side", " or ".join(SIDES), self.side)
        is_hand = _is_index(self.hand) and self.hand in SUBJECTS
        _require(self.hand is None or is_hand, "hand", "a number from 1 to 10 or null", self.hand)
        is_list = isinstance(self.objects, tuple) and len(set(self.objects)) == len(self.objects)
        rule = f"1 to {MAX_OBJECTS} different classes"
        _require(is_list and 1 <= len(self.objects) <= MAX_OBJECTS, "objects", rule, self.objects)
        _check_repairs(self.repairs)

    def __str__(self) -> str:
        hand = "no hand" if self.hand is None else f"{self.side} hand {self.hand}"
        text = f"scene {self.name}: {', '.join(self.objects)}; {hand}"
        return "\n".join([text, *(f"  motion: {repair}" for repair in self.repairs)])

    @property
    def subject(self) -> str:
        """Name of the person."""
        return self.name.partition("/")[0]


@dataclass(frozen=True)
class SceneFile:
    """Content of `scenes.json`.

    Attributes:
        name: Name of the data set in results.
        objects: The user's object classes.
        scenes: Scenes; the number of a scene is its position.
        setups: Scene numbers of each split of each setup, by setup and split.
    """

    name: str
    objects: tuple[CustomObject, ...] = ()
    scenes: tuple[CustomScene, ...] = ()
    setups: Mapping[str, Mapping[str, tuple[int, ...]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_file_name(self.name)
        for name, values in (
            ("names of objects", [item.name for item in self.objects]),
            ("numbers of objects", [item.number for item in self.objects]),
            ("names of scenes", [scene.name for scene in self.scenes]),
        ):
            _require(len(set(values)) == len(values), name, "different", values)
        known = self.object_names.values()
        unknown = [name for scene in self.scenes for name in scene.objects if name not in known]
        if unknown:
            raise ValueError(f"unknown class {unknown[0]!r}")
        for name, setup in self.setups.items():
            check_file_name(name, RESERVED_SETUPS)
            numbers = [number for split in SPLITS for number in setup[split]]
            is_valid = all(_is_index(number) and number < len(self.scenes) for number in numbers)
            _require(is_valid, f"setup {name}", "numbers of scenes that exist", numbers)
            is_sorted = all(list(setup[split]) == sorted(setup[split]) for split in SPLITS)
            is_sorted &= len(set(numbers)) == len(numbers)
            _require(is_sorted, f"splits of {name}", "ascending, with each scene at most once", dict(setup))

    def __str__(self) -> str:
        lines = [f"own data: {self.name}, {len(self.scenes)} scenes", *map(str, self.objects)]
        for name, setup in self.setups.items():
            sizes = ", ".join(f"{split} {len(numbers)}" for split, numbers in setup.items())
            lines.append(f"setup {name}: {sizes}")
        return "\n".join(lines)

    @property
    def object_names(self) -> dict[int, str]:
        """Class names by class number: the YCB classes and the user's classes."""
        return {**CLASS_NAMES, **{item.number: item.name for item in self.objects}}

    def write(self, folder: Path) -> None:
        """Write `scenes.json` into a folder.

        Raises:
            ResultsError: The file cannot be written.
        """
        content = {
            "format": FORMAT_NAME,
            "version": FORMAT_VERSION,
            "name": self.name,
            "objects": [vars(item) for item in self.objects],
            "scenes": [vars(scene) for scene in self.scenes],
            "setups": self.setups,
        }
        write_atomically(folder / SCENE_FILE, json.dumps(content, indent=1, allow_nan=False) + "\n")


def check_file_name(name: object, reserved: Collection[str] = ()) -> str:
    """Check that a name can be part of a file name and is not reserved, and return it; else raise `ValueError`."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"must be 1 to 64 letters, digits, '_', '.' or '-', got {shorten_text(repr(name))}")
    if name in reserved:
        raise ValueError(f"must not be one of {', '.join(reserved)}, got {name!r}; choose another one")
    return name


def read_scene_file(folder: Path) -> SceneFile:
    """Read `scenes.json` of a folder.

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: The file is damaged.
    """
    path = folder / SCENE_FILE
    if not path.exists():
        raise DataNotFoundError(
            f"{folder} is no folder of custom scenes: it has no {SCENE_FILE}; create one with "
            "`handover-marl scenes add-object`"
        )
    with report_damage(path, "file", "restore it from a copy"):
        content = json.loads(read_plain_file(path, _MAX_BYTES))
        if (content.pop("format"), content.pop("version")) != (FORMAT_NAME, FORMAT_VERSION):
            raise ValueError(f"format and version must be {FORMAT_NAME!r} and {FORMAT_VERSION}")
        return SceneFile(
            name=content.pop("name"),
            objects=tuple(CustomObject(**_decode(item)) for item in content.pop("objects")),
            scenes=tuple(CustomScene(**_decode(item)) for item in content.pop("scenes")),
            setups={
                name: {split: tuple(splits[split]) for split in SPLITS}
                for name, splits in content.pop("setups").items()
            },
        )


def _require(is_valid: bool, name: str, rule: str, value: object) -> None:
    if not is_valid:
        raise ValueError(f"{name} must be {rule}, got {shorten_text(repr(value))}")


def _is_index(value: object) -> bool:
    return type(value) is int and value >= 0


def _check_repairs(repairs: object) -> None:
    is_list = isinstance(repairs, tuple) and all(isinstance(repair, str) for repair in repairs)
    _require(is_list, "repairs", "a list of texts", repairs)


def _decode(item: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in item.items()}
