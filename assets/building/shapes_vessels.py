"""Bottles, mug, bowl and pitcher (millimetres, in the frame of the scanned models, z up).

The tables are outer dimensions measured on the scans of the YCB set (Calli et al., 2015), rounded.
"""

from handover_marl.assets.building.shapes import (
    Piece,
    ellipse,
    follow,
    loft,
    rectangle,
    revolved_wall,
    span,
    stack,
)

#: Mustard bottle by height: z, half width, half depth, exponent of the outline.
_MUSTARD = (
    (-83.9, 44.0, 25.0, 3.0),
    (-79.0, 47.9, 28.8, 3.0),
    (-50.0, 47.9, 27.6, 3.0),
    (-35.0, 45.6, 26.6, 3.0),
    (-18.0, 41.0, 25.8, 3.0),
    (-8.0, 41.0, 25.6, 3.0),
    (2.0, 44.0, 25.4, 3.0),
    (20.0, 48.1, 25.4, 3.0),
    (40.0, 47.3, 25.8, 3.0),
    (54.0, 42.2, 27.0, 3.0),
    (64.0, 34.5, 28.0, 2.6),
    (74.5, 22.0, 23.0, 2.0),
)


def mustard_bottle() -> tuple[Piece, ...]:
    """006_mustard_bottle, 96 x 57.6 x 191.4: a bottle with a waist, a cap and a nozzle."""
    body = loft(
        stack([ellipse(a, b, exponent=e) for _, a, b, e in _MUSTARD], [row[0] for row in _MUSTARD]),
        ("yellow",) * 6 + ("navy",) * 2 + ("yellow",) * 3,
        (3, 5, 7),
    )
    cap = loft(stack([ellipse(20.2)] * 2, (74.0, 88.0)), "white")
    nozzle = loft(stack([ellipse(13.0), ellipse(9.5), ellipse(7.0)], (87.9, 104.0, 107.5)), "white")
    return tuple(piece.moved((-0.8, -2.4, 0), (0, 0, -21.1)) for piece in (body, cap, nozzle))


#: Bleach bottle by height: z, lowest x and y, highest x and y.
_BLEACH = (
    (-112.0, -53.5, -28.5, 39.5, 33.5),
    (-107.0, -56.2, -31.4, 42.6, 36.3),
    (-93.0, -56.2, -31.4, 43.3, 36.3),
    (-87.0, -51.5, -30.6, 43.8, 35.4),
    (0.0, -46.4, -25.6, 46.1, 30.3),
    (53.0, -37.4, -22.1, 44.8, 27.1),
    (66.0, -31.6, -24.6, 44.0, 29.3),
    (79.0, -25.6, -24.8, 45.8, 29.3),
    (92.0, -28.0, -23.8, 43.6, 28.3),
    (100.0, -31.6, -23.2, 40.5, 27.8),
    (109.0, -24.0, -21.5, 36.0, 26.0),
    (118.5, -11.0, -13.0, 20.0, 18.0),
)


def bleach_cleanser() -> tuple[Piece, ...]:
    """021_bleach_cleanser, 102.4 x 67.7 x 250.6."""
    outlines = [span(row[1:3], row[3:5], exponent=3.0) for row in _BLEACH]
    colours = ("white", "white", "white", "blue", "white", "white", "white", "white", "white", "white", "white")
    body = loft(stack(outlines, [row[0] for row in _BLEACH]), colours, (3, 4, 5, 7, 9))
    collar = loft(stack([ellipse(15.2)] * 2, (118.0, 131.5)), "blue").moved((4.1, 2.3, 0))
    spout = loft(stack([ellipse(14.0)] * 2, (131.4, 138.5)), "blue").moved((4.3, 2.2, 0))
    return body, collar, spout


#: Bowl, bottom to rim: outer radius, z, inner radius, z.
_BOWL = (
    (44.0, -24.5, 43.0, -22.0),
    (59.0, -11.5, 55.5, -10.0),
    (68.5, 4.5, 65.5, 5.0),
    (73.5, 26.3, 71.0, 26.3),
)


