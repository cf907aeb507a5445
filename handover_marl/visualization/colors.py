"""Colors of the segmentation labels in figures and replays."""

from handover_marl.simulation.camera.images import SegmentationLabel

#: Colors as HTML and matplotlib write them, "#rrggbb".
LABEL_COLORS = {
    SegmentationLabel.BACKGROUND: "#e8e8e8",
    SegmentationLabel.ROBOT: "#555555",
    SegmentationLabel.TABLE: "#b08d57",
    SegmentationLabel.TARGET: "#e4572e",
    SegmentationLabel.OTHER_OBJECT: "#76b041",
    SegmentationLabel.HAND: "#2e86ab",
}
