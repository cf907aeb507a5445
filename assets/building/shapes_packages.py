"""Boxes, cans, the banana and the blocks (millimetres).

Sizes are those of the scanned objects of the YCB set (Calli et al., 2015) as DexYCB uses them. Each piece is
made upright around the origin and then moved to where the scan has it: centre, rotation vector in degrees.
"""

from collections.abc import Sequence

from handover_marl.assets.building.shapes import Piece, block, ellipse, follow, label, loft, rectangle, span, stack

_SKIN = 0.3  # how far a label stands out of what it is glued to


def _labelled_box(
    size: tuple[float, float, float], colours: tuple[str, str, str], flat_axis: int, corner: float = 1.5
) -> tuple[Piece, ...]:
    """A box with a coloured panel and a stripe on its two large faces, which lie across `flat_axis`."""
    body, panel, stripe = colours
    half = [extent / 2 for extent in size]
    long_axis = max((axis for axis in range(3) if axis != flat_axis), key=lambda axis: size[axis])
    pieces = [block(size, body, corner)]
    for share, (start, stop), colour in ((0.8, (-0.75, 0.1), panel), (0.9, (0.35, 0.75), stripe)):
        low, high = [-share * extent for extent in half], [share * extent for extent in half]
        low[long_axis], high[long_axis] = start * half[long_axis], stop * half[long_axis]
        low[flat_axis], high[flat_axis] = -half[flat_axis] - _SKIN, half[flat_axis] + _SKIN
        pieces.append(label(low, high, colour))
    return tuple(pieces)


def _carton(rows: Sequence[tuple[float, float, float]], depth: float, colours: Sequence[str], cut: int) -> Piece:
    """A standing carton, bent as the scanned one: z, lowest and highest x of its faces; `cut` splits its body."""
    outlines = [span((low, -depth / 2), (high, depth / 2), 1.5) for _, low, high in rows]
    return loft(stack(outlines, [row[0] for row in rows]), colours, (cut,))


def cracker_box() -> tuple[Piece, ...]:
    """003_cracker_box, 71.5 x 163.5 x 213.5: squeezed to 63 at half its height."""
    rows = (
        (-111.6, -35.0, 34.0), (-95.0, -36.3, 35.2), (-50.0, -35.8, 32.5), (0.0, -35.8, 29.0), (45.0, -34.8, 28.2),
        (75.0, -34.3, 31.5), (101.9, -34.0, 32.0),
    )  # fmt: skip
    colours = ("red", "red", "yellow", "red", "white", "red")
    return (_carton(rows, 163.5, colours, 4).moved((0, -1.7, 0)),)


def sugar_box() -> tuple[Piece, ...]:
    """004_sugar_box, 42 x 92 x 176, leaning by 1.5 degrees."""
    rows = (
        (-92.3, -19.5, 24.7),
        (-45.0, -20.5, 23.7),
        (0.0, -21.2, 22.0),
        (45.0, -21.8, 19.0),
        (83.6, -23.0, 17.0),
    )
    return (_carton(rows, 91.5, ("yellow", "white", "yellow", "blue"), 2).moved((0, -1.4, 0), (0, 0, -2.6)),)


def pudding_box() -> tuple[Piece, ...]:
    """008_pudding_box, 114.2 x 89.9 x 38.2."""
    pieces = _labelled_box((114.2, 89.9, 37.6), ("brown", "cream", "white"), 2, 4.0)
    return tuple(piece.moved((-1.4, 4.1, -3.8), (1.1, -1.4, 28.4)) for piece in pieces)


def gelatin_box() -> tuple[Piece, ...]:
    """009_gelatin_box, 72.7 x 89.4 x 29.8."""
    pieces = _labelled_box((72.7, 89.4, 29.2), ("red", "cream", "white"), 2)
    return tuple(piece.moved((-1.3, 0.3, -3.9), (0.4, -0.8, 13.3)) for piece in pieces)


def wood_block() -> tuple[Piece, ...]:
    """036_wood_block, 89.7 x 88.9 x 206."""
    return (block((89.7, 88.9, 206.0), "wood", 4.0).moved((-1.8, 2.2, -17.5), (0.3, -0.4, -12.4)),)


def foam_brick() -> tuple[Piece, ...]:
    """061_foam_brick, 51.9 x 77.4 x 51.1."""
    return (block((51.9, 77.4, 51.1), "red", 2.5).moved((0.0, -0.2, 8.1), (0.2, 0.4, -0.8)),)


def _can(low: float, high: float, body: float, rim: float, colours: tuple[str, str]) -> Piece:
    """A can with a label between two metal rims: z of its ends, radius of body and of rims."""
    paper, metal = colours
    heights = (low, low + 3, low + 5, high - 5, high - 3, high)
    radii = (rim, rim, body, body, rim, rim)
    return loft(stack([ellipse(r, n=40) for r in radii], heights), (metal, metal, paper, metal, metal))


def master_chef_can() -> tuple[Piece, ...]:
    """002_master_chef_can, diameter 102.5, height 140.1."""
    return (_can(-73.7, 66.5, 50.2, 51.3, ("blue", "white")).moved((-1.5, 0.6, 0)),)


def tomato_soup_can() -> tuple[Piece, ...]:
    """005_tomato_soup_can, diameter 67.8, height 101.9."""
    return (_can(-59.3, 42.6, 33.0, 33.8, ("red", "steel")).moved((-0.3, 1.8, 0)),)


def tuna_fish_can() -> tuple[Piece, ...]:
    """007_tuna_fish_can, diameter 85.5, height 33.5."""
    return (_can(-20.8, 12.7, 42.0, 42.8, ("blue", "steel")),)


def potted_meat_can() -> tuple[Piece, ...]:
    """010_potted_meat_can, 101.6 x 57.3 x 83.4: its lid is the widest part."""
    body, rim = rectangle(96.5, 51.5, 17.0, 6), rectangle(101.6, 57.3, 19.0, 6)
    rings = stack([body, body, body, rim, rim], (-49.8, -40.0, 26.0, 31.5, 33.8))
    return (loft(rings, ("steel", "navy", "steel", "steel"), (2,)).moved((-2.4, -0.5, 0), (0, 0, 2.6)),)


#: Along the banana's middle line: x, y, z and the radius there.
_BANANA = (
    (-11.5, -101.3, -2.0, 5.0),
    (-12.0, -97.0, -2.0, 8.5),
    (-13.0, -80.0, -1.0, 13.0),
    (-16.0, -55.0, 0.3, 16.5),
    (-16.2, -30.0, 1.0, 17.8),
    (-12.5, -5.0, 1.5, 18.2),
    (-4.5, 20.0, 1.5, 18.2),
    (6.5, 40.0, 1.7, 17.8),
    (20.0, 55.0, 1.2, 16.5),
    (34.0, 64.5, -2.0, 12.5),
    (46.0, 69.0, -6.5, 7.8),
    (58.0, 70.6, -9.3, 5.6),
    (73.2, 71.0, -10.3, 5.5),
)


def banana() -> tuple[Piece, ...]:
    """011_banana: 197 long, 37 thick."""
    path = [row[:3] for row in _BANANA]
    rings = follow(path, [ellipse(row[3], n=20) for row in _BANANA], (0, 0, 1))
    colours = ("brown", *["yellow"] * (len(_BANANA) - 3), "olive")
    return (loft(rings, colours, (2, 3, 4, 5, 6, 7, 8, 9, 10)),)
