"""Dimensions of human hands from published tables.

Sources:
    Buryanov and Kotiuk, "Proportions of hand segments", Int. J. Morphol. 28(3):755-758, 2010: mean
    lengths of the bones of 66 adults' hands in radiographs, and of the soft tissue at the fingertip.
    Gordon et al., "1988 Anthropometric Survey of U.S. Army Personnel: Methods and Summary
    Statistics", Natick TR-89/044, 1989: hand length and breadth of women and men.
    Greiner, "Hand Anthropometry of U.S. Army Personnel", Natick TR-92/011, 1991: circumferences of
    finger joints in the same survey.
"""

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True)
class Digit:
    """Mean bone lengths (m) of one digit of the human hand.

    Attributes:
        metacarpal: Length of the metacarpal bone, which is movable in the thumb only.
        phalanges: Lengths of the phalanges from the knuckle outwards; the thumb has two.
        tip: Thickness of the soft tissue at the fingertip.
    """

    metacarpal: float
    phalanges: tuple[float, ...]
    tip: float


#: Buryanov and Kotiuk (2010), Table I.
DIGITS: Final = MappingProxyType(
    {
        "index": Digit(0.06812, (0.03978, 0.02238, 0.01582), 0.00384),
        "middle": Digit(0.06460, (0.04463, 0.02633, 0.01740), 0.00395),
        "little": Digit(0.05369, (0.03274, 0.01811, 0.01596), 0.00373),
        "ring": Digit(0.05800, (0.04137, 0.02565, 0.01730), 0.00395),
        "thumb": Digit(0.04622, (0.03157, 0.02167), 0.00567),
    }
)

#: Distance (m) from the wrist's center to the base of each metacarpal. Not measured: chosen for a
#: hand of about average length with its knuckles on an arc.
CARPUS: Final = MappingProxyType({"index": 0.021, "middle": 0.0285, "ring": 0.0255, "little": 0.0215})


@dataclass(frozen=True)
class HandSize:
    """Outer dimensions (m) of a hand.

    Attributes:
        length: Distance from the wrist crease to the middle fingertip.
        breadth: Breadth over the four knuckles.
    """

    length: float
    breadth: float


#: Size of the reference hand: mean bone lengths, mean breadth of women and men. All other hands are scaled from it.
REFERENCE_SIZE: Final = HandSize(
    length=CARPUS["middle"] + DIGITS["middle"].metacarpal + sum(DIGITS["middle"].phalanges) + DIGITS["middle"].tip,
    breadth=0.0850,
)

#: Mean and standard deviation (m) of hand length and of hand breadth (Gordon et al., 1989).
WOMEN: Final = ((0.1805, 0.0097), (0.0794, 0.0038))
MEN: Final = ((0.1938, 0.0098), (0.0904, 0.0042))

# Standard scores of length (5th, 25th, 50th, 75th and 95th percentile) and of breadth. Breadth rises
# with length at a slope of about 0.6, with manual deviations for slender and broad hands.
_SCORES = ((-1.645, -1.3), (-0.674, 0.2), (0.0, -0.5), (0.674, 0.8), (1.645, 0.9))


#: Hand sizes of the ten subjects: in turn a woman and a man at the 5th, 25th, 50th, 75th and 95th
#: percentile of hand length.
SUBJECT_SIZES: Final = tuple(
    HandSize(round(length[0] + scores[0] * length[1], 4), round(breadth[0] + scores[1] * breadth[1], 4))
    for scores in _SCORES
    for length, breadth in (WOMEN, MEN)
)

#: Skin colors (red, green, blue, 0 to 1) of the ten subjects.
SKIN_COLORS: Final = (
    (0.91, 0.75, 0.66),
    (0.55, 0.37, 0.27),
    (0.86, 0.67, 0.54),
    (0.93, 0.79, 0.71),
    (0.42, 0.28, 0.20),
    (0.78, 0.58, 0.44),
    (0.69, 0.49, 0.36),
    (0.89, 0.71, 0.60),
    (0.34, 0.23, 0.17),
    (0.81, 0.62, 0.50),
)
