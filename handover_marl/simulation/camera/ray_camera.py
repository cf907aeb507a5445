"""Renderer of cameras by ray casting, and its framebuffer: depth, segmentation labels and colors.

Rays are cast only through the pixels of a rectangle around each link. If only object and hand are rendered, the other
bodies are tested only against rays that hit the object or the hand.
"""

from collections.abc import Sequence
from typing import NamedTuple

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
Colors = npt.NDArray[np.uint8]
Rectangles = npt.NDArray[np.int64]
#: Numbers of pixels in image order.
Pixels = npt.NDArray[np.int64]

_NO_PIXELS = np.zeros(0, dtype=np.int64)
# Numbers of the corners at both ends of a box's edges.
_EDGES = np.array([(one, one | bit) for bit in (1, 2, 4) for one in range(8) if not one & bit]).T
# Added around rectangles (pixels), larger than the rounding error of the projection.
_MARGIN = 0.01
# Stand for ground and background in place of a link's number.
_GROUND, _BACKGROUND = -1, -2
_GROUND_COLORS = np.array(GROUND, dtype=np.uint8)


class PosedLink(NamedTuple):
    """Link of a body in the frame of a camera.

    Attributes:
        body: The body.
        number: Index of the link's mesh in `body.meshes`.
        owner: Index of the link among all links of the scene.
        frame: Rotation (3, 3) and origin (3,) (m) of the mesh in the camera's frame, float32.
        rectangle: Pixels that may show the link: first column and the one after the last, then the same for rows.
    """

    body: RayBody
    number: int
    owner: int
    frame: tuple[Array, Array]
    rectangle: Sequence[Sequence[int]]

    @property
    def is_hidden(self) -> bool:
        """Whether no pixel can show the link."""
        return any(first >= after for first, after in self.rectangle)


