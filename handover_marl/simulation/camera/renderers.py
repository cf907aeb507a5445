"""Selection of the renderer of camera images: PyBullet's, or ray casting."""

from handover_marl.errors import check_name
from handover_marl.execution.options import is_pybullet_installed, require_modules, require_pybullet

BULLET, RAYS = "bullet", "rays"
#: "bullet" is PyBullet's software renderer, bit-equal to HandoverSim's images in exact physics; "rays" is a ray caster,
#: many times as fast; "auto" is "bullet" in exact physics and "rays" in others.
RENDERERS = ("auto", BULLET, RAYS)
_RAY_MODULES = ("embreex", "trimesh")


def resolve_renderer(name: str, physics: str) -> str:
    """Return the renderer that a name selects, "bullet" or "rays"; raise `OptionError` if it is not installed.

    Args:
        name: Name of the renderer or "auto", one of `RENDERERS`.
        physics: Kind of physics, which decides for "auto": "exact", "fast" or "mujoco".
    """
    check_name("renderer", name, RENDERERS)
    renderer = (BULLET if physics == "exact" else RAYS) if name == "auto" else name
    if renderer == BULLET:
        require_pybullet("renderer 'bullet'", "take renderer='rays', for which there is the extra vision")
    else:
        instead = ", or take renderer='bullet', which is slower" if is_pybullet_installed() else ""
        require_modules("renderer 'rays'", "vision", *_RAY_MODULES, advice=instead)
    return renderer


def check_rendering(operation: str = "rendering") -> None:
    """Raise an `OptionError` that names the `operation` if PyBullet, which renders scenes, is not installed."""
    require_pybullet(
        operation,
        "without PyBullet, render a 3D replay page with --out FILE.html, and wrist-camera images with renderer='rays'",
    )
