"""A picture in the making, body after body."""

import numpy as np
import numpy.typing as npt

from handover_marl.sim.camera.optics import CENTER, FAR, NEAR, NOTHING, SAMPLED_AT, SIDE
from handover_marl.sim.camera.photo import Photo, Seen
from handover_marl.sim.rays.outline import Pixels, outlined_pixels, pixels_within
from handover_marl.sim.rays.ray_body import Parts

Array = npt.NDArray[np.float32]

_NONE = np.zeros(0, dtype=np.int64)
# Where light comes from in the world, and how bright a face is that turns away from it.
_LIGHT, _SHADE = np.array([0.22, -0.44, 0.87]), 0.5
_SKY, _GROUND = (255, 255, 255), (150, 150, 150)
# What is seen lies beyond six planes; these are their normals, inwards, and distances: near, far and four sides.
_FRUSTUM = np.array([[0, 0, 1], [0, 0, -1], [-1, 0, 1], [1, 0, 1], [0, -1, 1], [0, 1, 1]], dtype=np.float32)
# At the sides a little further out, since sampled places lie up to a pixel beside the middle.
_FRUSTUM_STARTS = np.array([NEAR, -FAR, -0.02, -0.02, -0.02, -0.02], dtype=np.float32)


def _ways() -> Array:
    """(50176, 3) directions of the pixels' rays in the camera's frame, with z = 1."""
    columns, rows = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    right, down = columns + SAMPLED_AT[0] - CENTER, rows + SAMPLED_AT[1] - CENTER
    ways = np.stack([right / CENTER, down / CENTER, np.ones((SIDE, SIDE))], axis=-1)
    return ways.reshape(-1, 3).astype(np.float32)


