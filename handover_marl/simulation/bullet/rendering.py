"""Images of overview cameras and of observation cameras by PyBullet's software renderer.

The images are the same with and without a screen or graphics driver. Images of the wrist camera equal HandoverSim's
bit for bit.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, CameraConfig, PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import OptionError
from handover_marl.geometry.poses import IDENTITY
from handover_marl.geometry.rotations import matrices_from_quaternions, multiply_quaternions
from handover_marl.simulation.bullet.bodies import (
    HandBody,
    ObjectBody,
    PandaBody,
    Workcell,
    compute_object_masks,
    load_workcell,
)
from handover_marl.simulation.bullet.client import BulletClient, connect
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import SAMPLE_OFFSET_PX, WRIST_CAMERA, Pinhole, depth_from_buffer

# Rotation from the renderer's view (along negative z, y up) to the camera's URDF link, with HandoverSim's rounding.
_LINK_FROM_VIEW = np.array([-4.3297803e-17, -0.70710677, -0.70710677, 4.3297803e-17], dtype=np.float32)


def render_camera(
    client: BulletClient,
    workcell: Workcell,
    objects: Sequence[ObjectBody],
    hand: HandBody | None,
    color: bool,
    camera: Pinhole,
) -> CameraImage:
    """Render an image of a camera in the current state of a physics client.

    Args:
        client: Physics client.
        workcell: Table, and Panda, on which the camera may be mounted.
        objects: Objects, the target first.
        hand: Human hand, if there is one.
        color: Whether to render colors.
        camera: The camera.
    """
    panda = workcell.panda
    labels = {
        workcell.table_id: SegmentationLabel.TABLE,
        panda.id: SegmentationLabel.ROBOT,
        **{body.id: SegmentationLabel.OTHER_OBJECT for body in objects[1:]},
        objects[0].id: SegmentationLabel.TARGET,
        **({} if hand is None else {hand.id: SegmentationLabel.HAND}),
    }
    # The camera's housing is nearer than the near plane; hiding it saves most of the rendering time.
    with panda.hide_camera_link():
        width, height, pixels, buffer, numbers = client.getCameraImage(
            camera.width,
            camera.height,
            viewMatrix=_compute_view_matrix(client, panda, camera),
            projectionMatrix=_compute_projection_matrix(client, camera),
            renderer=client.ER_TINY_RENDERER,
            # PyBullet's defaults, which would be those of an overview camera after it has rendered an image.
            shadow=0,
            lightDirection=(-50.0, 30.0, 100.0),
        )
    shape = (height, width)
    numbers = np.asarray(numbers).reshape(shape)
    depth = depth_from_buffer(np.array(buffer, dtype=np.float32).reshape(shape), camera)
    rgba = np.asarray(pixels, dtype=np.uint8).reshape(*shape, 4) if color else None
    depth[numbers < 0] = camera.empty_depth
    return CameraImage(
        depth=depth, segmentation=_label_pixels(numbers, labels), rgb=None if rgba is None else rgba[..., :3].copy()
    )


def _label_pixels(numbers: npt.NDArray[np.int32], labels: Mapping[int, SegmentationLabel]) -> npt.NDArray[np.uint8]:
    """Return the segmentation labels (h, w) of pixels with PyBullet body numbers (h, w); -1 is no body."""
    table = np.full(max(*labels, int(numbers.max()), 0) + 2, SegmentationLabel.BACKGROUND, dtype=np.uint8)
    for body, label in labels.items():
        table[body] = label
    segmentation: npt.NDArray[np.uint8] = table[numbers]
    return segmentation


def _compute_projection_matrix(client: BulletClient, camera: Pinhole) -> list[float]:
    """Return a camera's OpenGL projection matrix, column by column."""
    (fx, fy), width, height = camera.focal, camera.width, camera.height
    fov, aspect = math.degrees(2.0 * math.atan(height / 2.0 / fy)), (width / fx) / (height / fy)
    matrix = list(client.computeProjectionMatrixFOV(fov, aspect, camera.near, camera.far))
    # Distance of the principal point from where the renderer has it.
    right, down = (
        at - side / 2.0 + by for at, side, by in zip(camera.principal, (width, height), SAMPLE_OFFSET_PX, strict=True)
    )
    matrix[8], matrix[9] = matrix[8] - 2.0 * right / width, matrix[9] + 2.0 * down / height
    return matrix


