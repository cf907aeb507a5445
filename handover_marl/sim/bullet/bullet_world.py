"""What the two worlds in PyBullet share: a physics server that is stepped and drawn."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import SimulationError
from handover_marl.sim.bullet.client import BulletClient, connect, pybullet_error
from handover_marl.sim.bullet.drawing import render
from handover_marl.sim.bullet.picture_world import PictureWorld
from handover_marl.sim.scene_pictures import Pictures
from handover_marl.sim.world import World


class BulletWorld(World):
    """A world in a physics server of its own.

    Args:
        config: Constants of the world.
        window: Whether to show PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        self._config = config
        self._client: BulletClient = connect(window)
        self._scene: Scene | None = None
        self._pictures = Pictures(config)

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3) of the present state."""
        return render(self._client, camera)

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._pictures.close()
        self._client.close()

    def _picture_world(self) -> PictureWorld:
        """The present scene in a server that is not simulated."""
        return self._pictures.of(self._scene)

    def _simulate(self) -> None:
        try:
            self._client.stepSimulation()
        except pybullet_error as error:
            raise lost(error) from error


def lost(error: Exception) -> SimulationError:
    """The error for a physics server that no longer answers."""
    return SimulationError(
        f"PyBullet stopped ({error}); if its window was closed, close() this environment and reset() it again"
    )
