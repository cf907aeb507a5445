"""Whether MANO's two files are the right and the left hand; neither tells, but together they do."""

import numpy as np

from handover_marl.datasets.importing.mano_model import ManoModel

_TWIN = 1e-3  # m; how far the left hand's vertices may be from the mirrored right hand's
_REACH = 0.03  # m; a grown-up's index finger begins farther than this from the wrist
_INDEX = 1  # joint at the root of the index finger


def doubts_about_sides(right: ManoModel, left: ManoModel) -> list[str]:
    """What is odd about the files: one was copied under both names, or their names were exchanged. A sentence each.

    MANO's left hand is its right hand with x negated. At rest the right hand's fingers point to -x, the left hand's to
    +x. Hands that are no mirror images of each other are not MANO's, and nothing is known of them.

    Args:
        right: What MANO_RIGHT.pkl holds.
        left: What MANO_LEFT.pkl holds.
    """
    if np.array_equal(right.v_template, left.v_template):
        return ["MANO_RIGHT.pkl and MANO_LEFT.pkl hold the same hand; take both from the original mano_v1_2.zip"]
    mirrored = right.v_template * [-1.0, 1.0, 1.0]
    if np.abs(mirrored - left.v_template).max() <= _TWIN and _reach(right) > _REACH and _reach(left) < -_REACH:
        return [
            "MANO_RIGHT.pkl seems to hold the left hand and MANO_LEFT.pkl the right one; if so, exchange their names "
            "and import into an empty folder"
        ]
    return []


def _reach(model: ManoModel) -> float:
    """How far the index finger's root lies beyond the wrist along x (m), in the mean hand."""
    joints = model.joints(model.v_template)
    return float(joints[_INDEX, 0] - joints[0, 0])
