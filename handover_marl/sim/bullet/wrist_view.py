"""The wrist camera's pictures as Bullet's software renderer draws them.

The same with or without a screen or graphics driver, and to the bit what the reference sees.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.models.poses import quaternion_multiply
from handover_marl.sim.bullet.client import BulletClient
from handover_marl.sim.bullet.panda_body import Panda
from handover_marl.sim.camera.optics import FAR, FIELD_OF_VIEW, NEAR, SIDE, metric_depth
from handover_marl.sim.camera.photo import Photo, Seen

# The renderer looks along negative z with y up: that turn from the camera's link in URDF, with the zeros as rounded
# by the reference.
_LINK_FROM_VIEW = np.array([-4.3297803e-17, -0.70710677, -0.70710677, 4.3297803e-17], dtype=np.float32)


def photograph(client: BulletClient, panda: Panda, bodies: Mapping[int, Seen], color: bool) -> Photo:
    """What the camera shows now.

    Args:
        client: The physics server.
        panda: The robot that carries the camera.
        bodies: What each body is seen as; others are background.
        color: Whether colours are wanted.
    """
    # The camera's body ends before the near plane, so that it never shows; drawing it would be most of the work.
    with panda.without_camera():
        width, height, pixels, buffer, numbers = client.getCameraImage(
            SIDE,
            SIDE,
            viewMatrix=_view_matrix(client, panda.camera_pose()),
            projectionMatrix=client.computeProjectionMatrixFOV(FIELD_OF_VIEW, 1.0, NEAR, FAR),
            renderer=client.ER_TINY_RENDERER,
        )
    shape = (height, width)
    rgba = np.asarray(pixels, dtype=np.uint8).reshape(*shape, 4) if color else None
    return Photo(
        depth=metric_depth(np.array(buffer, dtype=np.float32).reshape(shape)),
        segmentation=_named(np.asarray(numbers).reshape(shape), bodies),
        rgb=None if rgba is None else rgba[..., :3].copy(),
    )


def seen_bodies(table: int, panda: int, objects: Sequence[int], hand: int | None) -> dict[int, Seen]:
    """What the bodies of these numbers are seen as; of the objects the first is the one handed over."""
    bodies = {table: Seen.TABLE, panda: Seen.ROBOT, **dict.fromkeys(objects, Seen.OTHER_OBJECT)}
    bodies[objects[0]] = Seen.TARGET
    return bodies if hand is None else {**bodies, hand: Seen.HAND}


def _named(numbers: npt.NDArray[np.int32], bodies: Mapping[int, Seen]) -> npt.NDArray[np.uint8]:
    names = np.full(max(*bodies, int(numbers.max()), 0) + 2, Seen.BACKGROUND, dtype=np.uint8)
    for body, seen in bodies.items():
        names[body] = seen
    # Nothing at all is -1, and so the last entry.
    named: npt.NDArray[np.uint8] = names[numbers]
    return named


def _view_matrix(client: BulletClient, world_from_link: npt.NDArray[np.float32]) -> list[float]:
    """Column by column, rounded where the reference rounds."""
    turn = quaternion_multiply(world_from_link[3:], _LINK_FROM_VIEW)
    axes = np.array(client.getMatrixFromQuaternion(turn.tolist()), dtype=np.float32).reshape(3, 3)
    x, y, z = world_from_link[:3]
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = axes
    # Summed in this order without fused steps, as a matrix product need not be.
    matrix[3, :3] = -((x * axes[0] + y * axes[1]) + z * axes[2])
    return list(map(float, matrix.ravel()))
