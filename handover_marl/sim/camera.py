"""Pictures of the world, drawn without a screen."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig
from handover_marl.sim.client import BulletClient


def render(client: BulletClient, camera: CameraConfig) -> npt.NDArray[np.uint8]:
    """An RGB picture (height, width, 3) seen by `camera`."""
    view = client.computeViewMatrix(camera.position, camera.target, (0.0, 0.0, 1.0))
    projection = client.computeProjectionMatrixFOV(
        camera.vertical_fov, camera.width / camera.height, camera.near, camera.far
    )
    width, height, pixels, _, _ = client.getCameraImage(
        camera.width,
        camera.height,
        view,
        projection,
        shadow=1,
        lightDirection=(0.5, -1.0, 2.0),
        # The software renderer draws the same with or without a screen or graphics driver.
        renderer=client.ER_TINY_RENDERER,
        flags=client.ER_NO_SEGMENTATION_MASK,
    )
    rgba = np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)
    rgb: npt.NDArray[np.uint8] = rgba[..., :3].copy()
    return rgb