def _compute_view_matrix(client: BulletClient, panda: PandaBody, camera: Pinhole) -> list[float]:
    """Return a camera's OpenGL view matrix, column by column."""
    if (camera.link, camera.position, camera.axes) == (WRIST_CAMERA.link, WRIST_CAMERA.position, WRIST_CAMERA.axes):
        return _compute_wrist_view_matrix(client, panda.read_camera_pose())
    pose = panda.read_link_poses([panda.get_link(camera.link)])[0] if camera.link else IDENTITY
    link = matrices_from_quaternions(pose[3:].astype(np.float64))
    axes, matrix = link @ np.array(camera.axes) * (1.0, -1.0, -1.0), np.eye(4)
    matrix[:3, :3], matrix[3, :3] = axes, -(pose[:3] + link @ np.array(camera.position)) @ axes
    return list(matrix.ravel().tolist())


def _compute_wrist_view_matrix(client: BulletClient, world_from_link: npt.NDArray[np.float32]) -> list[float]:
    """Return the wrist camera's OpenGL view matrix, column by column, rounded as in HandoverSim."""
    turn = multiply_quaternions(world_from_link[3:], _LINK_FROM_VIEW)
    axes = np.array(client.getMatrixFromQuaternion(turn.tolist()), dtype=np.float32).reshape(3, 3)
    x, y, z = world_from_link[:3]
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = axes
    # Summed in this order; a matrix product may use fused operations, which round otherwise.
    matrix[3, :3] = -((x * axes[0] + y * axes[1]) + z * axes[2])
    return list(map(float, matrix.ravel()))


class SceneRenderer:
    """Renderer of one scene in a separate PyBullet client, for worlds of any physics engine.

    Rendering in the client of a simulation would change its broad phase, and thereby the last bits of later states.

    Args:
        scene: Scene to render.
        config: Poses of robot and table.
        client: Physics client to load the scene into, for example the client of a window; None for a new one.

    Attributes:
        scene: Scene that is rendered.
    """

    def __init__(self, scene: Scene, config: PhysicsConfig, client: BulletClient | None = None) -> None:
        self.scene = scene
        self._client, self._config = client or connect(), config
        self._workcell = load_workcell(self._client, scene.assets, config)
        self._objects = [
            ObjectBody(self._client, urdf, mask, config.objects, [0.0] * OBJECT_DOF)
            for urdf, mask in zip(scene.assets.objects, compute_object_masks(scene.info.object_ids), strict=True)
        ]
        self._hand: HandBody | None = None

    def render_overview(self, snapshot: JointSnapshot, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """Render an RGB image (height, width, 3), uint8, of the scene at given joints by a world-fixed camera."""
        if camera.link:
            raise OptionError(f"link of the camera of an overview must be '', got {camera.link!r}")
        self.set_joints(snapshot)
        view = self._client.computeViewMatrix(camera.position, camera.target, camera.up)
        projection = self._client.computeProjectionMatrixFOV(
            camera.vertical_fov, camera.width / camera.height, camera.near, camera.far
        )
        width, height, pixels, _, _ = self._client.getCameraImage(
            camera.width,
            camera.height,
            view,
            projection,
            shadow=1,
            lightDirection=(0.5, -1.0, 2.0),
            renderer=self._client.ER_TINY_RENDERER,
            flags=self._client.ER_NO_SEGMENTATION_MASK,
        )
        rgba = np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)
        rgb: npt.NDArray[np.uint8] = rgba[..., :3].copy()
        return rgb

    def render(self, snapshot: JointSnapshot, color: bool, camera: Pinhole = WRIST_CAMERA) -> CameraImage:
        """Render an image of a camera at the joint positions `snapshot` of all bodies; `color` adds colors."""
        self.set_joints(snapshot)
        return render_camera(self._client, self._workcell, self._objects, self._hand, color, camera)

    def set_joints(self, snapshot: JointSnapshot) -> None:
        """Set all bodies to the joint positions of a snapshot; remove the human hand if the snapshot has none."""
        self._workcell.panda.reset_joints(snapshot.robot.tolist())
        for body, dof in zip(self._objects, snapshot.objects.tolist(), strict=True):
            body.reset_joints(dof)
        if snapshot.hand is None:
            if self._hand is not None:
                self._hand.remove()
                self._hand = None
            return
        dof = snapshot.hand.tolist()
        if self._hand is None:
            self._hand = HandBody(self._client, self.scene.assets.hand, dof, self._config.hand)
        self._hand.reset_joints(dof)

    def close(self) -> None:
        """Disconnect from the PyBullet physics server."""
        self._client.close()
