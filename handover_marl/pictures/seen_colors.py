"""One colour for each kind of thing, in every picture that does not show things as they look."""

from handover_marl.sim.camera.photo import Seen

#: Red, green and blue as HTML and matplotlib write them.
SEEN_COLORS = {
    Seen.BACKGROUND: "#e8e8e8",
    Seen.ROBOT: "#555555",
    Seen.TABLE: "#b08d57",
    Seen.TARGET: "#e4572e",
    Seen.OTHER_OBJECT: "#76b041",
    Seen.HAND: "#2e86ab",
}