def bowl() -> tuple[Piece, ...]:
    """024_bowl, diameter 161, height 55; its wall is 3 thick and open at the top."""
    wall = revolved_wall(_BOWL, "red", n_parts=18)
    rim = revolved_wall(((80.6, 26.5, 71.0, 26.5), (80.6, 30.0, 71.2, 30.4)), "red", n_parts=18)
    bottom = loft(stack([ellipse(44.0, n=48)] * 2, (-24.5, -22.0)), "red")
    return tuple(piece.moved((0.2, -0.9, 0)) for piece in (wall, rim, bottom))


#: Mug, bottom to rim: outer radius, z, inner radius, z.
_MUG = ((40.8, -36.0, 37.8, -36.0), (40.8, 39.8, 37.8, 39.8))
#: The mug's handle: x and z of its middle line.
_MUG_HANDLE = (
    (36.0, 27.5), (45.0, 27.3), (54.0, 24.5), (60.5, 16.0), (63.3, 5.0), (63.0, -5.0), (58.5, -14.5),
    (50.0, -21.0), (36.0, -24.0),
)  # fmt: skip


def mug() -> tuple[Piece, ...]:
    """025_mug, diameter 92.9 at the rim, height 81.5, with an open handle reaching 105 from the far wall."""
    wall = revolved_wall(_MUG, "red")
    rim = revolved_wall(((46.4, 40.0, 37.8, 39.8), (46.4, 42.0, 38.3, 42.4)), "red")
    floor = loft(stack([ellipse(38.0, n=48), ellipse(40.8, n=48), ellipse(40.8, n=48)], (-39.1, -36.5, -34.0)), "red")
    path = [(x, -1.7, z) for x, z in _MUG_HANDLE]
    handle = loft(follow(path, [rectangle(6.6, 14.4, 2.0)] * len(path), (0, 1, 0)), "red", None)
    return *(piece.moved((-3.7, 0.7, 0)) for piece in (wall, rim, floor)), handle


#: The pitcher's handle: distance from the pitcher's axis and z of its middle line.
_PITCHER_HANDLE = (
    (58.0, 74.0), (76.0, 75.0), (91.0, 67.0), (98.3, 50.0), (98.5, 10.0), (95.0, -18.0),
    (84.0, -42.0), (54.0, -66.0),
)  # fmt: skip


def pitcher_base() -> tuple[Piece, ...]:
    """019_pitcher_base, 242.7 high: a tapering body with lid, spout (towards -x -y) and handle (+x +y)."""
    radii, heights = (50.0, 54.0, 62.9), (-147.0, -141.0, 71.0)
    body = loft(stack([ellipse(radius, n=48) for radius in radii], heights), "blue")
    wall = revolved_wall(((62.9, 71.0, 58.5, 71.0), (66.4, 87.9, 60.5, 87.9)), "white")
    # The lid dips inside its rim and leaves a bar across to turn it by.
    bar = loft(
        stack([rectangle(116, 24, 3), rectangle(112, 24, 3), rectangle(60, 22, 3)], (71.0, 88.0, 95.6)), "white"
    ).moved(rotation_degrees=(0, 0, 68))
    spout_outlines = [span((58.0, -3.0), (60.5, 3.0), 0.8), span((58.0, -16.0), (80.0, 16.0), 8.0)]
    spout = loft(stack(spout_outlines, (40.0, 88.0)), "blue").moved(rotation_degrees=(0, 0, 222.0))
    path = [(distance, 0.0, z) for distance, z in _PITCHER_HANDLE]
    handle = loft(follow(path, [rectangle(14.0, 23.0, 5.0)] * len(path), (0, 1, 0)), "blue", None)
    handle = handle.moved(rotation_degrees=(0, 0, 44.0))
    return tuple(piece.moved((-13.5, -13.0, 0)) for piece in (body, wall, bar, spout, handle))
