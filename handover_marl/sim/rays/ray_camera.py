"""The wrist camera's pictures by casting rays at the visual meshes of a scene.

Only rays that can meet something are cast: those through pixels that a triangle's outline reaches, and at what may
stand in the way of object and hand only the rays that met these.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.models.panda import HAND_LINK
from handover_marl.sim.camera.optics import CENTER, FAR, NEAR, NOTHING, PINHOLE, SAMPLED_AT, SIDE
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.rays.ray_body import Placed, ray_body
from handover_marl.sim.rays.ray_mesh import Pixels
from handover_marl.sim.world import Snapshot

# The camera's axes (right, down, ahead) in the hand link's frame, as columns.
_HAND_FROM_CAMERA = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# Where light comes from in the world, and how bright a face is that turns away from it.
_LIGHT, _SHADE = np.array([0.22, -0.44, 0.87]), 0.5
_SKY, _GROUND = (255, 255, 255), (150, 150, 150)


def _ways() -> npt.NDArray[np.float32]:
    """(50176, 3) directions of the pixels' rays in the camera's frame, with z = 1."""
    columns, rows = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    right, down = columns + SAMPLED_AT[0] - CENTER, rows + SAMPLED_AT[1] - CENTER
    return np.stack([right / CENTER, down / CENTER, np.ones((SIDE, SIDE))], axis=-1).reshape(-1, 3).astype(np.float32)


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
        self._hand_link = [joint.link for joint in self._panda.tree.joints].index(HAND_LINK)
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
        sheet = _Sheet(*self._camera_frame(now), color)
        sheet.add_ground()
        for placed in [*self._sought(now), *self._in_the_way(now)]:
            sheet.add(placed)
        return sheet.photo()

    def sought(self, now: Snapshot) -> Photo:
        """Only what is seen of the given object and the hand; all else is background."""
        sheet = _Sheet(*self._camera_frame(now))
        # Where the second one hid the first, a pixel is told twice, which does no harm.
        found = np.concatenate([sheet.add(placed) for placed in self._sought(now)])
        for placed in self._in_the_way(now):
            found = sheet.hide_behind(placed, found)
        return sheet.photo()

    def _camera_frame(self, now: Snapshot) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        turn, origin = self._panda.frames(now.robot)[self._hand_link]
        return turn @ _HAND_FROM_CAMERA, origin + turn @ np.array(PINHOLE)

    def _sought(self, now: Snapshot) -> list[Placed]:
        hand = [] if now.hand is None else self._hand.placed(now.hand)
        return [*self._objects[0].placed(now.objects[0]), *hand]

    def _in_the_way(self, now: Snapshot) -> list[Placed]:
        others = [
            placed
            for body, joints in zip(self._objects[1:], now.objects[1:], strict=True)
            for placed in body.placed(joints)
        ]
        return [*self._panda.placed(now.robot), *others, *self._table.placed(np.zeros(0, dtype=np.float32))]


class _Sheet:
    """A picture in the making; pixels are told by their numbers, row by row.

    Args:
        turn: (3, 3) the camera's axes in the world.
        eye: (3,) the pinhole in the world (m).
        color: Whether it has colours.
    """

    _WAYS = _ways()

    def __init__(self, turn: npt.NDArray[np.float64], eye: npt.NDArray[np.float64], color: bool = False) -> None:
        self._turn, self._eye = turn, eye
        self._depth = np.full(SIDE * SIDE, np.inf, dtype=np.float32)
        self._seen = np.full(SIDE * SIDE, Seen.BACKGROUND, dtype=np.uint8)
        self._rgb = np.full((SIDE * SIDE, 3), _SKY, dtype=np.uint8) if color else None

    def add_ground(self) -> None:
        """Draw the ground, the plane z = 0."""
        down = self._WAYS @ self._turn[2].astype(np.float32)
        with np.errstate(divide="ignore"):
            depth = np.float32(-self._eye[2]) / down
        met = (depth > NEAR) & (depth <= FAR)
        self._depth[met] = depth[met]
        if self._rgb is not None:
            self._rgb[met] = _GROUND

    def add(self, placed: Placed) -> Pixels:
        """Draw a mesh and tell the pixels that now show it."""
        frame = self._frame(placed)
        if not placed.mesh.may_show(*frame):
            return np.zeros(0, dtype=np.int64)
        return self._draw(placed, frame, placed.mesh.pixels(*frame))

    def hide_behind(self, placed: Placed, pixels: Pixels) -> Pixels:
        """Take away what is seen behind a mesh, and tell the pixels of these that are left."""
        frame = self._frame(placed)
        if not len(pixels) or not placed.mesh.may_show(*frame):
            return pixels
        hidden = self._draw(placed, frame, pixels)
        self._depth[hidden], self._seen[hidden] = np.inf, Seen.BACKGROUND
        return pixels[self._seen[pixels] != Seen.BACKGROUND] if len(hidden) else pixels

    def photo(self) -> Photo:
        """The picture."""
        depth = np.where(np.isinf(self._depth), NOTHING, self._depth).reshape(SIDE, SIDE)
        rgb = None if self._rgb is None else self._rgb.reshape(SIDE, SIDE, 3)
        return Photo(depth, self._seen.reshape(SIDE, SIDE), rgb)

    def _frame(self, placed: Placed) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        turn = self._turn.T @ placed.turn
        return turn.astype(np.float32), (self._turn.T @ (placed.shift - self._eye)).astype(np.float32)

    def _draw(
        self, placed: Placed, frame: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]], pixels: Pixels
    ) -> Pixels:
        """Draw a mesh where it is the nearest of these pixels' rays; tell where that is."""
        hits = placed.mesh.cast(*frame, self._WAYS[pixels], np.minimum(self._depth[pixels], np.float32(FAR)))
        nearer = hits.depth < self._depth[pixels]
        drawn, faces = pixels[nearer], hits.face[nearer]
        self._depth[drawn] = hits.depth[nearer]
        self._seen[drawn] = placed.seen
        if self._rgb is not None:
            normals = placed.mesh.normals[faces] @ placed.turn.T
            toward = normals @ _LIGHT / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
            light = _SHADE + (1.0 - _SHADE) * np.clip(toward, 0.0, 1.0)
            self._rgb[drawn] = np.rint(255.0 * placed.colors[faces] * light[:, None])
        return drawn