class Framebuffer:
    """Depth of one image during ray casting, and the index (`PosedLink.owner`) of the link that each pixel shows.

    Pixels are numbered row by row. Colors are computed at the end, once for each pixel.

    Args:
        camera: Camera of the image.
        rotation: (3, 3) axes of the camera (right, down, ahead) in the world, as columns.
        position: (3,) world position of the pinhole (m).
        color: Whether the image has colors.
    """

    def __init__(self, camera: Pinhole, rotation: Float64Array, position: Float64Array, color: bool = False) -> None:
        self._camera, self._rotation, self._position, self._has_color = camera, rotation, position, color
        count = camera.n_pixels
        self._depth = np.full(count, camera.empty_depth, dtype=np.float32)
        self._owner = np.full(count, _BACKGROUND, dtype=np.int16)
        # Face that a pixel shows, and its two barycentric weights in one complex number, which is faster than two.
        self._face, self._weights = np.empty(count, np.int32), np.empty(count, np.complex64)

    def draw(self, link: PosedLink, pixels: Pixels | None = None) -> Pixels:
        """Draw a link on the pixels where it is nearer than what has been drawn there; return these pixels' numbers.

        Args:
            link: Link to draw.
            pixels: Numbers (n,) of the pixels; default: those of the rectangle around the link.
        """
        camera, mesh, (rotation, origin) = self._camera, link.body.meshes[link.number], link.frame
        if pixels is None:
            # Faster than by the numbers of the pixels.
            columns, rows = (slice(*bounds) for bounds in link.rectangle)
            rays = camera.rays.reshape(*camera.pixels.shape, 3)[rows, columns].reshape(-1, 3)
            depth = self._depth.reshape(camera.pixels.shape)[rows, columns].ravel()
            pixels = camera.pixels[rows, columns].ravel()
        else:
            rays, depth = camera.rays.take(pixels, axis=0), self._depth[pixels]
        hits = mesh.cast_rays(-(origin @ rotation), rays @ rotation, camera.near, depth)
        drawn = pixels[hits.ray]
        self._depth[drawn], self._owner[drawn] = hits.depth, link.owner
        if self._has_color:
            self._face[drawn], self._weights[drawn] = hits.face, hits.weights.view(np.complex64)[:, 0]
        return drawn

    def draw_ground(self) -> None:
        """Draw the ground plane z = 0 of the world frame where it is nearer than what has been drawn."""
        descent = self._camera.rays @ self._rotation[2].astype(np.float32)
        with np.errstate(divide="ignore"):
            depth = np.float32(-self._position[2]) / descent
        is_hit = (depth > self._camera.near) & (depth < self._depth)
        self._depth[is_hit], self._owner[is_hit] = depth[is_hit], _GROUND

    def clear(self, pixels: Pixels) -> None:
        """Set the pixels with the numbers `pixels` (n,) to background."""
        self._depth[pixels], self._owner[pixels] = self._camera.empty_depth, _BACKGROUND

    def find_below_ground(self, pixels: Pixels) -> npt.NDArray[np.bool_]:
        """Return a mask (n,) of the pixels (n,) whose points are below the ground, world z = 0."""
        heights = self._position[2] + self._depth[pixels] * (self._camera.rays[pixels] @ self._rotation[2])
        is_below: npt.NDArray[np.bool_] = heights < 0.0
        return is_below

    def make_image(self, links: Sequence[PosedLink]) -> CameraImage:
        """Return the content of the framebuffer as an image; `links` are all links, ordered by `PosedLink.owner`."""
        shape = self._camera.height, self._camera.width
        labels = np.array([*(link.body.label for link in links), *[SegmentationLabel.BACKGROUND] * 2], dtype=np.uint8)
        rgb = self._compute_colors(links).reshape(*shape, 3) if self._has_color else None
        # The numbers of ground and background are the last two.
        return CameraImage(self._depth.reshape(shape), labels.take(self._owner).reshape(shape), rgb)

    def _compute_colors(self, links: Sequence[PosedLink]) -> Colors:
        """Return the colors (n, 3) of all n pixels, uint8, row by row."""
        # Three channels and an unused one in one 32-bit number, which is faster than three.
        colors = np.empty((len(self._owner), 4), np.uint8)
        packed = colors.view(np.uint32)[:, 0]
        order = np.argsort(self._owner, kind="stable")
        ends = np.searchsorted(self._owner[order], np.arange(_BACKGROUND, len(links)), side="right").tolist()
        colors[order[: ends[0]], :3] = SKY
        ground = order[ends[0] : ends[1]]
        x, y, _ = (self._camera.rays.take(ground, axis=0) @ self._rotation.T).T * self._depth[ground]
        squares = (np.floor(x + self._position[0]) + np.floor(y + self._position[1])).astype(np.int64) & 1
        # World normals, the number of each pixel's normal, and colors before shading; those of the ground come first.
        normals, found = [np.array([[0.0, 0.0, 1.0]])], [_GROUND_COLORS[squares]]
        numbers: list[npt.NDArray[np.integer]] = [np.zeros(len(ground), np.int64)]
        count = 1
        for link, first, end in zip(links, ends[1:-1], ends[2:], strict=True):
            if first < end:
                pixels = order[first:end]
                faces, weights = self._face[pixels], self._weights[pixels].view(np.float32).reshape(-1, 2)
                own = link.body.meshes[link.number].normals
                # Once for each face, or for each pixel if those are fewer.
                is_shared = len(own) < len(faces)
                rows = own if is_shared else own.take(faces, axis=0)
                normals.append(rows @ (self._rotation @ link.frame[0]).T)
                numbers.append(count + (faces if is_shared else np.arange(len(rows))))
                found.append(link.body.surfaces[link.number].sample(faces, weights))
                count += len(rows)
        brightness = _compute_brightness(np.concatenate(normals)).take(np.concatenate(numbers))
        packed[order[ends[0] :]] = _shade(np.concatenate(found), brightness)
        return np.ascontiguousarray(colors[:, :3])


