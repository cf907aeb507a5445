"""Drill, scissors, clamps and marker (millimetres, in the frame of the scanned models).

The tables are outlines of the scans of the YCB set (Calli et al., 2015), read off by hand and rounded. All lie
flat in the xy plane.
"""

import numpy as np

from handover_marl.assets.building.shapes import Array, Piece, ellipse, follow, loft, rectangle, span, stack, strip

#: The drill's barrel along x: x and radius.
_BARREL = (
    (-100.5, 11.0), (-94.0, 17.5), (-80.0, 20.3), (-47.0, 21.5), (-46.0, 24.0), (-15.0, 25.8), (15.0, 24.5),
    (60.0, 22.0), (77.0, 18.0), (83.0, 12.0),
)  # fmt: skip
#: The drill's handle downwards: y, lowest x, highest x, half thickness.
_DRILL_HANDLE = (
    (30.0, -30.0, 70.0, 13.0), (18.0, -29.0, 67.0, 13.0), (7.0, -10.0, 46.0, 14.0), (-18.0, 4.0, 46.0, 15.0),
    (-50.0, 8.5, 51.5, 16.0), (-83.0, 15.0, 53.0, 15.5),
)  # fmt: skip
#: Its battery: y, lowest x, highest x, lowest z, highest z.
_BATTERY = (
    (-79.0, -12.0, 54.0, -17.0, 18.0), (-86.0, -38.0, 57.0, -20.0, 23.0), (-105.0, -44.0, 59.5, -26.0, 29.5),
    (-112.0, -46.0, 57.0, -26.5, 30.8), (-114.6, -43.0, 50.0, -25.0, 29.0),
)  # fmt: skip


def _downwards(outlines: list[Array], heights: list[float]) -> Array:
    """Rings across the y axis: the outlines' x and y become x and z."""
    return stack(outlines, heights)[..., [0, 2, 1]]


def power_drill() -> tuple[Piece, ...]:
    """035_power_drill, 184 x 187 x 57: barrel along x, handle and battery towards -y."""
    circles = stack([ellipse(radius, n=28) for _, radius in _BARREL], [x for x, _ in _BARREL])
    colours = ("black", "black", "black", "steel", *["orange"] * 4, "black")
    barrel = loft(circles[..., [2, 0, 1]], colours, (3, 4)).moved((0, 46.8, 0))
    outlines = [span((low, -half), (high, half), 8.0) for _, low, high, half in _DRILL_HANDLE]
    rows = [row[0] for row in _DRILL_HANDLE]
    handle = loft(_downwards(outlines, rows), ("orange", "orange", "black", "orange", "black"), (1, 2, 3, 4))
    outlines = [span((x0, z0), (x1, z1), 10.0) for _, x0, x1, z0, z1 in _BATTERY]
    battery = loft(_downwards(outlines, [row[0] for row in _BATTERY]), "black")
    trigger = loft(_downwards([span((-17.0, -7.5), (-2.0, 7.5), 3.0), span((-12.0, -7.5), (6.0, 7.5), 3.0)],
                              [9.0, -15.0]), "red")  # fmt: skip
    return barrel, handle, battery, trigger


#: The scissors' loops: middle of the loop, direction of its long axis, half lengths of both axes.
_LOOPS = (((-33.5, -27.0), (0.5, 0.866), (23.5, 17.0)), ((11.8, -36.0), (0.1, 0.995), (32.5, 15.5)))
_LEFT_SHANK = (
    ((-30, -2), (-14, -13)),
    ((-10, 13), (-2, -2)),
    ((2, 30), (16, 12)),
    ((5, 42), (21, 36)),
    ((9, 46), (18, 46)),
)
_RIGHT_SHANK = (((-2, -8), (24, -10)), ((3, 6), (21, 4)), ((4, 30), (20, 30)))
_BLADES = (
    ((8, 44), (21, 41)),
    ((15, 75), (27.5, 72)),
    ((24, 104), (36, 103)),
    ((31, 122), (40.5, 122)),
    ((35, 128.8), (40.5, 128)),
)


def scissors() -> tuple[Piece, ...]:
    """037_scissors, 96 x 201.5 x 15.7, closed: two loops to grip, two blades that point to +y."""
    pieces = []
    for (x, y), direction, (long, short) in _LOOPS:
        along = np.array(direction) / np.hypot(*direction)
        angle = np.arange(16) * 2 * np.pi / 16
        flat = np.outer(long * np.cos(angle), along) + np.outer(short * np.sin(angle), (-along[1], along[0]))
        path = np.c_[flat + np.array([x, y]), np.zeros(16)]
        rings = follow(path, [rectangle(8.0, 14.4, 2.5, 3)] * 16, (0, 0, 1), closed=True)
        pieces.append(loft(rings, "orange", None, closed=True))
    pieces.append(loft(strip(_LEFT_SHANK, -7.8, 7.9), "orange", None))
    pieces.append(loft(strip(_RIGHT_SHANK, -7.0, 7.0), "orange", None))
    pieces.append(loft(strip(_BLADES, -2.5, 2.8, 0.8), "steel", None))
    return tuple(pieces)


