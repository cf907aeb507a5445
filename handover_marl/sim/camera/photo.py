"""What a camera takes: depth, what is seen where, and colours."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt


class Seen(IntEnum):
    """What a pixel of a segmentation shows."""

    BACKGROUND = 0  # nothing within reach, or the ground
    ROBOT = 1
    TABLE = 2
    TARGET = 3  # the object that is handed over
    OTHER_OBJECT = 4
    HAND = 5


@dataclass(frozen=True, eq=False)
class Photo:
    """One picture.

    Attributes:
        depth: (224, 224) float32 along the viewing axis (m); `optics.NOTHING`, just under 2 m, where nothing is.
        segmentation: (224, 224) uint8, values of `Seen`.
        rgb: (224, 224, 3) uint8, or None if colours were not asked for.
    """

    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8] | None = None

    def shows(self, what: Seen) -> npt.NDArray[np.bool_]:
        """(224, 224) where something is seen."""
        shown: npt.NDArray[np.bool_] = self.segmentation == what
        return shown
