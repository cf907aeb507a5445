"""Configuration of generated scenes, its text form in names of data sets, and the scenes' seeds and splits."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from handover_marl.config import MAX_OBJECTS, CheckedConfig, bounded
from handover_marl.datasets.generated.random_stream import Seed
from handover_marl.datasets.splits import SPLITS
from handover_marl.errors import OptionError, check_name

#: First word of the name of generated data sets.
GENERATED: Final = "generated"
DEFAULT, HARD = "default", "hard"
#: Families of scenes. "default" has motions as in the synthetic scenes; "hard" has long motions with rotation,
#: procedural objects of its own, handover positions at the edge of the robot's reach and more objects on the table.
FAMILIES: Final = (DEFAULT, HARD)
#: Kinds of procedural objects.
OBJECT_KINDS: Final = ("boxes", "cylinders", "bottles", "tools", "superquadrics")

#: Version of the generator, part of every seed. It changes whenever the scenes do.
VERSION: Final = 2
# First word of the seeds; the synthetic scenes have their version, 1.
_SALTS: Final = {"scene": 1001, "object": 1002, "person": 1003}
# Of ten numbers on average eight are in train and one each in val and test.
_SPLIT_OF_REMAINDER: Final = np.array([0] * 8 + [1, 2])
_OBJECT_OFFSET: Final = 1 << 40
ItemKind = Literal["scene", "object", "person"]


@dataclass(frozen=True)
class GeneratedConfig(CheckedConfig):
    """Configuration of generated scenes; a value that is not allowed raises `OptionError` or `UnknownNameError`.

    There are `n` scenes of a `family` in `FAMILIES`. In the share `procedural` of them, one of `people` persons hands
    over one of `objects` procedural objects. `left` is the share of left hands. `clutter_min` to `clutter_max` other
    objects are on the table. The last five are relative frequencies of the kinds of procedural objects.
    """

    default_limits: ClassVar[tuple[float, float]] = (0, 1_000_000)
    ordered_fields: ClassVar[tuple[tuple[str, str], ...]] = (("clutter_min", "clutter_max"),)

    n: int = bounded(1000, 1, 10_000_000)
    seed: int = bounded(0, 0, 2**32 - 1)  # a 32-bit word
    family: str = DEFAULT
    procedural: float = bounded(0.5, 0, 1)
    objects: int = bounded(1000, 50, 100_000)  # class numbers are exact in float32 observations
    people: int = bounded(50, 1, 100_000)
    left: float = bounded(0.5, 0, 1)
    clutter_min: int = bounded(2, 0)
    clutter_max: int = bounded(4, 0, MAX_OBJECTS - 1)
    boxes: float = 1.0
    cylinders: float = 1.0
    bottles: float = 1.0
    tools: float = 1.0
    superquadrics: float = 1.0

    def __post_init__(self) -> None:
        check_name("family", self.family, FAMILIES)
        super().__post_init__()
        if not any(self.kind_weights):
            raise OptionError(f"one of {', '.join(OBJECT_KINDS)} must be above 0, got 0 for all; leave them out")

    @property
    def kind_weights(self) -> tuple[float, ...]:
        """Relative frequencies of the kinds of procedural objects, in the order of `OBJECT_KINDS`; not normalized."""
        return tuple(getattr(self, name) for name in OBJECT_KINDS)

    @property
    def argument(self) -> str:
        """Text after `generated:` in the data set's name: n, seed, family "hard", and values that are not defaults."""
        usual = {**vars(FAMILY_DEFAULTS[self.family]), "n": None, "seed": None, "family": DEFAULT}
        return ",".join(f"{name}={value}" for name, value in vars(self).items() if value != usual[name])


#: Default configuration of each family.
FAMILY_DEFAULTS: Final[Mapping[str, GeneratedConfig]] = MappingProxyType(
    {DEFAULT: GeneratedConfig(), HARD: GeneratedConfig(family=HARD, procedural=1.0, clutter_min=4, clutter_max=4)}
)


def parse_generated_config(argument: str) -> GeneratedConfig:
    """Parse text such as "n=100,family=hard", add the family's defaults; raise `OptionError` or `UnknownNameError`."""
    values: dict[str, Any] = {}
    defaults = vars(GeneratedConfig())
    for entry in argument.split(","):
        name, _, text = (word.strip() for word in entry.partition("="))
        check_name("parameter of generated scenes", name, defaults)
        if name in values:
            raise OptionError(f"parameters of generated scenes must have different names, got {name!r} twice")
        try:
            values[name] = type(defaults[name])(text)
        except ValueError as error:
            raise OptionError(f"{name} must be a number, got {text[:80]!r} ({error}); write such as n=1000") from None
    family = values.pop("family", DEFAULT)
    check_name("family", family, FAMILIES)
    usual = FAMILY_DEFAULTS[family]
    if "clutter_max" in values and "clutter_min" not in values:
        values["clutter_min"] = min(usual.clutter_min, values["clutter_max"])
    return replace(usual, **values)


def make_seed(config: GeneratedConfig, kind: ItemKind, number: int, attempt: int = 0) -> Seed:
    """Return the seed of the random streams of the scene, object or person `number`, after `attempt` failed attempts.

    Only the family and the seed of the configuration are used.
    """
    return (_SALTS[kind], VERSION, FAMILIES.index(config.family), config.seed, number & 0xFFFFFFFF, attempt)


def find_splits(numbers: npt.ArrayLike, of_objects: bool = False) -> npt.NDArray[np.int64]:
    """Return the splits (n,), as indices into `SPLITS`, of scenes (or objects) with numbers (n,), by a hash of each."""
    words = np.asarray(numbers, dtype=np.uint64) + np.uint64(_OBJECT_OFFSET if of_objects else 0)
    # SplitMix64 (Steele, Lea and Flood, 2014).
    with np.errstate(over="ignore"):
        words = words + np.uint64(0x9E3779B97F4A7C15)
        words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        words = words ^ (words >> np.uint64(31))
    return np.asarray(_SPLIT_OF_REMAINDER[(words % np.uint64(10)).astype(np.int64)])


def list_split(split: str, count: int, of_objects: bool = False) -> npt.NDArray[np.int64]:
    """Return those numbers from 0 to `count` - 1, ascending, whose scenes (or objects) are in a split."""
    return np.flatnonzero(find_splits(np.arange(count), of_objects) == SPLITS.index(split))
