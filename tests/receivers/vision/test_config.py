"""Checks of the configuration of the receiver `vision`."""

import math
from collections.abc import Callable

import pytest

from handover_marl.errors import OptionError
from handover_marl.receivers.vision.config import GraspTrackerConfig, VisionConfig, make_vision_reactive_config
from handover_marl.receivers.vision.finger_clearance import FingerGeometry
from handover_marl.receivers.vision.object_tracking import FilterGains


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: GraspTrackerConfig(keyframe_share=1.5), "keyframe_share of GraspTrackerConfig"),
        (lambda: GraspTrackerConfig(fingers=0.1), "fingers of GraspTrackerConfig must be a FingerGeometry"),  # type: ignore[arg-type]
        (
            lambda: GraspTrackerConfig(tilts=(0.1, math.nan)),
            "every number in tilts of GraspTrackerConfig must be a fin",
        ),
        (lambda: GraspTrackerConfig(tilts=0.1), "tilts of GraspTrackerConfig must be a tuple, got 0.1"),  # type: ignore[arg-type]
        (lambda: VisionConfig(release_delay=-0.1), "release_delay of VisionConfig"),
        (lambda: FingerGeometry(tip_z=-0.1), "tip_z of FingerGeometry"),
        (lambda: FilterGains(0.5, 0.1, 1.1), "grasp of FilterGains"),
    ],
)
def test_values_without_meaning(make: Callable[[], object], name: str) -> None:
    with pytest.raises(OptionError, match=name):
        make()


def test_tuples_of_any_length_and_defaults_are_accepted() -> None:
    assert GraspTrackerConfig(tilts=(0.1,)).tilts == (0.1,)
    assert make_vision_reactive_config().selection.hard_min_clearance == 0.0
