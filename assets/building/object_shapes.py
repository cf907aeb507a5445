"""Shapes of the object models in millimetres, with the dimensions of the scanned YCB objects.

Source: scans of the YCB set (Calli et al., 2015) as used by DexYCB; the profiles in `object_profiles.json` were
measured on them and rounded. Boxes, cans and blocks are made upright at the origin and then placed by center and
rotation vector (degrees); bottles, tools and clamps are made in the scan's frame.
"""

import json
from collections.abc import Callable, Sequence
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np

from handover_marl.assets.building.shapes import (
    Array,
    Piece,
    loft,
    make_bar,
    make_block,
    make_ellipse,
    make_label,
    make_rectangle,
    make_span,
    revolve_wall,
    stack,
    stack_outlines,
    sweep_outlines,
)

#: Rows of measured profiles by name; `object_profiles.json` describes their columns.
PROFILES: MappingProxyType[str, Any] = MappingProxyType(
    {
        name: profile["rows"]
        for name, profile in json.loads((files(__package__) / "object_profiles.json").read_text()).items()
    }
)
_LABEL_THICKNESS = 0.3


def _make_labelled_box(
    size: tuple[float, float, float], colors: tuple[str, str, str], corner: float
) -> tuple[Piece, ...]:
    """Return a flat box with a colored panel and a stripe on its lower and upper face."""
    body, panel, stripe = colors
    half = [extent / 2 for extent in size]
    long_axis = 0 if size[0] > size[1] else 1
    pieces = [make_block(size, body, corner)]
    for share, (start, stop), color in ((0.8, (-0.75, 0.1), panel), (0.9, (0.35, 0.75), stripe)):
        low, high = [-share * extent for extent in half], [share * extent for extent in half]
        low[long_axis], high[long_axis] = start * half[long_axis], stop * half[long_axis]
        low[2], high[2] = -half[2] - _LABEL_THICKNESS, half[2] + _LABEL_THICKNESS
        pieces.append(make_label(low, high, color))
    return tuple(pieces)


def _make_carton(name: str, depth: float, colors: Sequence[str], cut: int) -> Piece:
    """Return a bent carton of a profile with rows (z, lowest x, highest x); collision splits at row `cut`."""
    outlines = [make_span((low, -depth / 2), (high, depth / 2), 1.5) for _, low, high in PROFILES[name]]
    return stack(outlines, [row[0] for row in PROFILES[name]], colors, (cut,))


def _make_can(low: float, high: float, body: float, rim: float, colors: tuple[str, str]) -> Piece:
    """Return a can from z of its ends, radius of body and rims, and colors of label and rims."""
    paper, metal = colors
    heights = (low, low + 3, low + 5, high - 5, high - 3, high)
    outlines = [make_ellipse(r, n=40) for r in (rim, rim, body, body, rim, rim)]
    return stack(outlines, heights, (metal, metal, paper, metal, metal))


def _make_potted_meat_can() -> tuple[Piece, ...]:
    body, rim = make_rectangle(96.5, 51.5, 17.0, 6), make_rectangle(101.6, 57.3, 19.0, 6)
    heights, colors = (-49.8, -40.0, 26.0, 31.5, 33.8), ("steel", "navy", "steel", "steel")
    return (stack([body, body, body, rim, rim], heights, colors, (2,)).transform((-2.4, -0.5, 0), (0, 0, 2.6)),)


def _make_banana() -> tuple[Piece, ...]:
    rows = PROFILES["banana"]
    rings = sweep_outlines([row[:3] for row in rows], [make_ellipse(row[3], n=20) for row in rows], (0, 0, 1))
    colors = ("brown", *["yellow"] * (len(rows) - 3), "olive")
    return (loft(rings, colors, (2, 3, 4, 5, 6, 7, 8, 9, 10)),)


def _stack_downwards(outlines: list[Array], rows: Sequence[Sequence[float]]) -> Array:
    """Return rings of outlines (x, z) at heights y, the first numbers of the rows."""
    return stack_outlines(outlines, [row[0] for row in rows])[..., [0, 2, 1]]


def _make_power_drill() -> tuple[Piece, ...]:
    rows = PROFILES["power_drill_barrel"]
    circles = stack_outlines([make_ellipse(radius, n=28) for _, radius in rows], [x for x, _ in rows])
    colors = ("black", "black", "black", "steel", *["orange"] * 4, "black")
    barrel = loft(circles[..., [2, 0, 1]], colors, (3, 4)).transform((0, 46.8, 0))
    rows = PROFILES["power_drill_handle"]
    outlines = [make_span((low, -half), (high, half), 8.0) for _, low, high, half in rows]
    handle = loft(_stack_downwards(outlines, rows), ("orange", "orange", "black", "orange", "black"), (1, 2, 3, 4))
    rows = PROFILES["power_drill_battery"]
    outlines = [make_span((x0, z0), (x1, z1), 10.0) for _, x0, x1, z0, z1 in rows]
    battery = loft(_stack_downwards(outlines, rows), "black")
    outlines = [make_span((-17.0, -7.5), (-2.0, 7.5), 3.0), make_span((-12.0, -7.5), (6.0, 7.5), 3.0)]
    return barrel, handle, battery, loft(_stack_downwards(outlines, [(9.0,), (-15.0,)]), "red")


