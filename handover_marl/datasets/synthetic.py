"""1000 generated handovers whose statistics follow DexYCB; no license restricts their use.

A scene depends only on its number and on the generator's `VERSION`. As in DexYCB, ten subjects have 100 scenes each:
five with each of 20 objects.
"""

from functools import cache, lru_cache

from handover_marl.assets.hand_model import Side
from handover_marl.datasets.generated.placement import ClutterItem, make_ycb_clutter_item
from handover_marl.datasets.generated.random_stream import VERSION, RandomStream, open_stream
from handover_marl.datasets.generated.scenes import (
    GeneratedHandover,
    HandoverGenerator,
    generate_handover,
    make_subject_giver,
)
from handover_marl.datasets.splits import SKIPPED_OBJECTS, get_prescribed_side
from handover_marl.geometry.ycb import SCENE_CLASSES

# Numbers of other objects on the table.
_CLUTTER_COUNTS = range(2, 5)
# Number of left-handed last trials of subjects 0-1 and 2-9, in scenes of objects that are in splits. With the
# prescribed trials they give the 449 / 91 / 360 scenes of setup S2 (HandoverSim, Table I).
_N_LEFT_LAST_TRIALS = ((range(2), 19), (range(2, 10), 72))


class SyntheticDataset(HandoverGenerator):
    """1000 generated handovers with the library's own models; for the argument `robot` see `Dataset`."""

    name = "synthetic"
    scene_format = "03d"

    def generate(self, scene_id: int) -> GeneratedHandover:
        """Generate the scene `scene_id`, which must exist (not checked)."""
        return _generate_scene(scene_id)

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver, "right" or "left", without generating the scene."""
        self.check_scene_id(scene_id)
        return _find_side(scene_id)

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return "synthetic-VERSION", the same for all scenes; VERSION is the version of the generator."""
        return f"synthetic-{VERSION}"


def _find_side(scene_id: int) -> Side:
    """Return the giver's hand in a scene: prescribed in trials 0 to 3, drawn in trial 4."""
    return get_prescribed_side(scene_id) or ("left" if scene_id in _draw_left_handed_trials() else "right")


@cache
def _draw_left_handed_trials() -> frozenset[int]:
    chosen: set[int] = set()
    for subjects, count in _N_LEFT_LAST_TRIALS:
        scenes = [scene for scene in range(4, 1000, 5) if scene // 100 in subjects]
        shuffled = sorted(scenes, key=lambda scene: open_stream((VERSION, scene), "side").uniform())
        in_splits = [scene for scene in shuffled if scene // 5 % 20 not in SKIPPED_OBJECTS]
        chosen.update(in_splits[:count])
        chosen.update(scene for scene in shuffled[::2] if scene // 5 % 20 in SKIPPED_OBJECTS)
    return frozenset(chosen)


@lru_cache(maxsize=40)  # the 36 scenes of a validation split, 1 MB each
def _generate_scene(scene_id: int) -> GeneratedHandover:
    class_id = SCENE_CLASSES[scene_id // 5 % 20]
    giver = make_subject_giver(class_id, scene_id // 100 + 1, _find_side(scene_id))
    others = [number for number in SCENE_CLASSES if number != class_id]

    def draw_item(random: RandomStream) -> ClutterItem:
        return make_ycb_clutter_item(others[random.integer(len(others))])

    return generate_handover((VERSION, scene_id), giver, _CLUTTER_COUNTS, draw_item)
