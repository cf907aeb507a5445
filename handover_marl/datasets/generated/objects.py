"""Procedural objects: boxes, cylinders, bottles, tools and superquadrics of random sizes.

The origin of an object is the center of its bounding box. Every object has a place that the Panda's
gripper, which opens to 80 mm, can span.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.generated.config import OBJECT_KINDS
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import Part, make_surface

_COLORS = ("black", "blue", "brown", "cream", "navy", "olive", "orange", "red", "steel", "white", "wood", "yellow")
_WALL = ("blue", "cream", "navy", "orange", "red", "white", "yellow")


@dataclass(frozen=True)
class ProceduralObject:
    """Procedural object, made of convex parts.

    Attributes:
        kind: One of `OBJECT_KINDS`.
        parts: Parts in the object's frame.
        up_axes: Weights of the axes that point up on a table: +x, -x, +y, -y, +z, -z.
    """

    kind: str
    parts: tuple[Part, ...]
    up_axes: tuple[float, ...]


def draw_object(random: RandomStream, weights: tuple[float, ...]) -> ProceduralObject:
    """Draw a procedural object; `weights` are the relative probabilities of the kinds in `OBJECT_KINDS`."""
    kind = OBJECT_KINDS[random.weighted_index(weights)]
    parts, up_axes = _DRAWERS[kind](random)
    return ProceduralObject(kind, _center(parts), up_axes)


def _draw_box(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    # Thickness, width and height: a packet that stands, lies or leans on its side.
    size = (_length(random, 0.02, 0.07), _length(random, 0.035, 0.13), _length(random, 0.05, 0.21))
    x, y, z = (0.5 * length for length in size)
    box = Part("box", (x, y, z), _color(random, _WALL), rounding=_length(random, 0.001, 0.004))
    # Faces are weighted by their area.
    areas = (size[1] * size[2], size[0] * size[2], size[0] * size[1])
    return [box], tuple(float(np.round(area / max(areas), 3)) for area in np.repeat(areas, 2))


def _draw_cylinder(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    if random.uniform() < 0.2:
        radius, height = _length(random, 0.03, 0.048), _length(random, 0.02, 0.06)
    else:
        radius, height = _length(random, 0.010, 0.036), _length(random, 0.06, 0.22)
    taper = _length(random, 0.8, 1.0)
    size = (round(radius * taper, 4), radius, 0.5 * height)
    cylinder = Part("cone", size, _color(random, _COLORS), rounding=_length(random, 0.001, 0.003))
    stands = 1.0 if radius > 0.2 * height else 0.0
    lies = 0.1 if radius > 0.6 * height else 0.25
    return [cylinder], (lies, lies, lies, lies, stands, 0.3 * stands)


def _draw_bottle(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    radius, height = _length(random, 0.02, 0.036), _length(random, 0.07, 0.17)
    neck = _length(random, 0.008, min(0.016, 0.6 * radius))
    shoulder, cap = _length(random, 0.008, 0.03), _length(random, 0.015, 0.045)
    color, other = _color(random, _WALL), _color(random, _COLORS)
    if random.uniform() < 0.35:
        # Flat bottles, as of shampoo.
        wide = _length(random, radius, 0.05)
        body = Part("superellipsoid", (round(radius, 4), wide, 0.5 * height), color, exponents=(0.25, 0.7))
        shoulder_radius = radius
    else:
        body = Part("cone", (radius, radius, 0.5 * height), color, rounding=0.002)
        shoulder_radius = round(radius - 0.002, 4)
    cone = Part("cone", (shoulder_radius, neck, 0.5 * shoulder), color).move([0.0, 0.0, 0.5 * (height + shoulder)])
    top = Part("cone", (neck, neck, 0.5 * cap), other, rounding=0.001)
    parts = [body, cone, top.move([0.0, 0.0, 0.5 * height + shoulder + 0.5 * cap])]
    return parts, (0.4, 0.4, 0.2, 0.2, 1.0, 0.0)


def _draw_tool(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    length, thick = _length(random, 0.09, 0.17), _length(random, 0.009, 0.017)
    color, other = _color(random, _COLORS), _color(random, _COLORS)
    taper = round(thick * random.uniform(0.75, 1.0), 4)
    handle = Part("cone", (thick, taper, 0.5 * length), color, rounding=0.002, axis=0)
    form = random.integer(4)
    # Heads begin 5 mm inside of the handle's end.
    end = 0.5 * length - 0.005
    if form == 0:  # hammer
        half = (_length(random, 0.010, 0.016), _length(random, 0.03, 0.055), _length(random, 0.010, 0.016))
        head = Part("box", half, other, rounding=0.002).move([end + half[0], 0.0, 0.0])
    elif form == 1:  # screwdriver
        half = (_length(random, 0.003, 0.005), _length(random, 0.003, 0.005), 0.5 * _length(random, 0.06, 0.12))
        head = Part("cone", half, other, axis=0).move([end + half[2], 0.0, 0.0])
    elif form == 2:  # spatula
        half = (0.5 * _length(random, 0.06, 0.10), _length(random, 0.02, 0.038), _length(random, 0.0025, 0.004))
        head = Part("box", half, other, rounding=0.001).move([end + half[0], 0.0, 0.0])
    else:  # brush or club
        half = (_length(random, 0.018, 0.034), _length(random, 0.018, 0.034), 0.5 * _length(random, 0.05, 0.09))
        head = Part("superellipsoid", half, other, exponents=(0.6, 0.8), axis=0).move([end + half[2], 0.0, 0.0])
    return [handle, head], (0.0, 0.0, 0.2, 0.2, 1.0, 1.0)


def _draw_superquadric(random: RandomStream) -> tuple[list[Part], tuple[float, ...]]:
    half = (_length(random, 0.014, 0.034), _length(random, 0.02, 0.06), _length(random, 0.025, 0.095))
    exponents = (_length(random, 0.3, 1.0, 2), _length(random, 0.3, 1.0, 2))
    solid = Part("superellipsoid", half, _color(random, _COLORS), exponents=exponents)
    weights = tuple(float(np.round((min(half) / extent) ** 2, 3)) for extent in np.repeat(half, 2))
    return [solid], weights


_DRAWERS: Final = {
    "boxes": _draw_box,
    "cylinders": _draw_cylinder,
    "bottles": _draw_bottle,
    "tools": _draw_tool,
    "superquadrics": _draw_superquadric,
}


def _center(parts: list[Part]) -> tuple[Part, ...]:
    """Return the parts moved so that the bounding box is centered at the origin, to 0.1 mm."""
    corners = np.concatenate([make_surface(part).vertices for part in parts])
    middle: npt.NDArray[np.float64] = np.round(0.5 * (corners.min(axis=0) + corners.max(axis=0)), 4)
    return tuple(part.move(-middle) for part in parts)


def _length(random: RandomStream, low: float, high: float, digits: int = 4) -> float:
    """Draw a length (m) to 0.1 mm, or another number to some digits."""
    return round(random.uniform(low, high), digits)


def _color(random: RandomStream, names: tuple[str, ...]) -> str:
    return names[random.integer(len(names))]