def _make_scissors() -> tuple[Piece, ...]:
    pieces = []
    for (x, y), direction, (long, short) in PROFILES["scissors_loops"]:
        along = np.array(direction) / np.hypot(*direction)
        angle = np.arange(16) * 2 * np.pi / 16
        flat = np.outer(long * np.cos(angle), along) + np.outer(short * np.sin(angle), (-along[1], along[0]))
        path = np.c_[flat + np.array([x, y]), np.zeros(16)]
        rings = sweep_outlines(path, [make_rectangle(8.0, 14.4, 2.5, 3)] * 16, (0, 0, 1), closed=True)
        pieces.append(loft(rings, "orange", None, closed=True))
    pieces.append(loft(make_bar(PROFILES["scissors_left_shank"], -7.8, 7.9), "orange", None))
    pieces.append(loft(make_bar(PROFILES["scissors_right_shank"], -7.0, 7.0), "orange", None))
    pieces.append(loft(make_bar(PROFILES["scissors_blades"], -2.5, 2.8, 0.8), "steel", None))
    return tuple(pieces)


def _make_clamp(
    halves: tuple[tuple[tuple[tuple[float, float], tuple[float, float]], ...], ...],
    bar: tuple[float, float],
    pivot: tuple[float, float],
    pin: tuple[float, float],
) -> tuple[Piece, ...]:
    """Return a spring clamp of two bars on a pin at `pivot`; `bar` and `pin` are z ranges."""
    colors = ("orange", "black", "black", "black", "black", "black", "black", "orange")
    arms = [loft(make_bar(half, *bar, bevel=3.0), colors, None) for half in halves]
    hub = stack([make_ellipse(14.0)] * 2, (bar[0] + 2, bar[1] - 2), "black").transform((*pivot, 0))
    outlines = [make_ellipse(radius, n=24) for radius in (9.5, 12.0, 12.0, 9.5)]
    heights = (pin[0], pin[0] + 3, pin[1] - 3, pin[1])
    return *arms, hub, stack(outlines, heights, "orange").transform((*pivot, 0))


def _make_large_marker() -> tuple[Piece, ...]:
    rows = PROFILES["marker"]
    rings = sweep_outlines([(x, y, -0.3) for x, y, _ in rows], [make_ellipse(r, n=24) for *_, r in rows], (0, 0, 1))
    ends = sweep_outlines([(-1.0, 56.9, -0.3), (-1.2, 62.5, -0.3)], [make_ellipse(4.6, n=24)] * 2, (0, 0, 1))
    return loft(rings, ("black", "white", "white", "black", "black"), (3,)), loft(ends, "black")


def _make_mustard_bottle() -> tuple[Piece, ...]:
    rows = PROFILES["mustard_bottle"]
    outlines, heights = [make_ellipse(a, b, exponent=e) for _, a, b, e in rows], [row[0] for row in rows]
    body = stack(outlines, heights, ("yellow",) * 6 + ("navy",) * 2 + ("yellow",) * 3, (3, 5, 7))
    cap = stack([make_ellipse(20.2)] * 2, (74.0, 88.0), "white")
    nozzle = stack([make_ellipse(13.0), make_ellipse(9.5), make_ellipse(7.0)], (87.9, 104.0, 107.5), "white")
    return _move((body, cap, nozzle), (-0.8, -2.4, 0), (0, 0, -21.1))


def _make_bleach_cleanser() -> tuple[Piece, ...]:
    rows = PROFILES["bleach_cleanser"]
    outlines = [make_span(row[1:3], row[3:5], exponent=3.0) for row in rows]
    colors = ("white", "white", "white", "blue", *["white"] * 7)
    body = stack(outlines, [row[0] for row in rows], colors, (3, 4, 5, 7, 9))
    collar = stack([make_ellipse(15.2)] * 2, (118.0, 131.5), "blue").transform((4.1, 2.3, 0))
    return body, collar, stack([make_ellipse(14.0)] * 2, (131.4, 138.5), "blue").transform((4.3, 2.2, 0))


def _make_bowl() -> tuple[Piece, ...]:
    wall = revolve_wall(PROFILES["bowl"], "red", n_parts=18)
    rim = revolve_wall(((80.6, 26.5, 71.0, 26.5), (80.6, 30.0, 71.2, 30.4)), "red", n_parts=18)
    bottom = stack([make_ellipse(44.0, n=48)] * 2, (-24.5, -22.0), "red")
    return _move((wall, rim, bottom), (0.2, -0.9, 0))


