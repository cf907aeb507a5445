"""Generation of one scene: object, person, human grasp, poses, motion and other objects."""

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import SUBJECTS, Side, scale_hand
from handover_marl.assets.human_grasps import LEVELS
from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS
from handover_marl.datasets.generated.config import HARD, GeneratedConfig, find_splits, list_split, make_seed
from handover_marl.datasets.generated.hands import draw_person
from handover_marl.datasets.generated.human_grasps import draw_human_grasps
from handover_marl.datasets.generated.model_files import write_hand_model
from handover_marl.datasets.generated.objects import ProceduralObject, draw_object
from handover_marl.datasets.generated.post_arrival_motion import add_post_arrival_motion, draw_far_positions
from handover_marl.datasets.generated.robot_grasps import SKETCH, RobotGraspConfig, draw_robot_grasps
from handover_marl.datasets.generated.shapes import Solid, make_surface
from handover_marl.datasets.splits import SPLITS
from handover_marl.datasets.synthetic.clutter import ClutterItem, make_ycb_clutter_item
from handover_marl.datasets.synthetic.dataset import (
    GeneratedHandover,
    SimulatedGiver,
    generate_handover,
    make_subject_giver,
)
from handover_marl.datasets.synthetic.handover_motion import KeyframeMotion
from handover_marl.datasets.synthetic.object_placement import hand_poses_from_grasps, make_held_object
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


def draw_side(config: GeneratedConfig, scene_id: int) -> Side:
    """Return the side of the giver's hand in a scene."""
    return "left" if open_stream(make_seed(config, "scene", scene_id), "side").uniform() < config.left else "right"


@lru_cache(maxsize=4)
def generate_scene(config: GeneratedConfig, scene_id: int) -> GeneratedHandover:
    """Generate a scene: a pure function of the scene's number and of the configuration without `n`; cached.

    Raises:
        HandoverError: No grasp was found for many objects in a row.
        DataNotFoundError: The user's cache folder, for the model of the hand, cannot be written.
    """
    split = int(find_splits([scene_id])[0])
    giver, seed = _draw_giver(config, scene_id, split)
    counts = range(config.clutter_min, config.clutter_max + 1)

    def draw_item(random: RandomStream) -> ClutterItem:
        while True:
            item = _draw_clutter_item(random, config, split)
            if item.class_id != giver.class_id:
                return item

    def extend_motion(motion: KeyframeMotion, grasp: int) -> KeyframeMotion:
        return add_post_arrival_motion(open_stream(seed, "post-arrival motion"), motion, giver.held, grasp)

    if config.family == HARD:
        return generate_handover(seed, giver, counts, draw_item, draw_far_positions, extend_motion)
    return generate_handover(seed, giver, counts, draw_item)


def _draw_giver(config: GeneratedConfig, scene_id: int, split: int) -> tuple[SimulatedGiver, Seed]:
    """Draw object and person until the hand can grasp the object; return also the seed to go on with."""
    side = draw_side(config, scene_id)
    for attempt in range(_MAX_ATTEMPTS):
        seed = make_seed(config, "scene", scene_id, attempt)
        random, people = open_stream(seed, "object"), open_stream(seed, "person")
        if random.uniform() >= config.procedural:
            class_id = GRASPABLE_CLASSES[random.integer(len(GRASPABLE_CLASSES))]
            return make_subject_giver(class_id, SUBJECTS[people.integer(len(SUBJECTS))], side), seed
        numbers = list_object_numbers(config, split)
        number = int(numbers[random.integer(len(numbers))])
        item, solid = _load_shape(config, number)
        person = draw_person(config, people.integer(config.people))
        grasps = draw_human_grasps(open_stream(seed, "human grasps"), solid, item.up_axes, person.size, side)
        if grasps is not None:
            distances, hand = np.quantile(grasps.wrist_distance, LEVELS).tolist(), scale_hand(person.size, side)
            held = make_held_object(
                solid.corners, item.up_axes, distances, hand, grasps, _draw_few_grasps(config, number)
            )
            urdf = write_hand_model(person, side)
            return SimulatedGiver(FIRST_CLASS + number, held, person.name, side, hand, urdf), seed
    raise HandoverError(
        f"scene {scene_id}: no object can be grasped by its person after {_MAX_ATTEMPTS} attempts; "
        "use another seed or other shares of object kinds"
    )


def _draw_clutter_item(random: RandomStream, config: GeneratedConfig, split: int) -> ClutterItem:
    if random.uniform() >= config.procedural:
        return make_ycb_clutter_item(SCENE_CLASSES[random.integer(len(SCENE_CLASSES))])
    numbers = list_object_numbers(config, split)
    number = int(numbers[random.integer(len(numbers))])
    item, solid = _load_shape(config, number)
    return ClutterItem(FIRST_CLASS + number, solid.corners, item.up_axes)


@lru_cache(maxsize=16)
def list_object_numbers(config: GeneratedConfig, split: int) -> npt.NDArray[np.int64]:
    """Return the numbers of the procedural objects of a split, given by its index in `SPLITS`."""
    return list_split(SPLITS[split], config.objects, of_objects=True)


def draw_procedural_object(config: GeneratedConfig, number: int) -> ProceduralObject:
    """Draw a procedural object by its number, from 0."""
    return draw_object(open_stream(make_seed(config, "object", number), "object"), config.kind_weights)


def draw_object_grasps(config: GeneratedConfig, number: int, grasps: RobotGraspConfig) -> Array:
    """Draw robot grasps (n, 4, 4) of a procedural object, see `draw_robot_grasps`."""
    random = open_stream(make_seed(config, "object", number), "robot grasps")
    return draw_robot_grasps(random, _load_shape(config, number)[1], grasps)


@lru_cache(maxsize=1024)
def _load_shape(config: GeneratedConfig, number: int) -> tuple[ProceduralObject, Solid]:
    item = draw_procedural_object(config, number)
    return item, Solid(map(make_surface, item.parts))


@lru_cache(maxsize=256)
def _draw_few_grasps(config: GeneratedConfig, number: int) -> Array | None:
    """Return poses (n, 7) of the gripper's hand link at a few robot grasps, or None if hardly any is found."""
    grasps = draw_object_grasps(config, number, SKETCH)
    return hand_poses_from_grasps(grasps) if len(grasps) >= _MIN_ROBOT_GRASPS else None
