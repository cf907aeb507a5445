"""A scene in a physics server of its own, to be drawn and never simulated.

Whatever is drawn in a server enters its broad phase and shows in the last bits of what is simulated there.
"""

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.sim.bullet.body import Start
from handover_marl.sim.bullet.client import connect
from handover_marl.sim.bullet.drawing import render
from handover_marl.sim.bullet.hand_body import Hand
from handover_marl.sim.bullet.object_body import Object
from handover_marl.sim.bullet.stage import set_stage
from handover_marl.sim.bullet.wrist_view import photograph, seen_bodies
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.world import Snapshot


class PictureWorld:
    """What one scene looks like.

    Args:
        scene: The scene.
        config: Where robot and table stand.
    """

    def __init__(self, scene: Scene, config: PhysicsConfig) -> None:
        self.scene = scene
        self._client, self._config = connect(), config
        self._stage = set_stage(self._client, scene.assets, config)
        nowhere = Start([0.0] * 6)
        self._objects = [
            Object(self._client, urdf, class_id, nowhere, config.objects)
            for urdf, class_id in zip(scene.assets.objects, scene.info.object_ids, strict=True)
        ]
        self._hand: Hand | None = None

    def draw(self, now: Snapshot, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3).

        Args:
            now: Where everything is.
            camera: Where to look from.
        """
        self._arrange(now)
        return render(self._client, camera)

    def photograph(self, now: Snapshot, color: bool) -> Photo:
        """What the wrist camera shows.

        Args:
            now: Where everything is.
            color: Whether colours are wanted.
        """
        self._arrange(now)
        objects = [body.id for body in self._objects]
        hand = None if self._hand is None else self._hand.id
        bodies = seen_bodies(self._stage.table_id, self._stage.panda.id, objects, hand)
        return photograph(self._client, self._stage.panda, bodies, color)

    def _arrange(self, now: Snapshot) -> None:
        self._stage.panda.place(now.robot.tolist())
        for body, dof in zip(self._objects, now.objects.tolist(), strict=True):
            body.place(dof)
        if now.hand is None and self._hand is not None:
            self._hand.remove()
            self._hand = None
        elif now.hand is not None:
            dof = now.hand.tolist()
            if self._hand is None:
                self._hand = Hand(self._client, self.scene.assets.hand, dof, self._config.hand)
            self._hand.place(dof)

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._client.close()