def _make_mug() -> tuple[Piece, ...]:
    wall = revolve_wall(PROFILES["mug"], "red")
    rim = revolve_wall(((46.4, 40.0, 37.8, 39.8), (46.4, 42.0, 38.3, 42.4)), "red")
    floor = stack([make_ellipse(radius, n=48) for radius in (38.0, 40.8, 40.8)], (-39.1, -36.5, -34.0), "red")
    path = [(x, -1.7, z) for x, z in PROFILES["mug_handle"]]
    handle = loft(sweep_outlines(path, [make_rectangle(6.6, 14.4, 2.0)] * len(path), (0, 1, 0)), "red", None)
    return *_move((wall, rim, floor), (-3.7, 0.7, 0)), handle


def _make_pitcher_base() -> tuple[Piece, ...]:
    body = stack([make_ellipse(radius, n=48) for radius in (50.0, 54.0, 62.9)], (-147.0, -141.0, 71.0), "blue")
    wall = revolve_wall(((62.9, 71.0, 58.5, 71.0), (66.4, 87.9, 60.5, 87.9)), "white")
    # The lid is recessed inside of its rim, with a bar across.
    bars = [make_rectangle(116, 24, 3), make_rectangle(112, 24, 3), make_rectangle(60, 22, 3)]
    bar = stack(bars, (71.0, 88.0, 95.6), "white").transform(rotation_degrees=(0, 0, 68))
    spout_outlines = [make_span((58.0, -3.0), (60.5, 3.0), 0.8), make_span((58.0, -16.0), (80.0, 16.0), 8.0)]
    spout = stack(spout_outlines, (40.0, 88.0), "blue").transform(rotation_degrees=(0, 0, 222.0))
    path = [(distance, 0.0, z) for distance, z in PROFILES["pitcher_handle"]]
    handle = loft(sweep_outlines(path, [make_rectangle(14.0, 23.0, 5.0)] * len(path), (0, 1, 0)), "blue", None)
    return _move((body, wall, bar, spout, handle.transform(rotation_degrees=(0, 0, 44.0))), (-13.5, -13.0, 0))


def _move(
    pieces: Sequence[Piece], offset: Sequence[float] = (0, 0, 0), rotation_degrees: Sequence[float] = (0, 0, 0)
) -> tuple[Piece, ...]:
    """Return pieces rotated and moved together, see `Piece.transform`."""
    return tuple(piece.transform(offset, rotation_degrees) for piece in pieces)


#: Function that makes the pieces of an object, by YCB class name.
OBJECT_SHAPES: MappingProxyType[str, Callable[[], tuple[Piece, ...]]] = MappingProxyType(
    {
        "002_master_chef_can": lambda: _move([_make_can(-73.7, 66.5, 50.2, 51.3, ("blue", "white"))], (-1.5, 0.6, 0)),
        "003_cracker_box": lambda: _move(
            [_make_carton("cracker_box", 163.5, ("red", "red", "yellow", "red", "white", "red"), 4)], (0, -1.7, 0)
        ),
        "004_sugar_box": lambda: _move(
            [_make_carton("sugar_box", 91.5, ("yellow", "white", "yellow", "blue"), 2)], (0, -1.4, 0), (0, 0, -2.6)
        ),
        "005_tomato_soup_can": lambda: _move([_make_can(-59.3, 42.6, 33.0, 33.8, ("red", "steel"))], (-0.3, 1.8, 0)),
        "006_mustard_bottle": _make_mustard_bottle,
        "007_tuna_fish_can": lambda: (_make_can(-20.8, 12.7, 42.0, 42.8, ("blue", "steel")),),
        "008_pudding_box": lambda: _move(
            _make_labelled_box((114.2, 89.9, 37.6), ("brown", "cream", "white"), 4.0),
            (-1.4, 4.1, -3.8),
            (1.1, -1.4, 28.4),
        ),
        "009_gelatin_box": lambda: _move(
            _make_labelled_box((72.7, 89.4, 29.2), ("red", "cream", "white"), 1.5), (-1.3, 0.3, -3.9), (0.4, -0.8, 13.3)
        ),
        "010_potted_meat_can": _make_potted_meat_can,
        "011_banana": _make_banana,
        "019_pitcher_base": _make_pitcher_base,
        "021_bleach_cleanser": _make_bleach_cleanser,
        "024_bowl": _make_bowl,
        "025_mug": _make_mug,
        "035_power_drill": _make_power_drill,
        "036_wood_block": lambda: _move(
            [make_block((89.7, 88.9, 206.0), "wood", 4.0)], (-1.8, 2.2, -17.5), (0.3, -0.4, -12.4)
        ),
        "037_scissors": _make_scissors,
        "040_large_marker": _make_large_marker,
        "051_large_clamp": lambda: _move(
            _make_clamp(PROFILES["large_clamp"], (-11.5, 11.5), (0.0, -2.0), (-17.6, 18.0)), (0, 0, 0), (3.0, 5.7, 0.0)
        ),
        "052_extra_large_clamp": lambda: _make_clamp(
            PROFILES["extra_large_clamp"], (-13.2, 13.6), (-3.0, 1.0), (-18.3, 17.9)
        ),
        "061_foam_brick": lambda: _move(
            [make_block((51.9, 77.4, 51.1), "red", 2.5)], (0.0, -0.2, 8.1), (0.2, 0.4, -0.8)
        ),
    }
)
