"""From key poses at 25 Hz to frames of 1 ms: rotations by slerp, positions by interpolating cubic splines."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import splev, splrep
from scipy.spatial.transform import Rotation, Slerp

Float32 = npt.NDArray[np.float32]

#: Frames of 1 ms between two key poses.
STRIDE = 40
#: Fewest key poses that a cubic spline goes through.
FEWEST_KEYS = 4
_KEY_PERIOD = 0.04
_PERIOD = 0.001


def original_can(n_keys: int) -> bool:
    """Whether the original can resample a recording of so many key poses.

    Its times are `arange(0, n * 0.04, 0.04)`, where rounding sometimes makes one too many (n = 7, 14, 28, 56, 57, 111
    to 115, ...), and it stops. DexYCB's recordings have 66 to 76.
    """
    return n_keys >= FEWEST_KEYS and math.ceil(n_keys * _KEY_PERIOD / _KEY_PERIOD) == n_keys


@dataclass(frozen=True)
class Span:
    """Consecutive key poses of a recording, from `first` to `last` inclusive."""

    first: int
    last: int

    @property
    def n_keys(self) -> int:
        """Number of key poses."""
        return self.last - self.first + 1

    @property
    def frames(self) -> slice:
        """The frames of 1 ms from the first to the last key pose."""
        return slice(STRIDE * self.first, STRIDE * self.last + 1)

    def positions(self, keys: Float32) -> Float32:
        """Positions (m) of all frames of the span.

        Args:
            keys: (n_keys, 3) positions at the key poses.
        """
        axes = [splev(self._times(), splrep(self._key_times(), keys[:, axis])) for axis in range(keys.shape[1])]
        return np.stack(axes, axis=1).astype(np.float32)

    def rotations(self, keys: Float32) -> Rotation:
        """Rotations of all frames of the span, as float32 quaternions tell them.

        Args:
            keys: (n_keys, 4) quaternions xyzw at the key poses, of any length but zero.
        """
        turned = Slerp(self._key_times(), Rotation.from_quat(keys))(self._times())
        return Rotation.from_quat(turned.as_quat().astype(np.float32))

    # Times count from the recording's start, since a difference of times depends on both by its last bit.
    def _key_times(self) -> npt.NDArray[np.float64]:
        return np.arange(self.first, self.last + 1, dtype=np.float64) * _KEY_PERIOD

    def _times(self) -> npt.NDArray[np.float64]:
        return np.arange(self.frames.start, self.frames.stop, dtype=np.float64) * _PERIOD


def n_frames(n_keys: int) -> int:
    """Number of frames of 1 ms of a recording of `n_keys` key poses."""
    return STRIDE * (n_keys - 1) + 1
