"""Subject, object class and hand of every synthetic scene, numbered as in DexYCB."""

from functools import cache

from handover_marl.assets.hand_model import Side
from handover_marl.datasets.splits import PRESCRIBED_SIDE_TRIALS, SKIPPED_OBJECTS, get_prescribed_side
from handover_marl.datasets.synthetic.random_stream import open_scene_streams
from handover_marl.geometry.ycb import SCENE_CLASSES

# Number of left-handed last trials of subjects 0-1 and 2-9, in scenes of objects that are in
# splits. With the prescribed trials they give the 449 / 91 / 360 scenes of setup S2 (HandoverSim,
# Table I).
_N_LEFT_LAST_TRIALS = ((range(2), 19), (range(2, 10), 72))


def subject_from_scene(scene_id: int) -> int:
    """Return the number, 1 to 10, of the subject in a synthetic scene."""
    return scene_id // 100 + 1


def class_id_from_scene(scene_id: int) -> int:
    """Return the YCB class number of the object that is handed over in a synthetic scene."""
    return SCENE_CLASSES[scene_id // 5 % 20]


def side_from_scene(scene_id: int) -> Side:
    """Return the giver's hand in a scene: prescribed in trials 0 to 3, drawn in trial 4."""
    if scene_id % 5 in PRESCRIBED_SIDE_TRIALS:
        return get_prescribed_side(scene_id)
    return "left" if scene_id in _draw_left_handed_trials() else "right"


@cache
def _draw_left_handed_trials() -> frozenset[int]:
    chosen: set[int] = set()
    for subjects, count in _N_LEFT_LAST_TRIALS:
        scenes = [scene for scene in range(4, 1000, 5) if scene // 100 in subjects]
        shuffled = sorted(scenes, key=lambda scene: open_scene_streams(scene).open("side").uniform())
        in_splits = [scene for scene in shuffled if scene // 5 % 20 not in SKIPPED_OBJECTS]
        chosen.update(in_splits[:count])
        chosen.update(scene for scene in shuffled[::2] if scene // 5 % 20 in SKIPPED_OBJECTS)
    return frozenset(chosen)
