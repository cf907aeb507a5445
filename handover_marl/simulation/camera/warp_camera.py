"""Cameras of many worlds, rendered by ray casting on a device with Warp.

Images equal those of `ray_camera.RayCamera` to single precision. All arrays are PyTorch tensors on the device.

The renderer of MuJoCo Warp 4.0 cannot be used: it holds the meshes and textures of one compiled model and compiles a
kernel for it, while the worlds here get other scenes in every episode. It also has other lights than PyBullet, and
cannot render the visible pixels of hand and object only.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp
from scipy.spatial.transform import Rotation

from handover_marl.config import MAX_OBJECTS, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import ResetNeededError
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, GrowableArray, to_float64
from handover_marl.geometry.kinematic_tree import TreeBatch, read_tree
from handover_marl.geometry.model_files.meshes import VisualMesh, read_visual_meshes
from handover_marl.geometry.model_files.surfaces import read_surfaces
from handover_marl.geometry.model_files.urdf import read_model_mtimes
from handover_marl.geometry.poses import IDENTITY
from handover_marl.geometry.rotations import matrices_from_quaternions
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.optics import INVISIBLE_LINKS, WRIST_CAMERA, Pinhole
from handover_marl.simulation.camera.warp_kernels import render_images
from handover_marl.simulation.warp_device import WarpDevice
from handover_marl.simulation.world import WorldState

#: Link number of meshes whose vertices are in the world frame.
WORLD = -1
#: Number of a mesh in its `MeshBuffers`, and of the link in whose frame it is; `WORLD` for meshes that never move.
DeviceMesh = tuple[int, int]


class MeshBuffers:
    """Visual meshes on Warp's current device; a model whose files have not changed is copied once.

    Mesh 0 stands for no mesh: its identifier is 0. The attributes are `GrowableArray`s.

    Args:
        arrays: Creator of tensors on the device.

    Attributes:
        identifiers: Identifiers (m,) of Warp's meshes, int64.
        spheres: Centers and radii (m, 4) of bounding spheres in the meshes' frames (m).
        first_faces: Number (m,) of each mesh's first face among the f faces of all meshes.
        corners: Texture coordinates (f, 3, 2) of the faces' corners, in units of the texture's size.
        textures: Texture (f, 3) of each face: index of its first texel, width and height.
        texels: Red, green and blue (t, 3) of all textures, uint8.
    """

    def __init__(self, arrays: ArrayFactory) -> None:
        self.identifiers, self.first_faces = GrowableArray(arrays, (), "int64"), GrowableArray(arrays, (), "int64")
        self.spheres, self.corners = GrowableArray(arrays, (4,), "float32"), GrowableArray(arrays, (3, 2), "float32")
        self.textures, self.texels = GrowableArray(arrays, (3,), "int32"), GrowableArray(arrays, (3,), "uint8")
        # Identifiers are valid as long as the meshes live.
        self._meshes: list[warp.Mesh] = []
        self._models: dict[tuple[object, ...], list[DeviceMesh]] = {}
        self._n_faces = 0
        # Models whose colors have not been copied to the device, in the order of their meshes.
        self._uncolored: list[tuple[Path, tuple[str, ...]]] = []
        self._extend(0, np.zeros(4), 0)

    def add_model(
        self, urdf: Path, base: tuple[float, ...] = tuple(IDENTITY.tolist()), without: tuple[str, ...] = ()
    ) -> list[DeviceMesh]:
        """Copy the meshes of a URDF file to the device, unless they are there, and return their numbers and links.

        `base` (7,) is the world pose of the base link: xyz (m), quaternion xyzw. Links named in `without` are left out.
        """
        key = (urdf, read_model_mtimes(urdf), base, without)
        if key in self._models:
            return self._models[key]
        tree, found = read_tree(urdf), list[DeviceMesh]()
        origins, rotations = (frames[0] for frames in tree.compute_link_frames(np.zeros((1, tree.n_dof))))
        world_from_base = Rotation.from_quat(base[3:])
        for mesh in read_visual_meshes(urdf, tree, without):
            vertices, link = mesh.vertices.astype(np.float64), mesh.link
            if tree.n_dof == 0 and link != WORLD:
                vertices, link = vertices @ rotations[link].T + origins[link], WORLD
            if link == WORLD:
                vertices = world_from_base.apply(vertices) + base[:3]
            found.append((self._add_mesh(vertices.astype(np.float32), mesh), link))
        self._uncolored.append((urdf, without))
        self._models[key] = found
        return found

    def read_colors(self) -> None:
        """Copy the textures and colors of all meshes to the device, unless they are there."""
        while self._uncolored:
            urdf, without = self._uncolored[0]
            for surface in read_surfaces(urdf, read_tree(urdf), without):
                self.corners.extend(surface.corners)
                first = self.texels.extend(surface.texels)
                self.textures.extend(surface.textures + np.array([first, 0, 0], dtype=np.int32))
            del self._uncolored[0]

    def _add_mesh(self, vertices: npt.NDArray[np.float32], mesh: VisualMesh) -> int:
        own = warp.Mesh(warp.array(vertices, dtype=warp.vec3), warp.array(mesh.faces.ravel(), dtype=warp.int32))
        self._meshes.append(own)
        center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        radius = np.linalg.norm(vertices - center, axis=1).max()
        # The radius is larger by more than the rounding error of `is_near_sphere`.
        return self._extend(own.id, np.array([*center, 1.001 * radius + 1e-5]), len(mesh.faces))

    def _extend(self, identifier: int, sphere: npt.NDArray[np.float64], n_faces: int) -> int:
        self.first_faces.extend(np.array([self._n_faces]))
        self._n_faces += n_faces
        self.spheres.extend(sphere)
        # Kernels read the bits as an unsigned number.
        return self.identifiers.extend(np.array([identifier], dtype=np.uint64).view(np.int64))


# Entries of a mesh slot of a world: number of the mesh, number of its frame, and segmentation label.
_MESH, _FRAME, _LABEL = range(3)


class ImageBatch(NamedTuple):
    """Images of r worlds, with their p pixels in image order.

    Attributes:
        depth: (r, p) float32 depth along the viewing axis (m); `Pinhole.empty_depth` for background.
        segmentation: (r, p) uint8 values of `SegmentationLabel`.
        rgb: (r, p, 3) uint8 colors, or None.
    """

    depth: AnyArray
    segmentation: AnyArray
    rgb: AnyArray | None


class WarpCamera:
    """Cameras for n worlds, each with visual meshes of its own.

    Methods apply to the r worlds whose indices are in their argument `rows` (r,); other arrays have r rows.

    Args:
        config: Poses of robot and table.
        count: Number n of worlds.
        arrays: Creator of tensors on the device.
    """

    def __init__(self, config: PhysicsConfig, count: int, arrays: ArrayFactory) -> None:
        self._config, self._arrays = config, arrays
        self._device = WarpDevice(arrays)
        self._robots, self._hands = TreeBatch("robots", arrays), TreeBatch("hands", arrays)
        # Number of each world's robot and hand, and its mesh slots: places for all meshes that the world shows.
        self._robot, self._hand = arrays.zeros(count, "int64"), arrays.zeros(count, "int64")
        self._slots = arrays.zeros((count, 0, 3), "int64")
        self._base_rotation = matrices_from_quaternions(arrays.asarray(config.panda.base_orientation, "float64"))
        self._base_position = arrays.asarray(config.panda.base_position, "float64")
        # Numbers of the frames in which cameras are mounted, by link; "" is the world.
        self._mounts: dict[str, int] = {}
        self._mesh_buffers: MeshBuffers | None = None

    def load_scene(self, row: int, assets: SceneAssets) -> None:
        """Load the meshes and kinematics of a scene into the world with index `row`."""
        panda, table = self._config.panda, (*self._config.table_position, *IDENTITY[3:].tolist())
        robot_base = (*panda.base_position, *panda.base_orientation)
        self._robot[row], self._hand[row] = self._robots.add(assets.panda), self._hands.add(assets.hand)
        robot_links = [joint.link for joint in read_tree(assets.panda).joints]
        # Frames are those of the robot's links, of the hand's links, of the objects and of the world, in this order.
        first_hand_frame = len(robot_links)
        first_object_frame = first_hand_frame + len(read_tree(assets.hand).joints)
        world_frame = first_object_frame + MAX_OBJECTS
        self._mounts = {**{link: number for number, link in enumerate(robot_links)}, "": world_frame}
        slots: list[tuple[int, int, int]] = []

        def add(meshes: list[DeviceMesh], label: SegmentationLabel, frames: Sequence[int]) -> None:
            slots.extend((number, world_frame if link == WORLD else frames[link], label) for number, link in meshes)

        with self._device.use():
            buffers = self._mesh_buffers = self._mesh_buffers or MeshBuffers(self._arrays)
            for number, urdf in enumerate(assets.objects):
                label = SegmentationLabel.OTHER_OBJECT if number else SegmentationLabel.TARGET
                # All meshes of an object move with it.
                slots.extend((mesh, first_object_frame + number, label) for mesh, _ in buffers.add_model(urdf))
            add(buffers.add_model(assets.hand), SegmentationLabel.HAND, range(first_hand_frame, first_object_frame))
            robot = buffers.add_model(assets.panda, robot_base, INVISIBLE_LINKS)
            add(robot, SegmentationLabel.ROBOT, range(first_hand_frame))
            add(buffers.add_model(assets.table, table), SegmentationLabel.TABLE, ())
        missing = len(slots) - self._slots.shape[1]
        if missing > 0:
            more = self._arrays.zeros((len(self._slots), missing, 3), "int64")
            self._slots = self._arrays.xp.concat([self._slots, more], axis=1)
        self._slots[row] = 0
        self._slots[row, : len(slots)] = self._arrays.asarray(np.array(slots))

    def render(
        self,
        rows: AnyArray,
        states: WorldState,
        color: bool,
        camera: Pinhole = WRIST_CAMERA,
        labels: Sequence[SegmentationLabel] = tuple(SegmentationLabel),
    ) -> ImageBatch:
        """Render images of the worlds `rows` (r,) in `states` (r, ...).

        With `color`, images have the colors of the models' materials and textures in PyBullet's light. Only visible
        pixels of bodies with `labels` are rendered, and the ground if `labels` contains `BACKGROUND`.
        """
        if self._mesh_buffers is None:
            raise ResetNeededError("no world has a scene; call reset() first")
        arrays, xp = self._arrays, self._arrays.xp
        with self._device.use():
            if color:
                self._mesh_buffers.read_colors()
            inputs = self._make_kernel_inputs(self._mesh_buffers, rows, states, camera)
            shape = (len(rows), camera.n_pixels)
            depth = xp.empty(shape, dtype=xp.float32, device=arrays.device)
            segmentation = xp.empty(shape, dtype=xp.uint8, device=arrays.device)
            rgb = xp.empty((*shape, 3) if color else (0, 0, 3), dtype=xp.uint8, device=arrays.device)
            warp.launch(
                render_images,
                shape,
                [
                    *(*inputs, sum(1 << label for label in labels), SegmentationLabel.BACKGROUND in labels),
                    *(camera.width, warp.vec4(*camera.focal, *camera.principal)),
                    *(camera.near, float(camera.empty_depth)),
                ],
                [warp.from_torch(tensor) for tensor in (depth, segmentation, rgb)],
            )
        return ImageBatch(depth, segmentation, rgb if color else None)

    def sample_pixels(
        self, images: ImageBatch, label: SegmentationLabel, limit: int, seeds: AnyArray, steps: AnyArray, stream_id: int
    ) -> AnyArray:
        """Choose at most `limit` pixels with a label in each of r images, without replacement.

        The choice depends on the image, its seed, its number of steps and `stream_id` only.

        Args:
            images: The images.
            label: Label of the pixels.
            limit: Largest number of pixels.
            seeds: Seeds (r,), 32 bits, int64.
            steps: Numbers (r,) of simulated steps, int64.
            stream_id: Number that makes the random choice independent of choices with other numbers.

        Returns:
            Numbers (r, limit) of the chosen pixels, ascending. Missing ones have the value p, the number of pixels.
        """
        xp, segmentation, n_pixels = self._arrays.xp, images.segmentation, images.segmentation.shape[1]
        with self._device.use():
            states = _scramble(_scramble(seeds) + stream_id) + steps
            keys = _scramble(_scramble(states)[:, None] + self._arrays.arange(n_pixels))
            # Keys of 32 bits differ within an image; other pixels come after those with the label.
            keys = xp.where(segmentation == int(label), keys, 2**32)
            chosen = xp.topk(keys, min(limit, n_pixels), dim=1, largest=False, sorted=False).indices
            is_labelled = xp.take_along_dim(segmentation, chosen, dim=1) == int(label)
            found = self._arrays.full((len(segmentation), limit), n_pixels, "int64")
            found[:, :n_pixels] = xp.sort(xp.where(is_labelled, chosen, n_pixels), axis=1)
            return found

    def close(self) -> None:
        """Free the meshes; each world can be rendered again only after its next `load_scene`."""
        self._device.synchronize()
        self._mesh_buffers = None
        self._slots = self._slots[:, :0]

    def _make_kernel_inputs(
        self, buffers: MeshBuffers, rows: AnyArray, states: WorldState, camera: Pinhole
    ) -> "list[warp.array]":
        """Return the arguments `meshes` to `pinholes` of the kernel `render_images`, for one camera in each world."""
        xp = self._arrays.xp
        origins, rotations = self._compute_frames(rows, states)
        mount = self._mounts[camera.link]
        axes, position = (self._arrays.asarray(own, "float64") for own in (camera.axes, camera.position))
        turned = rotations[:, mount] @ axes
        pinhole = origins[:, mount] + (rotations[:, mount] @ position[:, None])[..., 0]
        slots = self._slots[rows]
        meshes, frames, labels = slots[..., _MESH], slots[..., _FRAME], slots[..., _LABEL]
        is_absent = (labels == int(SegmentationLabel.HAND)) & (states.hand_present <= 0.0)
        meshes = xp.where(is_absent, 0, meshes)
        worlds = self._arrays.arange(len(rows))[:, None]
        turns = turned[:, None].mT @ rotations[worlds, frames]
        places = ((origins[worlds, frames] - pinhole[:, None])[..., None, :] @ turned[:, None])[..., 0, :]
        spheres = to_float64(buffers.spheres.rows[meshes])
        centers = places + (turns @ spheres[..., :3, None])[..., 0]
        inputs = (
            (buffers.identifiers.rows[meshes], warp.int64),
            (labels, warp.int64),
            (turns, warp.mat33),
            (places, warp.vec3),
            (xp.concat([centers, spheres[..., 3:]], axis=-1), warp.vec4),
            (buffers.first_faces.rows[meshes], warp.int64),
            (buffers.corners.rows, warp.vec2),
            (buffers.textures.rows, warp.vec3i),
            (buffers.texels.rows, warp.vec3ub),
            (turned, warp.mat33),
            (pinhole, warp.vec3),
        )
        return [self._convert(tensor, dtype) for tensor, dtype in inputs]

    def _convert(self, tensor: AnyArray, dtype: type) -> "warp.array":
        """Return a tensor as an array of Warp, with float64 numbers rounded to float32."""
        xp = self._arrays.xp
        own = xp.astype(tensor, xp.float32) if tensor.dtype == xp.float64 else tensor
        return warp.from_torch(own.contiguous(), dtype)

    def _compute_frames(self, rows: AnyArray, states: WorldState) -> tuple[AnyArray, AnyArray]:
        """Return world origins (r, f, 3) and rotations (r, f, 3, 3) of robot's and hand's links, objects and world."""
        xp = self._arrays.xp
        origins, rotations = self._robots.compute_link_frames(
            self._robot[rows], to_float64(states.robot_joint_position)[:, None]
        )
        robots = origins[:, 0] @ self._base_rotation.mT + self._base_position, self._base_rotation @ rotations[:, 0]
        joints = to_float64(states.hand_dof_position)[:, None]
        origins, rotations = self._hands.compute_link_frames(self._hand[rows], joints)
        objects = to_float64(states.object_poses)
        world = xp.zeros_like(objects[:, :1, :3]), xp.zeros_like(rotations[:, 0, :1])
        world[1].diagonal(dim1=-2, dim2=-1)[:] = 1.0
        parts = (
            robots,
            (origins[:, 0], rotations[:, 0]),
            (objects[..., :3], matrices_from_quaternions(objects[..., 3:])),
            world,
        )
        origins, rotations = (xp.concat(own, axis=1) for own in zip(*parts, strict=True))
        return origins, rotations


def _scramble(values: AnyArray) -> AnyArray:
    """Return pseudo-random numbers of 32 bits, int64, by the hash function "lowbias32" (C. Wellons, 2018).

    Different values of 32 bits have different results; higher bits are ignored.
    """
    mixed = values & 0xFFFFFFFF
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        mixed = ((mixed ^ (mixed >> shift)) * factor) & 0xFFFFFFFF
    return mixed ^ (mixed >> 16)
