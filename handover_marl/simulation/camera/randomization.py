"""Domain randomization of cameras, drawn for each camera at the start of each episode."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, bounded
from handover_marl.simulation.camera.images import CameraImage, SegmentationLabel
from handover_marl.simulation.camera.noise import CameraNoise
from handover_marl.simulation.camera.optics import Pinhole, to_rows


@dataclass(frozen=True)
class CameraRandomization(CheckedConfig):
    """Bounds on random deviations of cameras from their configuration, drawn uniformly at the start of each episode.

    The default changes nothing. Calibration matrices and point clouds are computed for the configured camera, so that a
    deviation of the camera is an error of the points.

    Attributes:
        color: Largest relative change of red, green and blue, drawn for each channel and segmentation label.
        brightness: Largest relative change of the light, the same in the whole image.
        position: Largest error of the camera's position along each of its axes (m).
        rotation: Largest error of the orientation (rad), for each component of a rotation vector in the camera's frame.
        focal: Largest relative error of the focal length.
        principal: Largest error of the principal point, right and down (pixels).
        depth_noise_std: Largest addition to `CameraNoise.depth_noise_std` (m at 1 m); the smallest one is 0.
        latency: Largest addition to `CameraNoise.latency` (s); the smallest one is 0.

    Raises:
        OptionError: A value is out of range.
    """

    color: float = bounded(0.0, 0.0, 1.0)
    brightness: float = bounded(0.0, 0.0, 1.0)
    position: float = bounded(0.0, 0.0, 0.1)
    rotation: float = bounded(0.0, 0.0, 0.5)
    focal: float = bounded(0.0, 0.0, 0.5)
    principal: float = bounded(0.0, 0.0, 100.0)
    depth_noise_std: float = bounded(0.0, 0.0, 1.0)
    latency: float = bounded(0.0, 0.0, 1.0)

    def combine(self, other: "CameraRandomization") -> "CameraRandomization":
        """Return a randomization that has, for each attribute, the larger value of this and another one."""
        return CameraRandomization(**{name: max(value, vars(other)[name]) for name, value in vars(self).items()})

    def draw(self, camera: Pinhole, noise: CameraNoise | None, rng: np.random.Generator) -> "CameraDraw":
        """Draw the camera of one episode, given the configured camera and its noise (None for no noise)."""
        # The number of draws is always the same, so that a value does not depend on the other deviations.
        unit = rng.uniform(-1.0, 1.0, 30)
        share = rng.random(2)
        focal, principal = 1.0 + self.focal * unit[0], camera.principal + self.principal * unit[1:3]
        axes, position = np.array(camera.axes), np.array(camera.position)
        if self.position or self.rotation:
            position = position + axes @ (self.position * unit[3:6])
            axes = axes @ Rotation.from_rotvec(self.rotation * unit[6:9]).as_matrix()
        drawn = replace(
            camera,
            focal=(camera.focal[0] * focal, camera.focal[1] * focal),
            principal=tuple(principal.tolist()),
            position=tuple(position.tolist()),
            axes=to_rows(axes),
        )
        gains = (1.0 + self.brightness * unit[9]) * (1.0 + self.color * unit[12:].reshape(len(SegmentationLabel), 3))
        if self.depth_noise_std or self.latency:
            base = noise or CameraNoise(depth_noise_std=0.0, edge_dropout=0.0, latency=0.0)
            std, latency = (np.array([self.depth_noise_std, self.latency]) * share).tolist()
            latency = round(min(base.latency + latency, 1.0), 3)  # whole physics steps
            noise = replace(base, depth_noise_std=base.depth_noise_std + std, latency=latency)
        return CameraDraw(drawn, noise, gains if self.color or self.brightness else None)


_HAND_EYE = CameraRandomization(position=0.01, rotation=math.radians(2.0))
_INTRINSICS = CameraRandomization(focal=0.01, principal=2.24)
#: Calibration errors by names of `CAMERA_NOISE_MODELS`: the camera's position and orientation have errors of 1 cm and 2
#: degrees (root mean square of the norm of three uniform components); focal length and principal point have errors of
#: at most 1 % of the focal length and of the width of an image of 224 pixels.
CALIBRATION_ERRORS = {
    "imperfect": replace(_INTRINSICS, position=_HAND_EYE.position, rotation=_HAND_EYE.rotation),
    "hand_eye": _HAND_EYE,
    "intrinsics": _INTRINSICS,
}


class CameraDraw(NamedTuple):
    """Camera of one episode, as `CameraRandomization.draw` returns it.

    Attributes:
        camera: Optics and pose of the camera.
        noise: Noise of the camera; None for perfect images.
        gains: Factors (6, 3) of red, green and blue by segmentation label; None for no change.
    """

    camera: Pinhole
    noise: CameraNoise | None
    gains: npt.NDArray[np.float64] | None

    def change_colors(self, image: CameraImage) -> CameraImage:
        """Return an image with its colors multiplied by `gains`; without colors or gains, return it unchanged."""
        if image.rgb is None or self.gains is None:
            return image
        rgb = np.minimum(image.rgb * self.gains.astype(np.float32)[image.segmentation], 255.0)
        return replace(image, rgb=rgb.astype(np.uint8))
