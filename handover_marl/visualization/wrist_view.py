"""Image of an episode above the images of the wrist camera."""

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageColor

from handover_marl.config import CameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.simulation.camera.images import LABEL_COLORS, SegmentationLabel
from handover_marl.simulation.camera.optics import FAR

Picture = npt.NDArray[np.uint8]

_PALETTE = np.array([ImageColor.getrgb(LABEL_COLORS[label]) for label in SegmentationLabel], dtype=np.uint8)


def draw_wrist_view(episode: Episode, camera: CameraConfig) -> Picture:
    """Return an RGB image (h, w, 3): an outside view above colours, depth and segmentation of the wrist camera.

    The depth is brighter the nearer it is, and black from 2 m on.

    Args:
        episode: Episode, whose current state is drawn.
        camera: Outside camera.
    """
    frame = episode.capture_wrist_camera()
    depth = np.clip(255.0 * (1.0 - frame.depth / FAR), 0.0, 255.0).astype(np.uint8)
    images = (frame.rgb, np.stack([depth] * 3, axis=-1), _PALETTE[frame.segmentation])
    side = camera.width // len(images)
    strip = np.full((side, camera.width, 3), 255, dtype=np.uint8)
    for number, image in enumerate(images):
        resized = Image.fromarray(image).resize((side, side), Image.Resampling.NEAREST)
        strip[:, number * side : (number + 1) * side] = np.asarray(resized)
    picture: Picture = np.concatenate([episode.render(camera), strip])
    # H.264 videos need an even number of pixels a side.
    return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
