"""Renderer of the wrist camera by ray casting, and its framebuffer: depth, segmentation labels and colours.

Rays are cast only through the pixels of a rectangle around each link. If only object and hand are rendered, the other
bodies are tested only against rays that hit the object or the hand.
"""

import itertools

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import (
    AMBIENT,
    CAMERA_POSITION_IN_HAND,
    DIFFUSE,
    EMPTY_DEPTH,
    FAR,
    GROUND,
    HALF_SIZE_PX,
    HAND_FROM_CAMERA,
    IMAGE_SIZE,
    LIGHT,
    N_PIXELS,
    NEAR,
    SAMPLE_OFFSET_PX,
    SKY,
    SPECULAR,
)
from handover_marl.simulation.camera.ray_body import RayBody, load_ray_body

Array = npt.NDArray[np.float32]
#: Numbers of pixels in image order.
Pixels = npt.NDArray[np.int64]

_NO_PIXELS = np.zeros(0, dtype=np.int64)
# Numbers of the pixels by row and column.
_PIXELS = np.arange(N_PIXELS).reshape(IMAGE_SIZE, IMAGE_SIZE)
# Whether each of a box's eight corners is on its higher side, by axis.
_IS_HIGH = np.array(list(itertools.product((False, True), repeat=3)))
# Added around rectangles (pixels), larger than the rounding error of the projection.
_MARGIN = 0.01
# Principal point, in pixel numbers.
_PRINCIPAL_POINT = HALF_SIZE_PX - np.array(SAMPLE_OFFSET_PX, dtype=np.float32)


def _compute_ray_directions() -> Array:
    """Return the ray directions (50176, 3) of all pixels in the camera's frame, with z = 1."""
    columns, rows = np.meshgrid(np.arange(IMAGE_SIZE), np.arange(IMAGE_SIZE))
    right, down = columns + SAMPLE_OFFSET_PX[0] - HALF_SIZE_PX, rows + SAMPLE_OFFSET_PX[1] - HALF_SIZE_PX
    directions = np.stack([right / HALF_SIZE_PX, down / HALF_SIZE_PX, np.ones((IMAGE_SIZE, IMAGE_SIZE))], axis=-1)
    return directions.reshape(-1, 3).astype(np.float32)


_RAYS = _compute_ray_directions()


