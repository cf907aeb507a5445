"""Renderer of cameras by ray casting, and its framebuffer: depth, segmentation labels and colours.

Rays are cast only through the pixels of a rectangle around each link. If only object and hand are rendered, the other
bodies are tested only against rays that hit the object or the hand.
"""

import itertools

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import (
    AMBIENT,
    DIFFUSE,
    GROUND,
    LIGHT,
    SKY,
    SPECULAR,
    WRIST_CAMERA,
    Float64Array,
    Pinhole,
)
from handover_marl.simulation.camera.ray_body import RayBody, load_ray_body

Array = npt.NDArray[np.float32]
#: Numbers of pixels in image order.
Pixels = npt.NDArray[np.int64]

_NO_PIXELS = np.zeros(0, dtype=np.int64)
# Whether each of a box's eight corners is on its higher side, by axis, and the corners at both ends of its edges.
_IS_HIGH = np.array(list(itertools.product((False, True), repeat=3)))
_EDGES = np.array([(one, one | bit) for bit in (1, 2, 4) for one in range(8) if not one & bit]).T
# Added around rectangles (pixels), larger than the rounding error of the projection.
_MARGIN = 0.01
_BEHIND = -1


class Framebuffer:
    """Depth, segmentation labels and colours of one image during ray casting.

    Pixels are numbered row by row. Colours are computed at the end, once for each pixel.

    Args:
        camera: Camera of the image.
        rotation: (3, 3) axes of the camera (right, down, ahead) in the world, as columns.
        position: (3,) world position of the pinhole (m).
        color: Whether the image has colours.
    """

    def __init__(self, camera: Pinhole, rotation: Float64Array, position: Float64Array, color: bool = False) -> None:
        self._camera, self._rotation, self._position = camera, rotation, position
        count = camera.n_pixels
        self._depth = np.full(count, camera.empty_depth, dtype=np.float32)
        self._labels = np.full(count, SegmentationLabel.BACKGROUND, dtype=np.uint8)
        # Number of the link in `_links` that a pixel shows, its face, and the place in the face; links with their
        # rotation to the world.
        self._owner = np.full(count, _BEHIND, dtype=np.int16) if color else None
        self._face, self._weights = np.empty(count, np.int32), np.empty((count, 2), np.float32)
        self._links: list[tuple[RayBody, int, Float64Array]] = []

    def add_ground(self) -> None:
        """Draw the ground plane z = 0 of the world frame."""
        descent = self._camera.rays @ self._rotation[2].astype(np.float32)
        with np.errstate(divide="ignore"):
            depth = np.float32(-self._position[2]) / descent
        is_hit = (depth > self._camera.near) & (depth < self._depth)
        self._depth[is_hit], self._labels[is_hit] = depth[is_hit], SegmentationLabel.BACKGROUND
        if self._owner is not None:
            self._owner[is_hit] = _BEHIND

    def add(self, body: RayBody, joints: Array) -> Pixels:
        """Draw a body at joint positions (d,) (m, rad) and return the numbers of the changed pixels.

        A pixel that two links of the body changed one after the other occurs twice.
        """
        rotations, origins = self._compute_mesh_frames(body, joints)
        first, after = self._bound_boxes(body, rotations, origins)
        drawn = [_NO_PIXELS]
        for link in np.flatnonzero((first < after).all(axis=1)).tolist():
            columns, rows = (np.arange(*bounds) for bounds in zip(first[link], after[link], strict=True))
            pixels = (self._camera.width * rows[:, None] + columns).ravel()
            drawn.append(self._draw_link(body, link, (rotations[link], origins[link]), pixels))
        return np.concatenate(drawn)

    def remove_occluded_by(self, body: RayBody, joints: Array, pixels: Pixels) -> Pixels:
        """Clear the given pixels that a body at joint positions (d,) occludes; return the other given pixels."""
        rotations, origins = self._compute_mesh_frames(body, joints)
        first, after = self._bound_boxes(body, rotations, origins)
        row, column = np.divmod(pixels, self._camera.width)
        for link in np.flatnonzero((first < after).all(axis=1)).tolist():
            (left, top), (right, bottom) = first[link], after[link]
            near = pixels[(row >= top) & (row < bottom) & (column >= left) & (column < right)]
            if len(near):
                self._clear(self._draw_link(body, link, (rotations[link], origins[link]), near))
                pixels = pixels[self._labels[pixels] != SegmentationLabel.BACKGROUND]
                row, column = np.divmod(pixels, self._camera.width)
        return pixels

    def remove_below_ground(self, pixels: Pixels) -> Pixels:
        """Clear the given pixels whose points are below the ground, world z = 0; return the other given pixels."""
        heights = self._position[2] + self._depth[pixels] * (self._camera.rays[pixels] @ self._rotation[2])
        is_below = heights < 0.0
        self._clear(pixels[is_below])
        remaining: Pixels = pixels[~is_below]
        return remaining

    def to_image(self) -> CameraImage:
        """Return the content of the framebuffer as an image."""
        shape = self._camera.height, self._camera.width
        rgb = None if self._owner is None else self._compute_colors(self._owner).reshape(*shape, 3)
        return CameraImage(self._depth.reshape(shape), self._labels.reshape(shape), rgb)

    def _compute_colors(self, owner: npt.NDArray[np.int16]) -> npt.NDArray[np.uint8]:
        """Return the colours (n, 3) of all pixels, given the numbers (n,) of their links."""
        colors, normals = np.zeros((len(owner), 3), np.uint8), np.zeros((len(owner), 3))
        for number, (body, link, rotation) in enumerate(self._links):
            pixels = np.flatnonzero(owner == number)
            faces = self._face[pixels]
            colors[pixels] = body.surfaces[link].sample(faces, self._weights[pixels])
            normals[pixels] = body.meshes[link].normals[faces] @ rotation.T
        behind = np.flatnonzero(owner == _BEHIND)
        is_ground = self._depth[behind] < self._camera.empty_depth
        ground = behind[is_ground]
        places = self._position + self._depth[ground, None] * (self._camera.rays[ground] @ self._rotation.T)
        squares = np.floor(places[:, :2]).astype(np.int64).sum(axis=1) % 2
        colors[ground], normals[ground] = np.array(GROUND)[squares], (0.0, 0.0, 1.0)
        shaded = _shade(colors, normals)
        shaded[behind[~is_ground]] = SKY
        return shaded

    def _compute_mesh_frames(self, body: RayBody, joints: Array) -> tuple[Array, Array]:
        """Return rotations (n, 3, 3) and origins (n, 3) of a body's meshes in the camera frame."""
        rotations, origins = body.compute_mesh_frames(joints)
        turns, places = self._rotation.T @ rotations, (origins - self._position) @ self._rotation
        return turns.astype(np.float32), places.astype(np.float32)

    def _draw_link(self, body: RayBody, link: int, frame: tuple[Array, Array], pixels: Pixels) -> Pixels:
        """Draw a link on those of the given pixels where it is nearest to the camera; return the changed pixels."""
        mesh, (rotation, origin), rays = body.meshes[link], frame, self._camera.rays
        hits = mesh.cast_rays(-(origin @ rotation), rays[pixels] @ rotation, self._camera.near, self._depth[pixels])
        drawn = pixels[hits.ray]
        self._depth[drawn] = hits.depth
        self._labels[drawn] = body.label
        if self._owner is not None:
            self._owner[drawn], self._face[drawn], self._weights[drawn] = len(self._links), hits.face, hits.weights
            self._links.append((body, link, self._rotation @ rotation))
        return drawn

    def _clear(self, pixels: Pixels) -> None:
        self._depth[pixels], self._labels[pixels] = self._camera.empty_depth, SegmentationLabel.BACKGROUND

    def _bound_boxes(
        self, body: RayBody, rotations: Array, origins: Array
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the rectangles of pixels that contain a body's meshes, given their frames in the camera's frame.

        Returns:
            First columns and rows (n, 2), and those after the last (n, 2); empty outside the depth range.
        """
        camera = self._camera
        boxes = np.where(_IS_HIGH, body.highest[:, None], body.lowest[:, None]) @ rotations.swapaxes(1, 2)
        corners = boxes + origins[:, None]
        # Points of the edges in the near plane, if an edge crosses it.
        one, other = corners[:, _EDGES[0]], corners[:, _EDGES[1]]
        rise = other[..., 2] - one[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (np.float32(camera.near) - one[..., 2]) / rise
            cuts = one + share[..., None] * (other - one)
            cuts[..., 2] = np.where((share >= 0.0) & (share <= 1.0), camera.near, 0.0)
            points = np.concatenate([corners, cuts], axis=1)
            focal, principal = (np.array(own, np.float32) for own in (camera.focal, camera.principal))
            places = principal + points[..., :2] / points[..., 2:] * focal
        is_ahead = (points[..., 2] >= np.float32(camera.near))[..., None]
        first = np.ceil(np.where(is_ahead, places, np.inf).min(axis=1) - _MARGIN)
        after = np.floor(np.where(is_ahead, places, -np.inf).max(axis=1) + _MARGIN) + 1.0
        after *= (corners[..., 2].min(axis=1) < camera.far)[:, None]
        bounds = np.clip([first, after], 0, (camera.width, camera.height)).astype(np.int64)
        return bounds[0], bounds[1]


def _shade(colors: npt.NDArray[np.integer], normals: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Return RGB colours (n, 3), uint8, in the light that falls on faces with normals (n, 3) in the world."""
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
    """Renderer of the visual meshes of one scene by ray casting.

    Args:
        assets: Models of the scene.
        config: Poses of robot and table.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """

    def __init__(self, assets: SceneAssets, config: PhysicsConfig) -> None:
        base = (*config.panda.base_position, *config.panda.base_orientation)
        self._panda = load_ray_body(assets.panda, SegmentationLabel.ROBOT, base)
        self._links = [joint.link for joint in read_tree(assets.panda).joints]
        table = (*config.table_position, 0.0, 0.0, 0.0, 1.0)
        self._table = load_ray_body(assets.table, SegmentationLabel.TABLE, table)
        self._target = load_ray_body(assets.objects[0], SegmentationLabel.TARGET)
        self._others = [load_ray_body(urdf, SegmentationLabel.OTHER_OBJECT) for urdf in assets.objects[1:]]
        self._hand = load_ray_body(assets.hand, SegmentationLabel.HAND)

    def render(self, snapshot: JointSnapshot, color: bool, camera: Pinhole = WRIST_CAMERA) -> CameraImage:
        """Render an image with all bodies of the scene at the joint positions of a snapshot.

        With `color`, the image has the colours of the models' materials and textures in PyBullet's light.
        """
        buffer = Framebuffer(camera, *self._compute_camera_frame(snapshot, camera), color)
        for body, joints in [*self._list_targets(snapshot), *self._list_occluders(snapshot)]:
            buffer.add(body, joints)
        buffer.add_ground()
        return buffer.to_image()

    def render_targets(
        self, snapshot: JointSnapshot, with_others: bool = False, camera: Pinhole = WRIST_CAMERA
    ) -> CameraImage:
        """Render the visible pixels of target object and human hand at the joint positions of a snapshot.

        With `with_others`, pixels of the other objects are rendered, too. All other pixels are background.
        """
        buffer = Framebuffer(camera, *self._compute_camera_frame(snapshot, camera))
        drawn = [*self._list_targets(snapshot), *(self._list_others(snapshot) if with_others else [])]
        # Pixels of the object that the hand occludes appear twice, which does no harm.
        pixels = np.concatenate([buffer.add(body, joints) for body, joints in drawn])
        pixels = buffer.remove_below_ground(pixels)
        for body, joints in self._list_occluders(snapshot, with_others=not with_others):
            pixels = buffer.remove_occluded_by(body, joints, pixels)
        return buffer.to_image()

    def _compute_camera_frame(self, snapshot: JointSnapshot, camera: Pinhole) -> tuple[Float64Array, Float64Array]:
        """Return the axes (3, 3) of a camera in the world, as columns, and its position (3,) (m)."""
        if not camera.link:
            return np.array(camera.axes), np.array(camera.position)
        rotations, origins = self._panda.compute_link_frames(snapshot.robot)
        link = self._links.index(camera.link)
        rotation, origin = rotations[link], origins[link]
        return rotation @ np.array(camera.axes), origin + rotation @ np.array(camera.position)

    def _list_targets(self, snapshot: JointSnapshot) -> list[PosedBody]:
        hand = [] if snapshot.hand is None else [(self._hand, snapshot.hand)]
        return [(self._target, snapshot.objects[0]), *hand]

    def _list_others(self, snapshot: JointSnapshot) -> list[PosedBody]:
        return list(zip(self._others, snapshot.objects[1:], strict=True))

    def _list_occluders(self, snapshot: JointSnapshot, with_others: bool = True) -> list[PosedBody]:
        others = self._list_others(snapshot) if with_others else []
        return [(self._panda, snapshot.robot), *others, (self._table, _NO_JOINTS)]
