"""Synthetic data set, generated scene by scene on demand."""

from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import Side, find_hand_urdf, make_hand_geometry
from handover_marl.assets.human_grasps import load_human_grasps
from handover_marl.assets.object_models import find_object_urdf
from handover_marl.assets.shipped import load_object_grasps
from handover_marl.datasets.dataset import Dataset, Scene, SceneInfo
from handover_marl.datasets.splits import PRESCRIBED_SIDE_TRIALS, SKIPPED_OBJECTS, get_prescribed_side
from handover_marl.datasets.synthetic.clutter import ClutterItem, draw_clutter, make_ycb_clutter_item
from handover_marl.datasets.synthetic.handover_motion import draw_motion
from handover_marl.datasets.synthetic.object_placement import (
    HeldObject,
    compute_hull_corners,
    draw_placement,
    hand_poses_from_grasps,
    make_ycb_held_object,
)
from handover_marl.datasets.synthetic.random_stream import VERSION, RandomStream, open_stream
from handover_marl.datasets.synthetic.resampling import compute_trajectories
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

# Numbers of other objects on the table.
_CLUTTER_COUNTS = range(2, 5)
# Number of left-handed last trials of subjects 0-1 and 2-9, in scenes of objects that are in splits. With the
# prescribed trials they give the 449 / 91 / 360 scenes of setup S2 (HandoverSim, Table I).
_N_LEFT_LAST_TRIALS = ((range(2), 19), (range(2, 10), 72))


class SyntheticDataset(Dataset):
    """1000 generated handovers with the library's own models; needs no data folder.

    Args:
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Raises:
        UnknownNameError: `robot` is not in `ROBOTS`.
    """

    name = "synthetic"

    def load_info(self, scene_id: int) -> SceneInfo:
        """Generate a scene and return its description; raises `SceneError`."""
        self.check_scene_id(scene_id)
        return _generate_scene(scene_id)[0]

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver without generating the scene."""
        self.check_scene_id(scene_id)
        return side_from_scene(scene_id)

    def load_scene(self, scene_id: int) -> Scene:
        """Generate a scene with its motion in the world frame; raises `SceneError`."""
        self.check_scene_id(scene_id)
        info, object_dof, hand_dof, hand_first = _generate_scene(scene_id)
        hand = find_hand_urdf(subject_from_scene(scene_id), side_from_scene(scene_id))
        return self.make_scene(
            info, self.find_assets(info, hand), object_dof, hand_dof, (hand_first, len(hand_dof) - 1)
        )

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of the library's URDF of a YCB class."""
        return find_object_urdf(object_name)

    def load_grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """Load the library's robot grasps (n, 4, 4) of a YCB class, or None if it has none."""
        return load_object_grasps(object_name)

    def check_scenes(self, scene_ids: tuple[int, ...]) -> None:
        """Check that the library's object models can be read."""
        for name in CLASS_NAMES.values():
            compute_hull_corners(name)

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return the version of the scene generator."""
        return f"synthetic-{VERSION}"


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
        shuffled = sorted(scenes, key=lambda scene: open_stream((VERSION, scene), "side").uniform())
        in_splits = [scene for scene in shuffled if scene // 5 % 20 not in SKIPPED_OBJECTS]
        chosen.update(in_splits[:count])
        chosen.update(scene for scene in shuffled[::2] if scene // 5 % 20 in SKIPPED_OBJECTS)
    return frozenset(chosen)


@lru_cache(maxsize=64)
def load_held_object(class_id: int, subject_id: int, side: Side) -> HeldObject:
    """Load an object of a YCB class with its robot grasps and the human grasps of one subject."""
    name = CLASS_NAMES[class_id]
    grasps = load_human_grasps(name, subject_id, side)
    return make_ycb_held_object(class_id, name, make_hand_geometry(subject_id, side), grasps, _load_robot_grasps(name))


@cache
def _load_robot_grasps(name: str) -> npt.NDArray[np.float64] | None:
    transforms = load_object_grasps(name)
    return None if transforms is None else hand_poses_from_grasps(transforms)


@lru_cache(maxsize=4)
def _generate_scene(scene_id: int) -> tuple[SceneInfo, npt.NDArray[np.float32], npt.NDArray[np.float32], int]:
    subject_id, side = subject_from_scene(scene_id), side_from_scene(scene_id)
    class_id = class_id_from_scene(scene_id)
    model = make_hand_geometry(subject_id, side)
    held = load_held_object(class_id, subject_id, side)
    # Keyframes at 25 Hz and other objects, in the table's frame.
    seed = (VERSION, scene_id)
    motion = draw_motion(seed, draw_placement(open_stream(seed, "placement"), held), held, model)
    others = [number for number in SCENE_CLASSES if number != class_id]

    def draw_item(random: RandomStream) -> ClutterItem:
        return make_ycb_clutter_item(others[random.integer(len(others))])

    clutter = draw_clutter(open_stream(seed, "clutter"), _CLUTTER_COUNTS, draw_item, held.corners, motion, model)
    object_dof, hand_dof, hand_first = compute_trajectories(motion, clutter)
    ids = (class_id, *(clutter_object.class_id for clutter_object in clutter))
    name = f"synthetic-subject-{subject_id:02d}/scene-{scene_id:03d}"
    info = SceneInfo(scene_id, name, side, ids, tuple(CLASS_NAMES[number] for number in ids))
    return info, object_dof, hand_dof, hand_first