def _bound_boxes(camera: Pinhole, corners: Array) -> Rectangles:
    """Return the rectangles of pixels that contain n boxes, given their corners (n, 8, 3) in the camera's frame (m).

    Returns:
        Bounds (n, 2, 2): first column and the one after the last, then the same for rows; empty ranges for boxes that
        no pixel can show.
    """
    near = np.float32(camera.near)
    # Points of the edges in the near plane, if an edge crosses it.
    one, other = corners[:, _EDGES[0]], corners[:, _EDGES[1]]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (near - one[..., 2]) / (other[..., 2] - one[..., 2])
        cuts = one + share[..., None] * (other - one)
        cuts[..., 2] = np.where((share >= 0.0) & (share <= 1.0), near, 0.0)
        points = np.concatenate([corners, cuts], axis=1)
        focal, principal = (np.array(own, np.float32) for own in (camera.focal, camera.principal))
        places = principal + points[..., :2] / points[..., 2:] * focal
    is_ahead = (points[..., 2] >= near)[..., None]
    first = np.ceil(np.where(is_ahead, places, np.inf).min(axis=1) - _MARGIN)
    after = np.floor(np.where(is_ahead, places, -np.inf).max(axis=1) + _MARGIN) + 1.0
    after *= (corners[..., 2].min(axis=1) < camera.far)[:, None]
    bounds: Rectangles = np.clip([first, after], 0, (camera.width, camera.height)).astype(np.int64)
    return np.asarray(bounds.transpose(1, 2, 0))


def _compute_brightness(normals: npt.NDArray[np.floating]) -> Float64Array:
    """Return the brightness (n,) of faces with world normals (n, 3) of any length, see `optics.LIGHT`."""
    columns = normals.T
    length = np.maximum(np.sqrt(sum(column * column for column in columns)), 1e-12)
    unit = np.stack([column / length for column in columns], axis=1)
    cosine = unit @ np.array(LIGHT)
    height = 2.0 * cosine * unit[:, 2] - LIGHT[2]
    brightness: Float64Array = AMBIENT + DIFFUSE * np.maximum(cosine, 0.0) + SPECULAR * np.maximum(height, 0.0) ** 2
    return brightness


def _shade(colors: npt.NDArray[np.integer], brightness: Float64Array) -> npt.NDArray[np.uint32]:
    """Multiply colors (n, 3) by a brightness (n,); return each color as one packed 32-bit number (n,)."""
    shaded = np.empty((len(colors), 4), np.uint8)
    for channel in range(3):
        np.multiply(colors[:, channel], brightness, out=shaded[:, channel], casting="unsafe")
    return shaded.view(np.uint32)[:, 0]


_NO_JOINTS = np.zeros(0, dtype=np.float32)
# Body and its joint positions (d,) (m, rad).
PosedBody = tuple[RayBody, npt.NDArray[np.float32]]


