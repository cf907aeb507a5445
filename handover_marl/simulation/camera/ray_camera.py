"""Renderer of the wrist camera by ray casting.

Rays are cast only through the pixels of a rectangle around each link. If only object and hand are rendered, the other
bodies are tested only against rays that hit the object or the hand.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.camera.framebuffer import Framebuffer
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot, SegmentationLabel
from handover_marl.simulation.camera.optics import CAMERA_POSITION_IN_HAND, HAND_FROM_CAMERA
from handover_marl.simulation.camera.ray_body import RayBody, load_ray_body

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
        """Render the wrist-camera image with all bodies of the scene.

        Args:
            snapshot: Joint positions of all bodies.
            color: Whether to render colours: those of the models' materials and textures, in PyBullet's light.
        """
        buffer = Framebuffer(*self._compute_camera_frame(snapshot), color)
        buffer.add_ground()
        for body, joints in [*self._list_targets(snapshot), *self._list_occluders(snapshot)]:
            buffer.add(body, joints)
        return buffer.to_image()

    def render_targets(self, snapshot: JointSnapshot, with_others: bool = False) -> CameraImage:
        """Render the visible pixels of target object and human hand; all other pixels are background.

        Args:
            snapshot: Joint positions of all bodies.
            with_others: Whether to render the other objects, too.
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