class Framebuffer:
    """Depth, segmentation labels and colours of one wrist-camera image during ray casting.

    Pixels are numbered row by row.

    Args:
        rotation: (3, 3) axes of the camera (right, down, ahead) in the world, as columns.
        position: (3,) world position of the pinhole (m).
        color: Whether the image has colours.
    """

    def __init__(
        self, rotation: npt.NDArray[np.float64], position: npt.NDArray[np.float64], color: bool = False
    ) -> None:
        self._rotation, self._position = rotation, position
        self._depth = np.full(N_PIXELS, EMPTY_DEPTH, dtype=np.float32)
        self._labels = np.full(N_PIXELS, SegmentationLabel.BACKGROUND, dtype=np.uint8)
        self._rgb = np.full((N_PIXELS, 3), SKY, dtype=np.uint8) if color else None

    def add_ground(self) -> None:
        """Draw the ground plane z = 0 of the world frame."""
        descent = _RAYS @ self._rotation[2].astype(np.float32)
        with np.errstate(divide="ignore"):
            depth = np.float32(-self._position[2]) / descent
        is_hit = (depth > NEAR) & (depth < EMPTY_DEPTH)
        self._depth[is_hit] = depth[is_hit]
        if self._rgb is not None:
            places = self._position + self._depth[is_hit, None] * (_RAYS[is_hit] @ self._rotation.T)
            squares = np.floor(places[:, :2]).astype(np.int64).sum(axis=1) % 2
            self._rgb[is_hit] = _shade(np.array(GROUND)[squares], np.array([0.0, 0.0, 1.0]))

    def add(self, body: RayBody, joints: Array) -> Pixels:
        """Draw a body at joint positions (d,) (m, rad) and return the numbers of the changed pixels.

        A pixel that two links of the body changed one after the other occurs twice.
        """
        rotations, origins = self._compute_mesh_frames(body, joints)
        columns, rows, is_cut = _bound_boxes(body, rotations, origins)
        drawn = [_NO_PIXELS]
        for link in np.flatnonzero((columns[:, 0] < columns[:, 1]) & (rows[:, 0] < rows[:, 1])).tolist():
            pixels, frame = _PIXELS[slice(*rows[link]), slice(*columns[link])].ravel(), (rotations[link], origins[link])
            if is_cut[link]:
                # The rectangle is the whole image.
                pixels = pixels[self._is_box_hit(pixels, frame, body.lowest[link], body.highest[link])]
            drawn.append(self._draw_link(body, link, frame, pixels))
        return np.concatenate(drawn)

    def remove_occluded_by(self, body: RayBody, joints: Array, pixels: Pixels) -> Pixels:
        """Clear the given pixels that a body at joint positions (d,) occludes; return the other given pixels."""
        rotations, origins = self._compute_mesh_frames(body, joints)
        columns, rows, _ = _bound_boxes(body, rotations, origins)
        for link, frame in enumerate(zip(rotations, origins, strict=True)):
            row, column = np.divmod(pixels, IMAGE_SIZE)
            is_inside = (row >= rows[link, 0]) & (row < rows[link, 1])
            near = pixels[is_inside & (column >= columns[link, 0]) & (column < columns[link, 1])]
            if len(near):
                near = near[self._is_box_hit(near, frame, body.lowest[link], body.highest[link])]
                self._clear(self._draw_link(body, link, frame, near))
                pixels = pixels[self._labels[pixels] != SegmentationLabel.BACKGROUND]
        return pixels

    def remove_below_ground(self, pixels: Pixels) -> Pixels:
        """Clear the given pixels whose points are below the ground, world z = 0; return the other given pixels."""
        heights = self._position[2] + self._depth[pixels] * (_RAYS[pixels] @ self._rotation[2])
        is_below = heights < 0.0
        self._clear(pixels[is_below])
        remaining: Pixels = pixels[~is_below]
        return remaining

    def to_image(self) -> CameraImage:
        """Return the content of the framebuffer as a wrist-camera image."""
        shape = (IMAGE_SIZE, IMAGE_SIZE)
        rgb = None if self._rgb is None else self._rgb.reshape(*shape, 3)
        return CameraImage(self._depth.reshape(shape), self._labels.reshape(shape), rgb)

    def _compute_mesh_frames(self, body: RayBody, joints: Array) -> tuple[Array, Array]:
        """Return rotations (n, 3, 3) and origins (n, 3) of a body's meshes in the camera frame."""
        rotations, origins = body.compute_mesh_frames(joints)
        turns, places = self._rotation.T @ rotations, (origins - self._position) @ self._rotation
        return turns.astype(np.float32), places.astype(np.float32)

    def _is_box_hit(
        self, pixels: Pixels, frame: tuple[Array, Array], lowest: Array, highest: Array
    ) -> npt.NDArray[np.bool_]:
        """Return a mask (n,) of the pixels (n,) whose rays hit a box nearer than the point drawn so far.

        `lowest` and `highest` (3,) are the box's corners in the frame of a link, which `frame` has in the camera's.
        """
        rotation, origin = frame
        start, directions = -(origin @ rotation), _RAYS[pixels] @ rotation
        enter, leave = np.float32(NEAR), self._depth[pixels]
        with np.errstate(divide="ignore", invalid="ignore"):
            for axis in range(3):
                one, other = ((side[axis] - start[axis]) / directions[:, axis] for side in (lowest, highest))
                # fmin and fmax ignore the NaN of a ray that lies in a face of the box.
                enter, leave = np.fmax(enter, np.fmin(one, other)), np.fmin(leave, np.fmax(one, other))
        is_hit: npt.NDArray[np.bool_] = enter <= leave
        return is_hit

    def _draw_link(self, body: RayBody, link: int, frame: tuple[Array, Array], pixels: Pixels) -> Pixels:
        """Draw a link on those of the given pixels where it is nearest to the camera; return the changed pixels."""
        if not len(pixels):
            return _NO_PIXELS
        mesh, (rotation, origin) = body.meshes[link], frame
        hits = mesh.cast_rays(-(origin @ rotation), _RAYS[pixels] @ rotation, NEAR, self._depth[pixels])
        drawn = pixels[hits.ray]
        self._depth[drawn] = hits.depth
        self._labels[drawn] = body.label
        if self._rgb is not None:
            colors = body.surfaces[link].sample(hits.face, hits.weights)
            self._rgb[drawn] = _shade(colors, mesh.normals[hits.face] @ (self._rotation @ rotation).T)
        return drawn

    def _clear(self, pixels: Pixels) -> None:
        self._depth[pixels], self._labels[pixels] = EMPTY_DEPTH, SegmentationLabel.BACKGROUND