class Sheet:
    """A picture; pixels are told by their numbers, row by row.

    Args:
        turn: (3, 3) the camera's axes (right, down, ahead) in the world.
        eye: (3,) the pinhole in the world (m).
        color: Whether it has colours.
    """

    _WAYS = _ways()

    def __init__(self, turn: npt.NDArray[np.float64], eye: npt.NDArray[np.float64], color: bool = False) -> None:
        self._turn, self._eye = turn, eye
        self._depth = np.full(SIDE * SIDE, NOTHING, dtype=np.float32)
        self._seen = np.full(SIDE * SIDE, Seen.BACKGROUND, dtype=np.uint8)
        self._rgb = np.full((SIDE * SIDE, 3), _SKY, dtype=np.uint8) if color else None

    def add_ground(self) -> None:
        """Draw the ground, the plane z = 0."""
        down = self._WAYS @ self._turn[2].astype(np.float32)
        with np.errstate(divide="ignore"):
            depth = np.float32(-self._eye[2]) / down
        met = (depth > NEAR) & (depth < NOTHING)
        self._depth[met] = depth[met]
        if self._rgb is not None:
            self._rgb[met] = _GROUND

    def add(self, parts: Parts) -> Pixels:
        """Draw a body and tell the pixels that now show it; one that two of its links showed in turn comes twice."""
        body = parts.body
        turns, shifts = self._frames(parts)
        sides = _FRUSTUM @ turns
        farthest_in = np.maximum(sides * body.lowest[:, None], sides * body.highest[:, None]).sum(axis=-1)
        shown = np.flatnonzero((farthest_in + shifts @ _FRUSTUM.T > _FRUSTUM_STARTS).all(axis=1)).tolist()
        if not shown:
            return _NONE
        points = [body.meshes[link].vertices @ turns[link].T + shifts[link] for link in shown]
        # All links at once, since there may be many small ones.
        pixels = outlined_pixels(np.concatenate(points), body.faces(tuple(shown)))
        shares = [pixels] if len(shown) == 1 else pixels_within(pixels, points)
        frames = [(turns[link], shifts[link]) for link in shown]
        drawn = [
            self._draw(parts, link, frame, share) for link, frame, share in zip(shown, frames, shares, strict=True)
        ]
        return np.concatenate(drawn)

    def hide_behind(self, parts: Parts, pixels: Pixels, corners: Array) -> Pixels:
        """Take away what is seen behind a body, and tell the pixels of these that are left.

        Args:
            parts: The body.
            pixels: What is seen.
            corners: Of what lies before these pixels.
        """
        if not len(pixels):
            return pixels
        body = parts.body
        turns, shifts = self._frames(parts)
        own = (corners - shifts[:, None]) @ turns
        between = (own.max(axis=1) >= body.lowest) & (own.min(axis=1) <= body.highest)
        for link in np.flatnonzero(between.all(axis=1)).tolist():
            near = pixels[self._meet_box(pixels, turns[link], shifts[link], body.lowest[link], body.highest[link])]
            hidden = self._draw(parts, link, (turns[link], shifts[link]), near)
            self._depth[hidden], self._seen[hidden] = NOTHING, Seen.BACKGROUND
            pixels = pixels[self._seen[pixels] != Seen.BACKGROUND] if len(hidden) else pixels
        return pixels

    def hide_below_ground(self, pixels: Pixels) -> Pixels:
        """Take away what is seen below the plane z = 0, and tell the pixels of these that are left."""
        heights = self._eye[2] + self._depth[pixels] * (self._WAYS[pixels] @ self._turn[2])
        below = heights < 0.0
        hidden = pixels[below]
        self._depth[hidden], self._seen[hidden] = NOTHING, Seen.BACKGROUND
        left: Pixels = pixels[~below]
        return left

    def corners(self, pixels: Pixels) -> Array:
        """(8, 3) corners, in the camera's frame, of what lies between the near plane and what some pixels show."""
        if not len(pixels):
            return np.zeros((0, 3), dtype=np.float32)
        rows, columns = np.divmod(pixels, SIDE)
        ends = [row * SIDE + column for row in (rows.min(), rows.max()) for column in (columns.min(), columns.max())]
        sides = self._WAYS[ends]
        return np.concatenate([sides * np.float32(NEAR), sides * self._depth[pixels].max()])

    def photo(self) -> Photo:
        """The picture."""
        rgb = None if self._rgb is None else self._rgb.reshape(SIDE, SIDE, 3)
        return Photo(self._depth.reshape(SIDE, SIDE), self._seen.reshape(SIDE, SIDE), rgb)

    def _frames(self, parts: Parts) -> tuple[Array, Array]:
        """Axes (n, 3, 3) and origins (n, 3) of a body's links in the camera's frame."""
        turns, shifts = self._turn.T @ parts.turns, (parts.shifts - self._eye) @ self._turn
        return turns.astype(np.float32), shifts.astype(np.float32)

    def _meet_box(
        self, pixels: Pixels, turn: Array, shift: Array, lowest: Array, highest: Array
    ) -> npt.NDArray[np.bool_]:
        """(n,) which pixels' rays meet a box in a link's frame before what they show now."""
        start, ways = -(shift @ turn), self._WAYS[pixels] @ turn
        into, out = np.float32(NEAR), self._depth[pixels]
        with np.errstate(divide="ignore", invalid="ignore"):
            for axis in range(3):
                one, other = ((side[axis] - start[axis]) / ways[:, axis] for side in (lowest, highest))
                # Where a ray does not move along an axis, a start on the very face of the box gives no number.
                into, out = np.fmax(into, np.fmin(one, other)), np.fmin(out, np.fmax(one, other))
        met: npt.NDArray[np.bool_] = into <= out
        return met

    def _draw(self, parts: Parts, link: int, frame: tuple[Array, Array], pixels: Pixels) -> Pixels:
        """Draw a link where it is the nearest of these pixels' rays; tell where that is."""
        if not len(pixels):
            return _NONE
        mesh, (turn, shift) = parts.body.meshes[link], frame
        hits = mesh.cast(-(shift @ turn), self._WAYS[pixels] @ turn, NEAR, self._depth[pixels])
        drawn = pixels[hits.ray]
        self._depth[drawn] = hits.depth
        self._seen[drawn] = parts.body.seen
        if self._rgb is not None:
            self._rgb[drawn] = _shaded(mesh.normals[hits.face], parts, link, hits.face)
        return drawn


def _shaded(normals: Array, parts: Parts, link: int, faces: npt.NDArray[np.int32]) -> npt.NDArray[np.uint8]:
    """(n, 3) colours of faces in the light."""
    toward = normals @ parts.turns[link].T @ _LIGHT / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    light = _SHADE + (1.0 - _SHADE) * np.clip(toward, 0.0, 1.0)
    colors: npt.NDArray[np.uint8] = np.rint(255.0 * parts.body.colors[link][faces] * light[:, None]).astype(np.uint8)
    return colors