class RayCamera:
    """Renderer of the visual meshes of one scene by ray casting.

    Args:
        assets: Models of the scene.
        config: Poses of robot and table.
    """

    def __init__(self, assets: SceneAssets, config: PhysicsConfig) -> None:
        base = (*config.panda.base_position, *config.panda.base_orientation)
        self._panda = load_ray_body(assets.panda, SegmentationLabel.ROBOT, base)
        self._links = [joint.link for joint in read_tree(assets.panda).joints]
        table = (*config.table_position, 0.0, 0.0, 0.0, 1.0)
        self._table = load_ray_body(assets.table, SegmentationLabel.TABLE, table)
        self._target = load_ray_body(assets.objects[0], SegmentationLabel.TARGET)
        self._other_objects = [load_ray_body(urdf, SegmentationLabel.OTHER_OBJECT) for urdf in assets.objects[1:]]
        self._hand = load_ray_body(assets.hand, SegmentationLabel.HAND)

    def render(self, snapshot: JointSnapshot, color: bool, camera: Pinhole = WRIST_CAMERA) -> CameraImage:
        """Render an image with all bodies of the scene at the joint positions of a snapshot.

        With `color`, the image has the colors of the models' materials and textures in PyBullet's light.
        """
        view = self._compute_camera_frame(snapshot, camera)
        buffer, links = Framebuffer(camera, *view, color), self._pose_links(snapshot, camera, view)
        for link in links:
            if not link.is_hidden:
                buffer.draw(link)
        buffer.draw_ground()
        return buffer.make_image(links)

    def render_targets(
        self, snapshot: JointSnapshot, with_others: bool = False, camera: Pinhole = WRIST_CAMERA
    ) -> CameraImage:
        """Render the visible pixels of target object and human hand, without colors, at the joints of a snapshot.

        With `with_others`, pixels of the other objects are rendered, too. All other pixels are background.
        """
        view = self._compute_camera_frame(snapshot, camera)
        buffer, links = Framebuffer(camera, *view), self._pose_links(snapshot, camera, view)
        labels = {SegmentationLabel.TARGET, SegmentationLabel.HAND}
        labels |= {SegmentationLabel.OTHER_OBJECT} if with_others else set()
        visible = [link for link in links if not link.is_hidden]
        # Pixels of the object that the hand occludes appear twice, which does no harm.
        drawn = [buffer.draw(link) for link in visible if link.body.label in labels]
        pixels = np.concatenate([_NO_PIXELS, *drawn])
        is_below = buffer.find_below_ground(pixels)
        buffer.clear(pixels[is_below])
        pixels = pixels[~is_below]
        row, column = np.divmod(pixels, camera.width)
        for link in visible:
            if link.body.label not in labels:
                (left, right), (top, bottom) = link.rectangle
                near = pixels[(row >= top) & (row < bottom) & (column >= left) & (column < right)]
                if len(near):
                    # A cleared pixel may be drawn and cleared again by a later link; it stays background.
                    buffer.clear(buffer.draw(link, near))
        return buffer.make_image(links)

    def _compute_camera_frame(self, snapshot: JointSnapshot, camera: Pinhole) -> tuple[Float64Array, Float64Array]:
        """Return the axes (3, 3) of a camera in the world, as columns, and its position (3,) (m)."""
        if not camera.link:
            return np.array(camera.axes), np.array(camera.position)
        origins, rotations = self._panda.compute_link_frames(snapshot.robot)
        link = self._links.index(camera.link)
        rotation, origin = rotations[link], origins[link]
        return rotation @ np.array(camera.axes), origin + rotation @ np.array(camera.position)

    def _pose_links(
        self, snapshot: JointSnapshot, camera: Pinhole, view: tuple[Float64Array, Float64Array]
    ) -> list[PosedLink]:
        """Return all links with meshes, target and hand first, in the frame of a camera with the world pose `view`."""
        bodies: list[PosedBody] = [(self._target, snapshot.objects[0])]
        bodies += [] if snapshot.hand is None else [(self._hand, snapshot.hand)]
        bodies += [(self._panda, snapshot.robot), *zip(self._other_objects, snapshot.objects[1:], strict=True)]
        bodies.append((self._table, _NO_JOINTS))
        frames = [body.compute_mesh_frames(joints) for body, joints in bodies]
        origins, rotations = (np.concatenate(part) for part in zip(*frames, strict=True))
        turns, places = view[0].T @ rotations, (origins - view[1]) @ view[0]
        turns, places = turns.astype(np.float32), places.astype(np.float32)
        corners = np.concatenate([body.corners for body, _ in bodies]) @ turns.swapaxes(1, 2) + places[:, None]
        owners = ((body, number) for body, _ in bodies for number in range(len(body.meshes)))
        rectangles = _bound_boxes(camera, corners).tolist()
        parts = enumerate(zip(owners, zip(turns, places, strict=True), rectangles, strict=True))
        return [PosedLink(*link, owner, frame, bounds) for owner, (link, frame, bounds) in parts]
