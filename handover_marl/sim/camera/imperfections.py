"""How depth cameras fall short of perfect ones: noise, holes at edges, delay."""

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.sim.camera.optics import NOTHING
from handover_marl.sim.camera.photo import Photo, Seen


@dataclass(frozen=True)
class CameraImperfections:
    """What is wrong with a camera; the defaults are those of a RealSense D435 as far as they are known.

    Attributes:
        depth_noise: Standard deviation of the depth at 1 m (m); it grows with the square of the depth, as for every
            stereo camera: depth^2 * subpixel / (focal * baseline), see Grunnet-Jepsen et al., "Subpixel linearity
            improvement for Intel RealSense depth camera D400 series" (Intel). A D435 whose pictures are 848 pixels wide
            has a focal length of 450 pixels and a baseline of 0.05 m; with disparities right to 0.08 pixels, which is
            a choice, that is 0.0036 m at 1 m.
        edge_step: Where neighbouring depths differ by more than this (m), there is an edge.
        edge_drop: Share of the pixels beside edges that show nothing. Stereo cameras see nothing where only one of
            their two eyes does; how often that is depends on the scene, and 0.5 is a choice, not a measurement.
        latency: Age of a picture when it arrives (s); 0.05 is a frame and a half at 30 Hz, a choice too.
        every: Of rows and columns each shows only every so many: 2 stands for a camera of 112 x 112 pixels.

    Raises:
        OptionError: A number is impossible.
    """

    depth_noise: float = 0.0036
    edge_step: float = 0.02
    edge_drop: float = 0.5
    latency: float = 0.05
    every: int = 1

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 <= value < math.inf:
                raise OptionError(f"{part.name}={value!r} of a camera must be a number, 0 or more")
        if self.edge_drop > 1.0:
            raise OptionError(f"edge_drop={self.edge_drop} is a share, 0 to 1")
        if not isinstance(self.every, int) or self.every < 1:
            raise OptionError(f"every={self.every!r} of a camera must be a whole number, 1 or more")
        if self.latency > 1.0:
            raise OptionError(f"latency={self.latency} s: a camera that late is of no use; 0 to 1")


#: Cameras by name.
CAMERAS = {"realsense": CameraImperfections()}


def imperfections(camera: str | CameraImperfections | None) -> CameraImperfections | None:
    """What is meant by a name, by imperfections of one's own, or by None, a perfect camera.

    Raises:
        UnknownNameError: There is no camera of that name.
        OptionError: It is none of these.
    """
    if camera is None or isinstance(camera, CameraImperfections):
        return camera
    if isinstance(camera, str):
        if camera not in CAMERAS:
            raise UnknownNameError("camera", camera, CAMERAS)
        return CAMERAS[camera]
    raise OptionError(f"imperfections={camera!r}: give a name ({', '.join(CAMERAS)}), CameraImperfections, or None")


def worsened(photo: Photo, camera: CameraImperfections, rng: np.random.Generator) -> Photo:
    """A perfect picture as a camera would have taken it.

    Args:
        photo: The perfect one.
        camera: The camera.
        rng: What noise is drawn from.
    """
    # Both are drawn whole, so that what is drawn does not depend on what is seen.
    noise = rng.standard_normal(photo.depth.shape, dtype=np.float32)
    chance = rng.random(photo.depth.shape, dtype=np.float32)
    depth = photo.depth + np.float32(camera.depth_noise) * photo.depth**2 * noise
    lost = _beside_edges(photo.depth, camera.edge_step) & (chance < camera.edge_drop)
    shown = np.zeros_like(lost)
    shown[:: camera.every, :: camera.every] = True
    lost |= ~shown
    empty = lost | (photo.depth >= NOTHING)
    return Photo(
        # What is seen stays before what is not, however much noise there is.
        np.where(empty, NOTHING, np.clip(depth, np.float32(0.0), np.nextafter(NOTHING, np.float32(0.0)))),
        np.where(lost, np.uint8(Seen.BACKGROUND), photo.segmentation),
        photo.rgb,
    )


def _beside_edges(depth: npt.NDArray[np.float32], step: float) -> npt.NDArray[np.bool_]:
    beside = np.zeros(depth.shape, dtype=bool)
    for axis in range(2):
        jump = np.abs(np.diff(depth, axis=axis)) > step
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        beside[tuple(first)] |= jump
        beside[tuple(second)] |= jump
    return beside
