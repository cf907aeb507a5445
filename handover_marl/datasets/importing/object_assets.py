"""The objects' URDFs, which are the same text for every class; the meshes they name come with HandoverSim."""

from pathlib import Path

from handover_marl.datasets.importing.asset_files import put_files
from handover_marl.datasets.importing.urdf_text import AXES, Element, inertial, joint, link, robot_text, shape
from handover_marl.models.ycb import CLASS_NAMES

_BODY = 6  # number of the link with the meshes, at the end of three sliding and three turning joints
_MASS, _FRICTION = "0.5", "0.9"  # kg and 1, whatever the object is made of
_TRAVEL = "1000"  # m; far beyond any trajectory


def object_urdf() -> str:
    """The text of `model_normalized.urdf`."""
    parts = [link(0, inertial("0", placed=False))]
    for number in range(1, _BODY):
        parts += [link(number, inertial("0", placed=False)), _joint(number)]
    parts += [_body(), _joint(_BODY)]
    return robot_text('<?xml version="1.0"?>', "model_normalized", parts)


def write_object_assets(assets: Path) -> None:
    """Write `<class>/model_normalized.urdf` for the 21 classes.

    Args:
        assets: HandoverSim's folder `assets`.

    Raises:
        ResultsError: A file is there with other content, or cannot be written.
    """
    content = object_urdf().encode()
    put_files(assets, {f"{name}/model_normalized.urdf": content for name in CLASS_NAMES.values()})


def _joint(number: int) -> Element:
    axis = AXES[(number - 1) % 3]
    if number <= 3:
        return joint(number, "prismatic", axis=axis, limits=(f"-{_TRAVEL}", _TRAVEL))
    return joint(number, "continuous", axis=axis, limits=None)


def _body() -> Element:
    white = Element("material", {"name": "white"}, [Element("color", {"rgba": "1 1 1 1"})])
    return link(
        _BODY,
        Element("contact", {}, [Element("lateral_friction", {"value": _FRICTION})]),
        inertial(_MASS),
        shape("visual", {"filename": "textured_simple.obj", "scale": "1 1 1"}, white),
        shape("collision", {"filename": "model_normalized_convex.obj", "scale": "1 1 1"}),
    )
