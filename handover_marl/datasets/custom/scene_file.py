"""File `scenes.json` in a folder of custom scenes: objects, scenes and splits.

```
scenes.json                   this file
objects/CLASS/                model_normalized.urdf, model_normalized_convex.obj, textured_simple.obj, grasps.npz
motion/000000.npz             motion of scene 0, see `handover_marl.datasets.custom.dataset`
```
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from handover_marl.assets.hand_model import SUBJECTS
from handover_marl.config import MAX_OBJECTS
from handover_marl.datasets.custom.ranges import FRICTION, MASS
from handover_marl.datasets.splits import SETUPS, SPLITS
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import read_plain_file
from handover_marl.geometry.ycb import CLASS_NAMES, LARGEST_YCB_CLASS

FORMAT_NAME: Final = "handover_marl scenes"
FORMAT_VERSION: Final = 1
SCENE_FILE: Final = "scenes.json"
#: Setup with all scenes in every split.
ALL_SCENES: Final = "all"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_SCENE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}/[A-Za-z0-9_.-]{1,64}")
_MAX_BYTES = 64_000_000
_MAX_SCENES = 1_000_000
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class CustomObject:
    """Object class that a user has defined.

    Attributes:
        name: Class name.
        number: Class number, from 22 on.
        mass: Mass (kg).
        friction: Lateral friction coefficient.
        n_grasps: Number of robot grasps that held the object in simulation.
        n_candidates: Number of grasps that were simulated for it.
        repairs: Changes that were made to the user's mesh.
    """

    name: str
    number: int
    mass: float
    friction: float
    n_grasps: int = 0
    n_candidates: int = 0
    repairs: tuple[str, ...] = ()

    def __str__(self) -> str:
        grasps = f"{self.n_grasps} grasps held in simulation, of {self.n_candidates} that were tried"
        text = f"object {self.name}: class {self.number}, {self.mass:.3g} kg, friction {self.friction:g}; {grasps}"
        return "\n".join([text, *(f"  mesh: {repair}" for repair in self.repairs)])


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
    setups: Mapping[str, Mapping[str, tuple[int, ...]]] = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        object.__setattr__(self, "setups", dict(self.setups))

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
            "objects": [_encode(item) for item in self.objects],
            "scenes": [_encode(scene) for scene in self.scenes],
            "setups": self.setups,
        }
        write_atomically(folder / SCENE_FILE, json.dumps(content, indent=1, allow_nan=False) + "\n")


def check_class_name(name: object) -> str:
    """Check the name of a custom object class and return it.

    Raises:
        ValueError: The name is the name of a YCB class, or has characters other than letters, digits and "_.-".
    """
    text = check_file_name(name)
    if text in CLASS_NAMES.values():
        raise ValueError(f"must not be the name of a YCB class, got {text!r}; choose another one")
    return text


def check_file_name(name: object) -> str:
    """Check that a name can be part of a file name, and return it.

    Raises:
        ValueError: The name is not 1 to 64 letters, digits and "_.-", the first a letter or digit.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"must be 1 to 64 letters, digits, '_', '.' or '-', got {shorten_text(repr(name))}")
    return name


