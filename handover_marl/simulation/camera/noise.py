"""Noise model of depth cameras: depth noise, missing edge pixels, low resolution, latency."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import generate_binary_structure, maximum_filter, minimum_filter

from handover_marl.config import CheckedConfig, bounded
from handover_marl.errors import OptionError, check_name
from handover_marl.simulation.camera.images import CameraImage, SegmentationLabel
from handover_marl.simulation.camera.optics import WRIST_CAMERA, Pinhole


@dataclass(frozen=True)
class CameraNoise(CheckedConfig):
    """Parameters of a depth camera's noise; the defaults approximate an Intel RealSense D435.

    Attributes:
        depth_noise_std: Standard deviation of the depth at 1 m (m). It grows with the squared depth, as for all stereo
            cameras: depth^2 * subpixel / (focal * baseline), see Grunnet-Jepsen et al., "Subpixel linearity improvement
            for Intel RealSense depth camera D400 series" (Intel). A D435 with images 848 pixels wide has a focal length
            of 450 pixels and a baseline of 0.05 m; an assumed subpixel error of 0.08 gives 0.0036 m.
        edge_threshold: Depth difference of neighboring pixels that counts as an edge (m).
        edge_dropout: Share of the pixels beside depth edges that lose their depth, because only one of a stereo
            camera's two imagers sees the surface there. The share depends on the scene; 0.5 is an assumption.
        latency: Age of an image when it arrives (s, whole ms); the assumed 0.05 s are 1.5 frames at 30 Hz.
        pixel_stride: Distance between rows and columns that have depth: 2 simulates a camera of half the resolution.

    Raises:
        OptionError: A value is out of range.
    """

    depth_noise_std: float = bounded(0.0036, 0.0)
    edge_threshold: float = bounded(0.02, 0.0)
    edge_dropout: float = bounded(0.5, 0.0, 1.0)
    latency: float = bounded(0.05, 0.0, 1.0, in_steps=True)
    pixel_stride: int = bounded(1, 1)


_EXACT = CameraNoise(depth_noise_std=0.0, edge_dropout=0.0, latency=0.0)
#: Noise models by name: "realsense"; "imperfect", which adds calibration errors; and the parts of "imperfect", each
#: alone. The calibration errors of "imperfect", "hand_eye" and "intrinsics" are in `CALIBRATION_ERRORS`.
CAMERA_NOISE_MODELS = {
    "realsense": CameraNoise(),
    "imperfect": CameraNoise(latency=0.06),
    "depth_noise": CameraNoise(latency=0.0),
    "latency": replace(_EXACT, latency=0.06),
    "hand_eye": _EXACT,
    "intrinsics": _EXACT,
}


def resolve_camera_noise(camera_noise: str | CameraNoise | None) -> CameraNoise | None:
    """Return the noise with a name of `CAMERA_NOISE_MODELS`; return a `CameraNoise` or None (no noise) unchanged."""
    if camera_noise is None or isinstance(camera_noise, CameraNoise):
        return camera_noise
    if isinstance(camera_noise, str):
        check_name("camera_noise", camera_noise, CAMERA_NOISE_MODELS)
        return CAMERA_NOISE_MODELS[camera_noise]
    raise OptionError(
        f"camera_noise must be a name ({', '.join(CAMERA_NOISE_MODELS)}), a CameraNoise or None, got {camera_noise!r}"
    )


def apply_camera_noise(
    image: CameraImage, noise: CameraNoise, rng: np.random.Generator, camera: Pinhole = WRIST_CAMERA
) -> CameraImage:
    """Return a copy of an image with depth noise, and with pixels that lose their depth as background.

    Args:
        image: Noise-free image.
        noise: Parameters of the noise, of which the latency has no effect here.
        rng: Random generator; the number of its draws does not depend on the image's content.
        camera: Camera of the image.
    """
    empty = camera.empty_depth
    normal = rng.standard_normal(image.depth.shape, dtype=np.float32)
    uniform = rng.random(image.depth.shape, dtype=np.float32)
    depth = image.depth + np.float32(noise.depth_noise_std) * image.depth**2 * normal
    is_lost = _find_edges(image.depth, noise.edge_threshold) & (uniform < noise.edge_dropout)
    is_sampled = np.zeros_like(is_lost)
    is_sampled[:: noise.pixel_stride, :: noise.pixel_stride] = True
    is_lost |= ~is_sampled
    is_empty = is_lost | (image.depth >= empty)
    # Clipped below the value of background pixels, however large the noise.
    highest = np.nextafter(empty, np.float32(0.0))
    return CameraImage(
        np.where(is_empty, empty, np.clip(depth, np.float32(0.0), highest)),
        np.where(is_lost, np.uint8(SegmentationLabel.BACKGROUND), image.segmentation),
        image.rgb,
    )


def _find_edges(depth: npt.NDArray[np.float32], threshold: float) -> npt.NDArray[np.bool_]:
    """Return a mask (h, w) of the pixels whose depth differs from a neighbor's depth by more than a threshold (m)."""
    cross = generate_binary_structure(2, 1)
    highest, lowest = maximum_filter(depth, footprint=cross), minimum_filter(depth, footprint=cross)
    is_edge: npt.NDArray[np.bool_] = (highest - depth > threshold) | (depth - lowest > threshold)
    return is_edge