def _bound_boxes(
    body: RayBody, rotations: Array, origins: Array
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the rectangles of pixels that contain a body's meshes, given their frames in the camera's frame.

    Returns:
        First columns and those after the last (n, 2); first rows and those after the last (n, 2), empty outside the
        depth range; and whether boxes reach the near plane (n,), whose rectangles are the whole image.
    """
    boxes = np.where(_IS_HIGH, body.highest[:, None], body.lowest[:, None]) @ rotations.swapaxes(1, 2)
    corners = boxes + origins[:, None]
    nearest, farthest = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
    is_cut = nearest < NEAR
    places = _PRINCIPAL_POINT + np.float32(HALF_SIZE_PX) * corners[..., :2] / np.maximum(corners[..., 2:], NEAR)
    first = np.where(is_cut[:, None], 0.0, np.ceil(places.min(axis=1) - _MARGIN))
    after = np.where(is_cut[:, None], IMAGE_SIZE, np.floor(places.max(axis=1) + _MARGIN) + 1.0)
    after *= ((farthest > NEAR) & (nearest < FAR))[:, None]
    bounds = np.clip(np.stack([first, after], axis=-1), 0, IMAGE_SIZE).astype(np.int64)
    return bounds[:, 0], bounds[:, 1], is_cut


def _shade(colors: npt.NDArray[np.integer], normals: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Return RGB colours (n, 3), uint8, in the light that falls on faces with normals (n, 3) or (3,) in the world."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    cosine = unit @ np.array(LIGHT)
    height = 2.0 * cosine * unit[..., 2] - LIGHT[2]
    brightness = AMBIENT + DIFFUSE * np.maximum(cosine, 0.0) + SPECULAR * np.maximum(height, 0.0) ** 2
    shaded: npt.NDArray[np.uint8] = (colors * brightness[..., None]).astype(np.uint8)
    return shaded


_NO_JOINTS = np.zeros(0, dtype=np.float32)
# Body and its joint positions (d,) (m, rad).
PosedBody = tuple[RayBody, npt.NDArray[np.float32]]


class RayCamera:
    """Wrist camera that renders the visual meshes of one scene by ray casting.

    Args:
        assets: Models of the scene.
        config: Poses of robot and table.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """

    def __init__(self, assets: SceneAssets, config: PhysicsConfig) -> None:
        base = (*config.panda.base_position, *config.panda.base_orientation)
        self._panda = load_ray_body(assets.panda, SegmentationLabel.ROBOT, base)
        self._hand_link = read_tree(assets.panda).get_link(HAND_LINK)
        table = (*config.table_position, 0.0, 0.0, 0.0, 1.0)
        self._table = load_ray_body(assets.table, SegmentationLabel.TABLE, table)
        self._target = load_ray_body(assets.objects[0], SegmentationLabel.TARGET)
        self._others = [load_ray_body(urdf, SegmentationLabel.OTHER_OBJECT) for urdf in assets.objects[1:]]
        self._hand = load_ray_body(assets.hand, SegmentationLabel.HAND)

    def render_wrist_camera(self, snapshot: JointSnapshot, color: bool) -> CameraImage:
        """Render the wrist-camera image with all bodies of the scene at the joint positions of a snapshot.

        With `color`, the image has the colours of the models' materials and textures in PyBullet's light.
        """
        buffer = Framebuffer(*self._compute_camera_frame(snapshot), color)
        buffer.add_ground()
        for body, joints in [*self._list_targets(snapshot), *self._list_occluders(snapshot)]:
            buffer.add(body, joints)
        return buffer.to_image()

    def render_targets(self, snapshot: JointSnapshot, with_others: bool = False) -> CameraImage:
        """Render the visible pixels of target object and human hand at the joint positions of a snapshot.

        With `with_others`, pixels of the other objects are rendered, too. All other pixels are background.
        """
        buffer = Framebuffer(*self._compute_camera_frame(snapshot))
        drawn = [*self._list_targets(snapshot), *(self._list_others(snapshot) if with_others else [])]
        # Pixels of the object that the hand occludes appear twice, which does no harm.
        pixels = np.concatenate([buffer.add(body, joints) for body, joints in drawn])
        pixels = buffer.remove_below_ground(pixels)
        for body, joints in self._list_occluders(snapshot, with_others=not with_others):
            pixels = buffer.remove_occluded_by(body, joints, pixels)
        return buffer.to_image()

    def _compute_camera_frame(self, snapshot: JointSnapshot) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        rotations, origins = self._panda.compute_link_frames(snapshot.robot)
        rotation, origin = rotations[self._hand_link], origins[self._hand_link]
        return rotation @ np.array(HAND_FROM_CAMERA), origin + rotation @ np.array(CAMERA_POSITION_IN_HAND)

    def _list_targets(self, snapshot: JointSnapshot) -> list[PosedBody]:
        hand = [] if snapshot.hand is None else [(self._hand, snapshot.hand)]
        return [(self._target, snapshot.objects[0]), *hand]

    def _list_others(self, snapshot: JointSnapshot) -> list[PosedBody]:
        return list(zip(self._others, snapshot.objects[1:], strict=True))

    def _list_occluders(self, snapshot: JointSnapshot, with_others: bool = True) -> list[PosedBody]:
        others = self._list_others(snapshot) if with_others else []
        return [(self._panda, snapshot.robot), *others, (self._table, _NO_JOINTS)]
