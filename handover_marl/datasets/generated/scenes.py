"""Generation of one scene: object, person, human grasp, poses, motion and other objects."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import SUBJECTS, HandGeometry, Side, make_hand_geometry, scale_hand
from handover_marl.assets.human_grasps import LEVELS
from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS
from handover_marl.datasets.generated.config import HARD, GeneratedConfig, find_splits, list_split, make_seed
from handover_marl.datasets.generated.hands import Person, draw_person
from handover_marl.datasets.generated.human_grasps import draw_human_grasps
from handover_marl.datasets.generated.objects import ProceduralObject, draw_object
from handover_marl.datasets.generated.post_arrival_motion import add_post_arrival_motion, draw_far_positions
from handover_marl.datasets.generated.robot_grasps import SKETCH, RobotGraspConfig, draw_robot_grasps
from handover_marl.datasets.generated.shapes import Solid
from handover_marl.datasets.splits import SPLITS
from handover_marl.datasets.synthetic.clutter import ClutterItem, ClutterObject, draw_clutter, make_ycb_clutter_item
from handover_marl.datasets.synthetic.dataset import load_held_object
from handover_marl.datasets.synthetic.handover_motion import KeyframeMotion, draw_motion
from handover_marl.datasets.synthetic.object_placement import (
    HeldObject,
    draw_calibrated_positions,
    draw_placement,
    hand_poses_from_grasps,
    make_held_object,
)
from handover_marl.datasets.synthetic.random_stream import RandomStream, Seed, open_stream
from handover_marl.errors import HandoverError
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

Array = npt.NDArray[np.float64]

#: Class number of the first procedural object.
FIRST_CLASS: Final = max(CLASS_NAMES) + 1
#: Classes of shipped objects that the gripper can span.
GRASPABLE_CLASSES: Final = tuple(
    number for number in SCENE_CLASSES if CLASS_NAMES[number] not in CLASSES_WITHOUT_GRASPS
)
_MAX_ATTEMPTS = 50
# With fewer grasps the share that the person leaves free is not estimated.
_MIN_ROBOT_GRASPS = 5


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Procedural object with the geometry and grasps that scenes need; arrays are read-only.

    Attributes:
        item: Object.
        solid: Solid of its parts.
        corners: (n, 3) corners of the hull (m).
        robot_grasps: (n, 7) poses of the gripper's hand link at a few robot grasps, or None without any.
    """

    item: ProceduralObject
    solid: Solid
    corners: Array
    robot_grasps: Array | None


@dataclass(frozen=True, eq=False)
class PersonWithObject:
    """Person and object of a scene.

    Attributes:
        class_id: Class number of the handed-over object.
        subject: Name of the person.
        side: Side of the hand.
        hand: Geometry of the hand.
        held: Object with its grasps.
        person: Person with a hand of its own, or the number of one of the ten shipped subjects.
    """

    class_id: int
    subject: str
    side: Side
    hand: HandGeometry
    held: HeldObject
    person: Person | int


@dataclass(frozen=True, eq=False)
class GeneratedHandover:
    """Keyframes of a scene in the table's frame.

    Attributes:
        giver: Person and object.
        motion: Keyframes of object and hand at 25 Hz.
        clutter: Other objects on the table.
    """

    giver: PersonWithObject
    motion: KeyframeMotion
    clutter: tuple[ClutterObject, ...]


def draw_side(config: GeneratedConfig, scene_id: int) -> Side:
    """Return the side of the giver's hand in a scene."""
    return "left" if open_stream(make_seed(config, "scene", scene_id), "side").uniform() < config.left else "right"


def generate_handover(config: GeneratedConfig, scene_id: int) -> GeneratedHandover:
    """Generate a scene: a pure function of the scene's number and of the configuration without `n`.

    Raises:
        HandoverError: No grasp was found for many objects in a row.
    """
    split = int(find_splits([scene_id])[0])
    giver, seed = _draw_giver(config, scene_id, split)
    is_hard = config.family == HARD
    draw_positions = draw_far_positions if is_hard else draw_calibrated_positions
    placement = draw_placement(open_stream(seed, "placement"), giver.held, draw_positions)
    motion = draw_motion(seed, placement, giver.held, giver.hand)
    if is_hard:
        motion = add_post_arrival_motion(open_stream(seed, "post-arrival motion"), motion, giver.held, placement.grasp)

    def draw_item(random: RandomStream) -> ClutterItem:
        while True:
            item = _draw_clutter_item(random, config, split)
            if item.class_id != giver.class_id:
                return item

    counts = range(config.clutter_min, config.clutter_max + 1)
    clutter = draw_clutter(open_stream(seed, "clutter"), counts, draw_item, giver.held.corners, motion, giver.hand)
    return GeneratedHandover(giver, motion, clutter)


