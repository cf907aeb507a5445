"""Who gives what with which hand: DexYCB's numbering and split sizes, with synthetic people."""

from functools import cache

from handover_marl.assets.hand_model import Side
from handover_marl.datasets.splits import SKIPPED_OBJECTS, TRIALS_BY_DESIGN, designed_side
from handover_marl.datasets.synthetic.draws import Draws
from handover_marl.models.ycb import SCENE_CLASSES

#: How many of the last trials are left-handed, for subjects 0-1 and 2-9, in scenes that belong to splits. With the
#: trials whose hand is fixed they make Table I's 449 / 91 / 360 scenes of setup s2.
_LEFT_LAST_TRIALS = ((range(2), 19), (range(2, 10), 72))


def subject_number(scene_id: int) -> int:
    """The person, 1 to 10."""
    return scene_id // 100 + 1


def class_number(scene_id: int) -> int:
    """The class of the object that is handed over."""
    return SCENE_CLASSES[scene_id // 5 % 20]


def hand_side(scene_id: int) -> Side:
    """The hand that gives: fixed for the first four trials, drawn for the last."""
    if scene_id % 5 in TRIALS_BY_DESIGN:
        return designed_side(scene_id)
    return "left" if scene_id in _left_last_trials() else "right"


@cache
def _left_last_trials() -> frozenset[int]:
    chosen: set[int] = set()
    for subjects, count in _LEFT_LAST_TRIALS:
        scenes = [scene for scene in range(4, 1000, 5) if scene // 100 in subjects]
        shuffled = sorted(scenes, key=lambda scene: Draws(scene, "side").uniform())
        counted = [scene for scene in shuffled if scene // 5 % 20 not in SKIPPED_OBJECTS]
        chosen.update(counted[:count])
        chosen.update(scene for scene in shuffled[::2] if scene // 5 % 20 in SKIPPED_OBJECTS)
    return frozenset(chosen)