#: The extra large clamp's halves from handle to jaw: xy of one edge, xy of the other.
_EXTRA_LARGE_CLAMP = (
    (
        ((78, 92.5), (87, 87)), ((66, 88), (79, 78)), ((8, 39), (9, 13)), ((-14, 40), (-12, 13)),
        ((-34, 44.5), (-36, 16.5)), ((-52, 38), (-56, 9)), ((-75, 21), (-77, -1)), ((-90, 8), (-87, -7)),
        ((-104.4, -6), (-101, -10)),
    ),
    (
        ((90, -71.7), (105.2, -62)), ((78, -68), (87, -55)), ((8, -35), (8, -11)), ((-6, -38), (-12, -12)),
        ((-30, -50.5), (-32, -24.5)), ((-50, -46), (-54, -20)), ((-75, -31), (-77, -13)),
        ((-92, -20.5), (-87, -8)), ((-104.4, -12), (-101, -9)),
    ),
)  # fmt: skip
_LARGE_CLAMP = (
    (
        ((-70.5, 60), (-63, 72)), ((-65, 51), (-50, 57)), ((-33, 8), (-10, 7)), ((-31, -8), (-11, -13)),
        ((-36, -28), (-10, -31)), ((-33, -45), (-8, -45)), ((-20, -62), (3, -60)), ((-1, -77), (8, -66)),
        ((9, -83.4), (11, -70)),
    ),
    (
        ((49.7, 72), (40, 87.5)), ((47, 60), (30, 66)), ((29, 16), (8, 7)), ((28, 2), (11, -13)),
        ((42.5, -26), (18, -31)), ((38, -45), (17, -45)), ((28, -62), (13, -61)), ((18, -80), (10, -68)),
        ((15, -83.4), (9, -82)),
    ),
)  # fmt: skip


def _clamp(
    halves: tuple[tuple[tuple[tuple[float, float], tuple[float, float]], ...], ...],
    bar: tuple[float, float],
    pivot: tuple[float, float],
    pin: tuple[float, float],
) -> tuple[Piece, ...]:
    """A spring clamp: two bars (z of their faces) on a pin (z of its ends) at `pivot`; jaw pads are orange."""
    colours = ("orange", "black", "black", "black", "black", "black", "black", "orange")
    arms = [loft(strip(half, *bar, bevel=3.0), colours, None) for half in halves]
    hub = loft(stack([ellipse(14.0), ellipse(14.0)], (bar[0] + 2, bar[1] - 2)), "black").moved((*pivot, 0))
    outlines = [ellipse(9.5, n=24), ellipse(12.0, n=24), ellipse(12.0, n=24), ellipse(9.5, n=24)]
    heights = (pin[0], pin[0] + 3, pin[1] - 3, pin[1])
    return *arms, hub, loft(stack(outlines, heights), "orange").moved((*pivot, 0))


def extra_large_clamp() -> tuple[Piece, ...]:
    """052_extra_large_clamp, 210 x 164 x 36."""
    return _clamp(_EXTRA_LARGE_CLAMP, (-13.2, 13.6), (-3.0, 1.0), (-18.3, 17.9))


def large_clamp() -> tuple[Piece, ...]:
    """051_large_clamp, 120 x 171 x 39; the scan lies slightly askew."""
    pieces = _clamp(_LARGE_CLAMP, (-11.5, 11.5), (0.0, -2.0), (-17.6, 18.0))
    return tuple(piece.moved(rotation_degrees=(3.0, 5.7, 0.0)) for piece in pieces)


#: The marker along y: x of its middle line, y, radius.
_MARKER = (
    (1.0, -58.2, 9.0),
    (1.0, -56.0, 9.4),
    (0.0, 20.0, 8.1),
    (-0.3, 34.0, 7.7),
    (-0.8, 44.0, 8.5),
    (-1.1, 57.0, 9.2),
)


def large_marker() -> tuple[Piece, ...]:
    """040_large_marker, diameter 18.8, length 120.8."""
    path = [(x, y, -0.3) for x, y, _ in _MARKER]
    outlines = [ellipse(radius, n=24) for *_, radius in _MARKER]
    body = loft(follow(path, outlines, (0, 0, 1)), ("black", "white", "white", "black", "black"), (3,))
    end = loft(follow([(-1.0, 56.9, -0.3), (-1.2, 62.5, -0.3)], [ellipse(4.6, n=24)] * 2, (0, 0, 1)), "black")
    return body, end
