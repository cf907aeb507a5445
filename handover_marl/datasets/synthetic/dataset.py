"""Data sets of generated handovers, and the synthetic one, all made scene by scene on demand."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import HandGeometry, Side, find_hand_urdf, make_hand_geometry
from handover_marl.assets.human_grasps import WRIST_DISTANCE_QUANTILES, load_human_grasps
from handover_marl.assets.shipped import load_object_grasps
from handover_marl.datasets.dataset import Dataset, Scene, SceneInfo
from handover_marl.datasets.splits import PRESCRIBED_SIDE_TRIALS, SKIPPED_OBJECTS, get_prescribed_side
from handover_marl.datasets.synthetic.clutter import ClutterItem, draw_clutter, make_ycb_clutter_item
from handover_marl.datasets.synthetic.handover_motion import KeyframeMotion, draw_motion
from handover_marl.datasets.synthetic.object_placement import (
    HandoverPositions,
    HeldObject,
    compute_hull_corners,
    draw_calibrated_positions,
    draw_placement,
    hand_poses_from_grasps,
    make_held_object,
)
from handover_marl.datasets.synthetic.random_stream import UP_AXES, VERSION, RandomStream, Seed, open_stream
from handover_marl.datasets.synthetic.resampling import compute_trajectories
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES


@dataclass(frozen=True, eq=False)
class SimulatedGiver:
    """Person and object of a generated scene.

    Attributes:
        class_id: Class number of the handed-over object.
        held: Object with its grasps.
        subject: Name of the person.
        side: Side of the hand.
        hand: Geometry of the hand.
        hand_urdf: URDF of the hand.
    """

    class_id: int
    held: HeldObject
    subject: str
    side: Side
    hand: HandGeometry
    hand_urdf: Path


@dataclass(frozen=True, eq=False)
class GeneratedHandover:
    """Generated scene in the world frame; see `Scene`.

    Attributes:
        giver: Person and object.
        class_ids: Class numbers of the objects on the table, the handed-over one first.
        object_dof: (T, n, 6) float32 motion of the objects.
        hand_dof: (T, 51) float32 motion of the hand.
        hand_first: First frame in which the hand is visible; it remains visible to the end.
    """

    giver: SimulatedGiver
    class_ids: tuple[int, ...]
    object_dof: npt.NDArray[np.float32]
    hand_dof: npt.NDArray[np.float32]
    hand_first: int


def generate_handover(
    seed: Seed,
    giver: SimulatedGiver,
    clutter_counts: range,
    draw_item: Callable[[RandomStream], ClutterItem],
    draw_positions: Callable[[RandomStream], HandoverPositions] = draw_calibrated_positions,
    extend_motion: Callable[[KeyframeMotion, int], KeyframeMotion] | None = None,
) -> GeneratedHandover:
    """Generate the handover of a person: poses, motion and other objects.

    Args:
        seed: Seed of the scene.
        giver: Person and object.
        clutter_counts: Numbers of other objects, all equally likely.
        draw_item: Function that draws another object.
        draw_positions: Function that draws the object's positions.
        extend_motion: Function that continues a motion, given the number of the grasp; None for none.
    """
    placement = draw_placement(open_stream(seed, "placement"), giver.held, draw_positions)
    # Keyframes at 25 Hz in the table's frame.
    motion = draw_motion(seed, placement, giver.held, giver.hand)
    if extend_motion is not None:
        motion = extend_motion(motion, placement.grasp)
    random = open_stream(seed, "clutter")
    clutter = draw_clutter(random, clutter_counts, draw_item, giver.held.corners, motion, giver.hand)
    ids = (giver.class_id, *(item.class_id for item in clutter))
    return GeneratedHandover(giver, ids, *compute_trajectories(motion, clutter))


class HandoverGenerator(Dataset):
    """Base class of generated data sets.

    Attributes:
        scene_format: Format of the scene number in names.
    """

    scene_format: str

    @abstractmethod
    def generate(self, scene_id: int) -> GeneratedHandover:
        """Generate an existing scene."""

    def load_info(self, scene_id: int) -> SceneInfo:
        """Generate a scene and return its description; raises `SceneError`."""
        self.check_scene_id(scene_id)
        handover, names = self.generate(scene_id), self.object_names
        giver, objects = handover.giver, tuple(names[number] for number in handover.class_ids)
        name = f"{giver.subject}/scene-{scene_id:{self.scene_format}}"
        return SceneInfo(scene_id, name, giver.side, handover.class_ids, objects)

    def load_scene(self, scene_id: int) -> Scene:
        """Generate a scene with its motion in the world frame; raises `SceneError`."""
        info, handover = self.load_info(scene_id), self.generate(scene_id)
        assets, span = (
            self.find_assets(info, handover.giver.hand_urdf),
            (handover.hand_first, len(handover.hand_dof) - 1),
        )
        return self.make_scene(info, assets, handover.object_dof, handover.hand_dof, span)


# Numbers of other objects on the table.
_CLUTTER_COUNTS = range(2, 5)
# Number of left-handed last trials of subjects 0-1 and 2-9, in scenes of objects that are in splits. With the
# prescribed trials they give the 449 / 91 / 360 scenes of setup S2 (HandoverSim, Table I).
_N_LEFT_LAST_TRIALS = ((range(2), 19), (range(2, 10), 72))


class SyntheticDataset(HandoverGenerator):
    """1000 generated handovers with the library's own models; needs no data folder.

    Args:
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Raises:
        UnknownNameError: `robot` is not in `ROBOTS`.
    """

    name = "synthetic"
    scene_format = "03d"

    def generate(self, scene_id: int) -> GeneratedHandover:
        """Generate an existing scene."""
        return _generate_scene(scene_id)

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver without generating the scene."""
        self.check_scene_id(scene_id)
        return side_from_scene(scene_id)

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return the version of the scene generator."""
        return f"synthetic-{VERSION}"


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
def make_subject_giver(class_id: int, subject: int, side: Side) -> SimulatedGiver:
    """Return one of the ten subjects, numbered from 1, with an object of a YCB class."""
    name, hand = CLASS_NAMES[class_id], make_hand_geometry(subject, side)
    held = make_held_object(
        compute_hull_corners(name),
        UP_AXES[class_id],
        WRIST_DISTANCE_QUANTILES[name],
        hand,
        load_human_grasps(name, subject, side),
        _load_robot_grasps(name),
    )
    return SimulatedGiver(class_id, held, f"synthetic-subject-{subject:02d}", side, hand, find_hand_urdf(subject, side))


@cache
def _load_robot_grasps(name: str) -> npt.NDArray[np.float64] | None:
    transforms = load_object_grasps(name)
    return None if transforms is None else hand_poses_from_grasps(transforms)


@lru_cache(maxsize=4)
def _generate_scene(scene_id: int) -> GeneratedHandover:
    # As in DexYCB: 100 scenes of each subject, five of each object.
    class_id = SCENE_CLASSES[scene_id // 5 % 20]
    giver = make_subject_giver(class_id, scene_id // 100 + 1, side_from_scene(scene_id))
    others = [number for number in SCENE_CLASSES if number != class_id]

    def draw_item(random: RandomStream) -> ClutterItem:
        return make_ycb_clutter_item(others[random.integer(len(others))])

    return generate_handover((VERSION, scene_id), giver, _CLUTTER_COUNTS, draw_item)
