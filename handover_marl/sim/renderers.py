"""Renderers of the wrist camera by name."""

import importlib.util
from abc import ABC, abstractmethod

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.options import check_pybullet, pybullet_installed
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.world import Snapshot, World

#: "bullet" draws with the engine's software renderer, in exact physics to the bit what HandoverSim sees; "rays" casts
#: rays, many times as fast; "auto" is "bullet" in exact physics and "rays" in others.
RENDERERS = ("auto", "bullet", "rays")
_NEEDED = ("embreex", "trimesh")


def chosen_renderer(name: str, physics: str, installed: bool = True) -> str:
    """What a name stands for in a kind of physics.

    Args:
        name: One of `RENDERERS`.
        physics: The kind of physics.
        installed: Whether to check that what it needs is there.

    Raises:
        UnknownNameError: There is no such renderer.
        OptionError: It needs an extra, or PyBullet, that is not installed.
    """
    if name not in RENDERERS:
        raise UnknownNameError("renderer", name, RENDERERS)
    chosen = ("bullet" if physics == "exact" else "rays") if name == "auto" else name
    missing = [module for module in _NEEDED if importlib.util.find_spec(module) is None] if chosen == "rays" else []
    if missing and installed:
        instead = ", or take renderer='bullet', which is slower" if pybullet_installed() else ""
        raise OptionError(
            f"renderer 'rays' needs {' and '.join(missing)}: pip install 'handover-marl[vision]'{instead}"
        )
    if chosen == "bullet" and installed:
        check_pybullet("renderer 'bullet'", "take renderer='rays', for which there is the extra vision")
    return chosen


class Renderer(ABC):
    """Draws what the wrist camera shows in one scene."""

    @abstractmethod
    def photograph(self, world: World, at: Snapshot | None, color: bool) -> Photo:
        """The whole picture.

        Args:
            world: The world.
            at: An earlier moment; None is the present one.
            color: Whether colours are wanted.
        """

    @abstractmethod
    def sought(self, world: World, at: Snapshot | None) -> Photo:
        """A picture in which only what is seen of the given object and the hand counts."""


class EngineRenderer(Renderer):
    """Lets the physics engine draw."""

    def photograph(self, world: World, at: Snapshot | None, color: bool) -> Photo:
        """The whole picture."""
        return world.photograph(color, at)

    def sought(self, world: World, at: Snapshot | None) -> Photo:
        """The whole picture, since no part of it is cheaper."""
        return world.photograph(False, at)


class RayRenderer(Renderer):
    """Casts rays.

    Args:
        scene: What to draw.
        config: Where robot and table stand.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """

    def __init__(self, scene: Scene, config: PhysicsConfig) -> None:
        # Only now, since it needs an extra.
        from handover_marl.sim.rays.ray_camera import RayCamera

        self._camera = RayCamera(scene.assets, config)

    def photograph(self, world: World, at: Snapshot | None, color: bool) -> Photo:
        """The whole picture."""
        return self._camera.photograph(at or world.snapshot(), color)

    def sought(self, world: World, at: Snapshot | None) -> Photo:
        """Given object and hand alone."""
        return self._camera.sought(at or world.snapshot())


def make_renderer(name: str, scene: Scene, config: PhysicsConfig) -> Renderer:
    """A renderer for one scene.

    Args:
        name: "bullet" or "rays".
        scene: What to draw.
        config: Where robot and table stand.

    Raises:
        SimulationError, DataFormatError: A model or one of its meshes cannot be read.
    """
    return RayRenderer(scene, config) if name == "rays" else EngineRenderer()
