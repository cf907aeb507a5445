"""Pictures of the world, drawn without a screen, and the view of PyBullet's window."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig

if TYPE_CHECKING:
    # The client aims its window with this module.
    from handover_marl.sim.bullet.client import BulletClient

# Straight up or down PyBullet's window has no upward direction and shows nothing (degrees).
_STEEPEST = 89.9


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


def aim_window(client: BulletClient, camera: CameraConfig) -> None:
    """Let PyBullet's window look from the camera's position at its target; nothing without a window.

    The window keeps its own size and field of view.
    """
    distance, yaw, pitch = _orbit(camera)
    client.resetDebugVisualizerCamera(distance, yaw, pitch, camera.target)


def _orbit(camera: CameraConfig) -> tuple[float, float, float]:
    """Distance (m), yaw and pitch (degrees) of the camera around its target, as PyBullet counts them.

    At yaw 0 it looks along +y, a positive yaw turns it to the left, a negative pitch downwards.
    """
    x, y, z = (target - position for target, position in zip(camera.target, camera.position, strict=True))
    pitch = math.degrees(math.atan2(z, math.hypot(x, y)))
    return (
        math.hypot(x, y, z),
        math.degrees(math.atan2(-x, y)),
        min(max(pitch, -_STEEPEST), _STEEPEST),
    )


@contextlib.contextmanager
def without_drawing(client: BulletClient) -> Iterator[None]:
    """Keep PyBullet's window from drawing, so that loading is quick and half a world is never seen."""
    client.configureDebugVisualizer(client.COV_ENABLE_RENDERING, 0)
    try:
        yield
    finally:
        client.configureDebugVisualizer(client.COV_ENABLE_RENDERING, 1)
