"""Random streams and splits of generated scenes, objects and people."""

from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.generated.config import FAMILIES, GeneratedConfig
from handover_marl.datasets.splits import SPLITS
from handover_marl.datasets.synthetic.random_stream import Seed

#: Version of the generator, part of every seed. It changes whenever the scenes do.
VERSION: Final = 1

# First word of the seeds; the synthetic scenes have their version, 1.
_SALTS: Final = {"scene": 1001, "object": 1002, "person": 1003}
# Of ten numbers on average eight are in train and one each in val and test.
_SPLIT_OF_REMAINDER: Final = np.array([0] * 8 + [1, 2])
_OBJECT_OFFSET: Final = 1 << 40

ItemKind = Literal["scene", "object", "person"]


def make_seed(config: GeneratedConfig, kind: ItemKind, number: int, attempt: int = 0) -> Seed:
    """Return the seed of the random streams of a scene, object or person by its number, after failed attempts.

    Only the family and the seed of the configuration are used.
    """
    return (_SALTS[kind], VERSION, FAMILIES.index(config.family), config.seed, number & 0xFFFFFFFF, attempt)


def find_splits(numbers: npt.ArrayLike, of_objects: bool = False) -> npt.NDArray[np.int64]:
    """Return indices into `SPLITS` of scene or object numbers (n,): a fixed hash of the number alone."""
    words = np.asarray(numbers, dtype=np.uint64) + np.uint64(_OBJECT_OFFSET if of_objects else 0)
    # SplitMix64 (Steele, Lea and Flood, 2014).
    with np.errstate(over="ignore"):
        words = words + np.uint64(0x9E3779B97F4A7C15)
        words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        words = words ^ (words >> np.uint64(31))
    return np.asarray(_SPLIT_OF_REMAINDER[(words % np.uint64(10)).astype(np.int64)])


def list_split(split: str, count: int, of_objects: bool = False) -> npt.NDArray[np.int64]:
    """Return the numbers below `count` of the scenes or objects in a split, in ascending order."""
    return np.flatnonzero(find_splits(np.arange(count), of_objects) == SPLITS.index(split))