def _draw_giver(config: GeneratedConfig, scene_id: int, split: int) -> tuple[PersonWithObject, Seed]:
    """Draw object and person until the hand can grasp the object; return also the seed to go on with."""
    side = draw_side(config, scene_id)
    for attempt in range(_MAX_ATTEMPTS):
        seed = make_seed(config, "scene", scene_id, attempt)
        random = open_stream(seed, "object")
        if random.uniform() >= config.procedural:
            return _make_shipped_giver(random, open_stream(seed, "person"), side), seed
        numbers = list_object_numbers(config, split)
        number = int(numbers[random.integer(len(numbers))])
        model = load_object_model(config, number)
        person = draw_person(config, open_stream(seed, "person").integer(config.people))
        grasps = draw_human_grasps(
            open_stream(seed, "human grasps"), model.solid, model.item.up_axes, person.size, side
        )
        if grasps is not None:
            distances = np.quantile(grasps.wrist_distance, LEVELS)
            hand = scale_hand(person.size, side)
            held = make_held_object(
                model.corners, model.item.up_axes, tuple(distances.tolist()), hand, grasps, model.robot_grasps
            )
            return PersonWithObject(FIRST_CLASS + number, person.name, side, hand, held, person), seed
    raise HandoverError(
        f"scene {scene_id}: no object can be grasped by its person after {_MAX_ATTEMPTS} attempts; "
        "use another seed or other shares of object kinds"
    )


def _make_shipped_giver(objects: RandomStream, people: RandomStream, side: Side) -> PersonWithObject:
    class_id = GRASPABLE_CLASSES[objects.integer(len(GRASPABLE_CLASSES))]
    subject = SUBJECTS[people.integer(len(SUBJECTS))]
    held = load_held_object(class_id, subject, side)
    return PersonWithObject(
        class_id, f"synthetic-subject-{subject:02d}", side, make_hand_geometry(subject, side), held, subject
    )


def _draw_clutter_item(random: RandomStream, config: GeneratedConfig, split: int) -> ClutterItem:
    if random.uniform() >= config.procedural:
        return make_ycb_clutter_item(SCENE_CLASSES[random.integer(len(SCENE_CLASSES))])
    numbers = list_object_numbers(config, split)
    number = int(numbers[random.integer(len(numbers))])
    item, corners = _load_shape(config, number)
    return ClutterItem(FIRST_CLASS + number, corners, item.up_axes)


@lru_cache(maxsize=16)
def list_object_numbers(config: GeneratedConfig, split: int) -> npt.NDArray[np.int64]:
    """Return the numbers of the procedural objects of a split, given by its index in `SPLITS`."""
    return list_split(SPLITS[split], config.objects, of_objects=True)


def draw_procedural_object(config: GeneratedConfig, number: int) -> ProceduralObject:
    """Draw a procedural object by its number, from 0."""
    return draw_object(open_stream(make_seed(config, "object", number), "object"), config.kind_weights)


def draw_object_grasps(config: GeneratedConfig, number: int, solid: Solid, grasps: RobotGraspConfig) -> Array:
    """Draw robot grasps (n, 4, 4) of a procedural object, see `draw_robot_grasps`."""
    return draw_robot_grasps(open_stream(make_seed(config, "object", number), "robot grasps"), solid, grasps)


@lru_cache(maxsize=1024)
def _load_shape(config: GeneratedConfig, number: int) -> tuple[ProceduralObject, Array]:
    """Return a procedural object and the corners of its hull; cached."""
    item = draw_procedural_object(config, number)
    corners = Solid(item.parts).corners
    corners.flags.writeable = False
    return item, corners


@lru_cache(maxsize=256)
def load_object_model(config: GeneratedConfig, number: int) -> ObjectModel:
    """Return a procedural object with its solid and a few robot grasps; cached."""
    item, corners = _load_shape(config, number)
    solid = Solid(item.parts)
    sketch = draw_object_grasps(config, number, solid, SKETCH)
    poses = hand_poses_from_grasps(sketch) if len(sketch) >= _MIN_ROBOT_GRASPS else None
    return ObjectModel(item, solid, corners, poses)
