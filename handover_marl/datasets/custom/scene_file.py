"""File `scenes.json` in a folder of custom scenes: objects, scenes and splits.

```
scenes.json                   this file
objects/CLASS/                model_normalized.urdf, model_normalized_convex.obj, textured_simple.obj, grasps.npz
motion/000000.npz             motion of scene 0, see `handover_marl.datasets.custom.dataset`
```
"""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Final

from handover_marl.assets.hand_model import SIDES, SUBJECTS
from handover_marl.config import MAX_OBJECTS, check_number
from handover_marl.datasets.splits import SETUPS, SPLITS
from handover_marl.errors import DataNotFoundError, OptionError, check_name
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

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_MAX_BYTES, _MAX_INTEGER = 64_000_000, 2**24 - 1


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
    """

    name: str
    number: int
    mass: float
    friction: float
    n_grasps: int = 0
    n_candidates: int = 0
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_file_name("name of an object", self.name, CLASS_NAMES.values())
        # Class numbers are exact in float32 observations.
        for name, least in (("number", LARGEST_YCB_CLASS + 1), ("n_grasps", 0), ("n_candidates", 0)):
            check_number(f"{name} of object {self.name}", getattr(self, name), True, (least, _MAX_INTEGER))
        for name in ("mass", "friction"):
            check_number(f"{name} of object {self.name}", getattr(self, name))

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
        hand: Number of the library's hand model, 1 to 10, or None for a scene without a hand.
        objects: Class names of the objects, the handed-over one first.
        repairs: Changes that were made to the user's motion.
    """

    name: str
    side: str
    hand: int | None
    objects: tuple[str, ...]
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        subject, _, recording = self.name.partition("/")
        check_file_name("subject", subject)
        check_file_name("recording", recording)
        check_name("side", self.side, SIDES)
        if self.hand is not None:
            check_name("hand", self.hand, SUBJECTS)
        if not 1 <= len(self.objects) <= MAX_OBJECTS:
            raise OptionError(f"objects of {self.name} must be 1 to {MAX_OBJECTS} classes, got {len(self.objects)}")

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
        scenes: Scenes; the number of a scene is its index.
        setups: Scene numbers by setup (way to divide the scenes) and split (train, val or test).
    """

    name: str
    objects: tuple[CustomObject, ...] = ()
    scenes: tuple[CustomScene, ...] = ()
    setups: Mapping[str, Mapping[str, tuple[int, ...]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_file_name("name", self.name)
        unique: dict[str, Sequence[object]] = {
            "names of objects": [item.name for item in self.objects],
            "numbers of objects": [*CLASS_NAMES, *(item.number for item in self.objects)],
            "names of scenes": [scene.name for scene in self.scenes],
            **{f"objects of {scene.name}": scene.objects for scene in self.scenes},
            **{f"scenes of {name}": [*chain(*setup.values())] for name, setup in self.setups.items()},
        }
        for what, values in unique.items():
            if len(set(values)) < len(values):
                raise ValueError(f"{what} must be different, got {shorten_text(values)}")
        for name in chain(*(scene.objects for scene in self.scenes)):
            check_name("class", name, self.object_names.values())
        for name, setup in self.setups.items():
            check_file_name("name of a setup", name, RESERVED_SETUPS)
            if {*setup} != {*SPLITS}:
                raise ValueError(f"splits of setup {name} must be {', '.join(SPLITS)}, got {shorten_text([*setup])}")
            for number in chain(*setup.values()):
                check_name("scene", number, range(len(self.scenes)))

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
        """Write `scenes.json` into a folder; raise `ResultsError` if it cannot be written."""
        content = {
            "format": FORMAT_NAME,
            "version": FORMAT_VERSION,
            "name": self.name,
            "objects": [vars(item) for item in self.objects],
            "scenes": [vars(scene) for scene in self.scenes],
            "setups": self.setups,
        }
        write_atomically(folder / SCENE_FILE, json.dumps(content, indent=1, allow_nan=False) + "\n")


def check_file_name(argument: str, name: object, reserved: Collection[str] = ()) -> str:
    """Return `name` if it can be part of a file name and is not reserved; else raise `OptionError` about `argument`."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise OptionError(
            f"{argument} must be 1 to 64 letters, digits, '_', '.' or '-', the first a letter or digit, got "
            f"{shorten_text(repr(name))}; rename it"
        )
    if name in reserved:
        raise OptionError(f"{argument} must not be one of {', '.join(reserved)}, got {name!r}; choose another one")
    return name


def read_scene_file(folder: Path) -> SceneFile:
    """Read `scenes.json` of a folder; raise `DataNotFoundError` if it is missing, `DataFormatError` if damaged."""
    path = folder / SCENE_FILE
    if not path.exists():
        raise DataNotFoundError(
            f"{folder} is no folder of custom scenes: it has no {SCENE_FILE}; create one with `handover-marl scenes "
            "add-object`, or pass the folder of the data set as data_dir"
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
                name: {split: tuple(sorted(numbers)) for split, numbers in splits.items()}
                for name, splits in content.pop("setups").items()
            },
        )


def _decode(item: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in item.items()}