def read_scene_file(folder: Path) -> SceneFile:
    """Read and check `scenes.json` of a folder.

    Raises:
        DataNotFoundError: There is no such file.
        DataFormatError: The file is damaged; the error names the field.
    """
    path = folder / SCENE_FILE
    try:
        content = json.loads(read_plain_file(path, _MAX_BYTES), object_pairs_hook=_reject_duplicates)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataNotFoundError(
            f"{folder} is no folder of custom scenes: it has no {SCENE_FILE}; create one with "
            "`handover-marl scenes add-object`"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataFormatError(f"{path}: not a readable file ({shorten_text(error)}); restore it from a copy") from error
    return _Reader(path).read(content)


class _Reader:
    """Reader of the content of `scenes.json` whose errors name the field.

    Args:
        path: The file, for errors.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, content: object) -> SceneFile:
        """Return the checked content."""
        top = self._read_mapping("", content, ("format", "version", "name", "objects", "scenes", "setups"))
        self._require("format", top["format"] == FORMAT_NAME, f"must be {FORMAT_NAME!r}", top["format"])
        known = type(top["version"]) is int and top["version"] == FORMAT_VERSION
        self._require(
            "version", known, f"must be {FORMAT_VERSION}, or install the version that wrote it", top["version"]
        )
        objects = self._read_list("objects", top["objects"], self._read_object)
        self._check_unique("objects", objects, ("name", "number"))
        names = {*CLASS_NAMES.values(), *(item.name for item in objects)}
        scenes = self._read_list("scenes", top["scenes"], lambda field, value: self._read_scene(field, value, names))
        self._check_unique("scenes", scenes, ("name",))
        self._require("scenes", len(scenes) <= _MAX_SCENES, f"must be at most {_MAX_SCENES}", len(scenes))
        setups = self._read_setups(top["setups"], len(scenes))
        return SceneFile(self._call("name", check_file_name, top["name"]), objects, scenes, setups)

    def _read_object(self, field: str, value: object) -> CustomObject:
        item = self._read_mapping(
            field, value, ("name", "number", "mass", "friction", "n_grasps", "n_candidates", "repairs")
        )
        return CustomObject(
            name=self._call(f"{field}.name", check_class_name, item["name"]),
            number=self._read_integer(f"{field}.number", item["number"], LARGEST_YCB_CLASS + 1, 2**23),
            mass=self._read_number(f"{field}.mass", item["mass"], *MASS),
            friction=self._read_number(f"{field}.friction", item["friction"], *FRICTION),
            n_candidates=(
                n_candidates := self._read_integer(f"{field}.n_candidates", item["n_candidates"], 0, 1_000_000)
            ),
            n_grasps=self._read_integer(f"{field}.n_grasps", item["n_grasps"], 0, n_candidates),
            repairs=self._read_texts(f"{field}.repairs", item["repairs"]),
        )

    def _check_unique(self, field: str, items: Sequence[object], keys: tuple[str, ...]) -> None:
        for key in keys:
            seen: set[object] = set()
            for position, value in enumerate(getattr(item, key) for item in items):
                self._require(f"{field}[{position}].{key}", value not in seen, "must differ from all others", value)
                seen.add(value)

    def _read_scene(self, field: str, value: object, names: set[str]) -> CustomScene:
        scene = self._read_mapping(field, value, ("name", "side", "hand", "objects", "repairs"))
        name, side, hand = scene["name"], scene["side"], scene["hand"]
        is_name = isinstance(name, str) and bool(_SCENE_NAME.fullmatch(name))
        self._require(f"{field}.name", is_name, "must be SUBJECT/RECORDING", name)
        self._require(f"{field}.side", side in ("right", "left"), "must be 'right' or 'left'", side)
        if hand is not None:
            self._read_integer(f"{field}.hand", hand, SUBJECTS[0], SUBJECTS[-1])
        objects = self._read_texts(f"{field}.objects", scene["objects"])
        limit = f"must be 1 to {MAX_OBJECTS} class names"
        self._require(f"{field}.objects", 1 <= len(objects) <= MAX_OBJECTS, limit, objects)
        for position, item in enumerate(objects):
            rule = "must be a class in `objects` or a YCB class"
            self._require(f"{field}.objects[{position}]", item in names, rule, item)
        return CustomScene(name, side, hand, objects, self._read_texts(f"{field}.repairs", scene["repairs"]))

    def _read_setups(self, value: object, n_scenes: int) -> dict[str, dict[str, tuple[int, ...]]]:
        setups: dict[str, dict[str, tuple[int, ...]]] = {}
        self._require("setups", isinstance(value, dict), "must be a mapping", value)
        for name, splits in value.items():  # type: ignore[attr-defined]
            field = f"setups.{shorten_text(name)}"
            self._call(field, check_file_name, name)
            reserved = name in (*SETUPS, ALL_SCENES)
            self._require(field, not reserved, f"must not be {', '.join(SETUPS)} or {ALL_SCENES}", name)
            parts = self._read_mapping(field, splits, SPLITS)
            setups[name] = {}
            seen: set[int] = set()
            for split in SPLITS:
                inner = f"{field}.{split}"
                numbers = self._read_list(
                    inner, parts[split], lambda place, number: self._read_integer(place, number, 0, n_scenes - 1)
                )
                is_sorted = list(numbers) == sorted(set(numbers)) and not seen & set(numbers)
                self._require(inner, is_sorted, "must be ascending numbers of no other split", numbers)
                seen |= set(numbers)
                setups[name][split] = numbers
        return setups

    def _read_mapping(self, field: str, value: object, keys: tuple[str, ...]) -> dict[str, Any]:
        self._require(field, isinstance(value, dict), "must be a mapping", value)
        mapping: dict[str, Any] = dict(value)  # type: ignore[call-overload]
        missing = [key for key in keys if key not in mapping]
        unknown = sorted(map(str, mapping.keys() - set(keys)))
        self._require(_join(field, missing[:1]), not missing, f"must have {', '.join(keys)}", "nothing")
        self._require(_join(field, unknown[:1]), not unknown, "must be left out", "an unknown field")
        return mapping

    def _read_list(self, field: str, value: object, read: Callable[[str, object], _Item]) -> tuple[_Item, ...]:
        self._require(field, isinstance(value, list), "must be a list", value)
        return tuple(read(f"{field}[{position}]", item) for position, item in enumerate(value))  # type: ignore[arg-type, var-annotated]

    def _read_texts(self, field: str, value: object) -> tuple[str, ...]:
        return self._read_list(field, value, self._read_text)

    def _read_text(self, field: str, value: object) -> str:
        is_text = isinstance(value, str) and value.isprintable() and len(value) <= 1000
        self._require(field, is_text, "must be text without control characters", value)
        return str(value)

    def _read_integer(self, field: str, value: object, low: int, high: int) -> int:
        is_valid = type(value) is int and low <= value <= high
        self._require(field, is_valid, f"must be an integer from {low} to {high}", value)
        return int(value)  # type: ignore[call-overload, no-any-return]

    def _read_number(self, field: str, value: object, low: float, high: float) -> float:
        is_valid = type(value) in (int, float) and low <= value <= high  # type: ignore[operator]
        self._require(field, is_valid, f"must be a number from {low:g} to {high:g}", value)
        return float(value)  # type: ignore[arg-type]

    def _call(self, field: str, check: Callable[[object], str], value: object) -> str:
        try:
            return check(value)
        except ValueError as error:
            raise DataFormatError(f"{self._path}: {field} {error}") from None

    def _require(self, field: str, condition: bool, rule: str, value: object) -> None:
        if not condition:
            place = field or "the content"
            raise DataFormatError(f"{self._path}: {place} {rule}, got {shorten_text(repr(value))}; correct the file")


def _join(field: str, names: list[str]) -> str:
    return ".".join(filter(None, (field, *map(shorten_text, names))))


def _reject_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("a mapping has a key twice")
    return content


def _encode(item: CustomObject | CustomScene) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in vars(item).items()}
