"""Pictures of a world's scenes, for every engine alike: PyBullet draws them."""

from typing import TYPE_CHECKING

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import ResetNeededError
from handover_marl.options import check_pybullet

if TYPE_CHECKING:
    from handover_marl.sim.bullet.picture_world import PictureWorld

_INSTEAD = "a film can be a page, --out FILE.html, and the wrist camera casts rays, renderer='rays'"


def check_drawing(what: str = "drawing") -> None:
    """Check that pictures can be drawn.

    Args:
        what: What is to be drawn.

    Raises:
        OptionError: PyBullet is not installed.
    """
    check_pybullet(what, _INSTEAD)


class Pictures:
    """A picture world of the scene that is asked about, made when first needed.

    Args:
        config: Where robot and table stand.
    """

    def __init__(self, config: PhysicsConfig) -> None:
        self._config = config
        self._world: PictureWorld | None = None

    def of(self, scene: Scene | None) -> "PictureWorld":
        """The scene's.

        Raises:
            ResetNeededError: There is no scene.
            OptionError: PyBullet is not installed.
        """
        if scene is None:
            raise ResetNeededError("the world is empty; call reset() first")
        if self._world is None or self._world.scene is not scene:
            check_drawing()
            # Only now, so that who draws nothing needs no PyBullet.
            from handover_marl.sim.bullet.picture_world import PictureWorld

            self.close()
            self._world = PictureWorld(scene, self._config)
        return self._world

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if self._world is not None:
            self._world.close()
        self._world = None
