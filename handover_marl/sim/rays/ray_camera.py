"""The wrist camera's pictures by casting rays at the visual meshes of a scene.

Only rays that can meet something are cast: those through pixels that a triangle's outline reaches, and at what may
stand in the way of object and hand only the rays that met these.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.models.panda import HAND_LINK
from handover_marl.sim.camera.optics import PINHOLE
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.rays.ray_body import Parts, ray_body
from handover_marl.sim.rays.sheet import Sheet
from handover_marl.sim.world import Snapshot

# The camera's axes (right, down, ahead) in the hand link's frame, as columns.
_HAND_FROM_CAMERA = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_NO_JOINTS = np.zeros(0, dtype=np.float32)


class RayCamera:
    """Takes pictures of one scene.

    Args:
        assets: The bodies' models.
        config: Where robot and table stand.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """

    def __init__(self, assets: SceneAssets, config: PhysicsConfig) -> None:
        panda = config.panda
        self._panda = ray_body(assets.panda, Seen.ROBOT, (*panda.base_position, *panda.base_orientation))
        self._hand_link = self._panda.names.index(HAND_LINK)
        self._table = ray_body(assets.table, Seen.TABLE, (*config.table_position, 0.0, 0.0, 0.0, 1.0))
        kinds = [Seen.TARGET, *[Seen.OTHER_OBJECT] * (len(assets.objects) - 1)]
        self._objects = [ray_body(urdf, seen) for urdf, seen in zip(assets.objects, kinds, strict=True)]
        self._hand = ray_body(assets.hand, Seen.HAND)

    def photograph(self, now: Snapshot, color: bool) -> Photo:
        """The whole picture.

        Args:
            now: Where everything is.
            color: Whether colours are wanted; they are those of the models' materials, without textures.
        """
        sheet = Sheet(*self._camera_frame(now), color)
        sheet.add_ground()
        for parts in [*self._sought(now), *self._in_the_way(now)]:
            sheet.add(parts)
        return sheet.photo()

    def sought(self, now: Snapshot) -> Photo:
        """Only what is seen of the given object and the hand; all else is background."""
        sheet = Sheet(*self._camera_frame(now))
        # Where the second one hid the first, a pixel is told twice, which does no harm.
        found = np.concatenate([sheet.add(parts) for parts in self._sought(now)])
        found = sheet.hide_below_ground(found)
        corners = sheet.corners(found)
        for parts in self._in_the_way(now):
            found = sheet.hide_behind(parts, found, corners)
        return sheet.photo()

    def _camera_frame(self, now: Snapshot) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        turn, origin = self._panda.frame(self._hand_link, now.robot)
        return turn @ _HAND_FROM_CAMERA, origin + turn @ np.array(PINHOLE)

    def _sought(self, now: Snapshot) -> list[Parts]:
        """The given object and the hand."""
        hand = [] if now.hand is None else [self._hand.parts(now.hand)]
        return [self._objects[0].parts(now.objects[0]), *hand]

    def _in_the_way(self, now: Snapshot) -> list[Parts]:
        others = [body.parts(joints) for body, joints in zip(self._objects[1:], now.objects[1:], strict=True)]
        return [self._panda.parts(now.robot), *others, self._table.parts(_NO_JOINTS)]
