"""Selection of the wrist camera's renderer, and scene renderers for engines without rendering."""

from typing import TYPE_CHECKING

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError, check_name
from handover_marl.execution.options import is_pybullet_installed, require_modules, require_pybullet

if TYPE_CHECKING:
    from handover_marl.simulation.bullet.rendering import SceneRenderer

BULLET, RAYS = "bullet", "rays"
#: "bullet" is PyBullet's software renderer, bit-equal to HandoverSim's images in exact physics; "rays" is a ray caster,
#: many times as fast; "auto" is "bullet" in exact physics and "rays" in others.
RENDERERS = ("auto", BULLET, RAYS)
_RAY_MODULES = ("embreex", "trimesh")


def resolve_renderer(name: str, physics: str) -> str:
    """Return the renderer of the wrist camera for an option, "bullet" or "rays", whose packages are installed.

    Args:
        name: Name of the renderer or "auto", one of `RENDERERS`.
        physics: Kind of physics, one of `PHYSICS`.

    Raises:
        UnknownNameError: There is no such renderer.
        OptionError: The renderer needs a package that is not installed.
    """
    check_name("renderer", name, RENDERERS)
    renderer = (BULLET if physics == "exact" else RAYS) if name == "auto" else name
    if renderer == BULLET:
        require_pybullet("renderer 'bullet'", "take renderer='rays', for which there is the extra vision")
    else:
        instead = ", or take renderer='bullet', which is slower" if is_pybullet_installed() else ""
        require_modules("renderer 'rays'", "vision", *_RAY_MODULES, advice=instead)
    return renderer


def check_rendering(what: str = "rendering") -> None:
    """Check that PyBullet is installed, which renders scenes.

    Args:
        what: Name of the operation for the error message.

    Raises:
        OptionError: PyBullet is not installed.
    """
    require_pybullet(
        what,
        "without PyBullet, render a 3D replay page with --out FILE.html, and wrist-camera images with renderer='rays'",
    )


class SceneRendererCache:
    """Cache of the PyBullet renderer of the current scene, created at its first image.

    Args:
        config: Poses of robot and table.
    """

    def __init__(self, config: PhysicsConfig) -> None:
        self._config = config
        self._renderer: SceneRenderer | None = None

    def get(self, scene: Scene | None) -> "SceneRenderer":
        """Return the renderer of a scene, created at the first call for that scene.

        Raises:
            ResetNeededError: There is no scene yet.
            OptionError: PyBullet is not installed.
        """
        if scene is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        if self._renderer is None or self._renderer.scene is not scene:
            check_rendering()
            # Imported here: only rendering needs PyBullet.
            from handover_marl.simulation.bullet.rendering import SceneRenderer

            self.close()
            self._renderer = SceneRenderer(scene, self._config)
        return self._renderer

    def close(self) -> None:
        """Disconnect from the PyBullet physics server."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None
