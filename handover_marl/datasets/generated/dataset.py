"""Data set of generated scenes, each made when it is loaded: object, person, human grasp, motion and other objects.

URDF and mesh files of procedural objects and hands are written to the user's cache folder. A folder's name has a hash
of its content, so that equal models of different data sets share files.
"""

import hashlib
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import HANDS_FOLDER, LEVELS, SUBJECTS, Side, format_hand_urdf, scale_hand
from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS, URDF_NAME, format_object_files
from handover_marl.datasets.generated.config import (
    GENERATED,
    HARD,
    VERSION,
    GeneratedConfig,
    find_splits,
    list_split,
    make_seed,
    parse_generated_config,
)
from handover_marl.datasets.generated.grasps import draw_human_grasps, draw_robot_grasps
from handover_marl.datasets.generated.hands import Person, draw_person
from handover_marl.datasets.generated.motion import KeyframeMotion, add_post_arrival_motion, draw_far_positions
from handover_marl.datasets.generated.placement import (
    ClutterItem,
    SimulatedGiver,
    hand_poses_from_grasps,
    make_ycb_clutter_item,
)
from handover_marl.datasets.generated.random_stream import RandomStream, Seed, open_stream
from handover_marl.datasets.generated.scenes import (
    GeneratedHandover,
    HandoverGenerator,
    generate_handover,
    make_subject_giver,
)
from handover_marl.datasets.generated.shapes import ProceduralObject, Solid, draw_object, make_surface
from handover_marl.datasets.splits import SPLITS
from handover_marl.errors import DataNotFoundError, HandoverError, ResultsError, check_name
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.array_cache import get_cache_folder
from handover_marl.geometry.panda import PANDA
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

Array = npt.NDArray[np.float64]

#: Class number of the first procedural object.
FIRST_CLASS: Final = max(CLASS_NAMES) + 1
#: Class numbers of the shipped objects that the gripper can span.
GRASPABLE_CLASSES: Final = tuple(each for each in SCENE_CLASSES if CLASS_NAMES[each] not in CLASSES_WITHOUT_GRASPS)
_MAX_ATTEMPTS = 50
# For the estimated share of robot grasps that the person leaves free: number of surface points from which robot grasps
# are tried, and largest and smallest number of these grasps; with fewer, the share is not estimated.
_N_SKETCH_POINTS, _N_SKETCH_GRASPS, _MIN_SKETCH_GRASPS = 160, 32, 5
# Version of the files, part of the hash of their content.
_FORMAT = 1


class GeneratedDataset(HandoverGenerator):
    """Data set of generated scenes, without a folder; a scene depends on its number and on all of `config` but `n`.

    Args:
        config: Configuration, or its text such as "n=100000,seed=7,family=hard", see `parse_generated_config`.
        robot: Variant of the Panda, as in `Dataset`.
    """

    scene_format = "08d"
    # Scenes and procedural objects are split by a hash of their number.
    setups = ("random",)
    quick_validation = True

    def __init__(self, config: GeneratedConfig | str, robot: str = PANDA) -> None:
        super().__init__(robot)
        self.config = parse_generated_config(config) if isinstance(config, str) else config
        self.name = f"{GENERATED}:{self.config.argument}"
        self._numbers = {f"object_{number:05d}": number for number in range(self.config.objects)}
        self.n_scenes = self.config.n
        self.object_names = {**CLASS_NAMES, **{FIRST_CLASS + number: name for name, number in self._numbers.items()}}

    def list_scenes(self, setup: str | None, split: str) -> tuple[int, ...]:
        """Return the scene numbers of a split ("train", "val" or "test") of the only setup in ascending order."""
        self.resolve_setup(setup)
        check_name("split", split, SPLITS)
        return tuple(list_split(split, self.config.n).tolist())

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver, "right" or "left", without generating the scene."""
        self.check_scene_id(scene_id)
        return _draw_side(self.config, scene_id)

    def generate(self, scene_id: int) -> GeneratedHandover:
        """Generate the scene `scene_id`, which must exist (not checked)."""
        return _generate_scene(self.config, scene_id)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of a class's URDF; the URDF of a procedural object is written on first use."""
        if object_name not in self._numbers:
            return super().find_object_urdf(object_name)
        return _write_object_model(object_name, _load_shape(self.config, self._numbers[object_name])[0])

    def load_grasps(self, object_name: str) -> Array | None:
        """Return the gripper poses (n, 4, 4) at grasps of a class, in the object's frame (m); None without grasps.

        Grasps of shipped objects have held the object in simulation. Grasps of procedural objects are
        antipodal and do not collide with the object; they are not simulated.
        """
        if object_name not in self._numbers:
            return super().load_grasps(object_name)
        random, solid = _open_grasp_stream(self.config, self._numbers[object_name])
        grasps = draw_robot_grasps(random, solid)
        return grasps if len(grasps) else None

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return a text that identifies the content of every scene: version and parameters of the generator.

        The parameter `n` is left out, since a larger `n` does not change a scene. The text is the same for all scenes.
        """
        return f"{GENERATED}-{VERSION}-{self.name.partition(',')[2]}"


def _draw_side(config: GeneratedConfig, scene_id: int) -> Side:
    return "left" if open_stream(make_seed(config, "scene", scene_id), "side").uniform() < config.left else "right"


@lru_cache(maxsize=4)
def _generate_scene(config: GeneratedConfig, scene_id: int) -> GeneratedHandover:
    split = SPLITS[int(find_splits([scene_id])[0])]
    giver, seed = _draw_giver(config, scene_id, split)
    counts = range(config.clutter_min, config.clutter_max + 1)

    def draw_item(random: RandomStream) -> ClutterItem:
        while True:
            item = _draw_clutter_item(random, config, split)
            if item[0] != giver.class_id:
                return item

    def extend_motion(motion: KeyframeMotion, grasp: int) -> KeyframeMotion:
        return add_post_arrival_motion(open_stream(seed, "post-arrival motion"), motion, giver, grasp)

    if config.family == HARD:
        return generate_handover(seed, giver, counts, draw_item, draw_far_positions, extend_motion)
    return generate_handover(seed, giver, counts, draw_item)


def _draw_giver(config: GeneratedConfig, scene_id: int, split: str) -> tuple[SimulatedGiver, Seed]:
    """Draw an object, shipped or procedural of `split`, and a person who can grasp it; return both and the seed."""
    side = _draw_side(config, scene_id)
    for attempt in range(_MAX_ATTEMPTS):
        seed = make_seed(config, "scene", scene_id, attempt)
        random, people = open_stream(seed, "object"), open_stream(seed, "person")
        if random.uniform() >= config.procedural:
            class_id = GRASPABLE_CLASSES[random.integer(len(GRASPABLE_CLASSES))]
            return make_subject_giver(class_id, SUBJECTS[people.integer(len(SUBJECTS))], side), seed
        number = _draw_object_number(random, config, split)
        item, solid = _load_shape(config, number)
        person = draw_person(config, people.integer(config.people))
        grasps = draw_human_grasps(open_stream(seed, "human grasps"), solid, item.up_axes, person.size, side)
        if grasps is not None:
            giver = SimulatedGiver(
                class_id=FIRST_CLASS + number,
                subject=person.name,
                hand=scale_hand(person.size, side),
                hand_urdf=write_hand_model(person, side),
                corners=solid.corners,
                up_axes=item.up_axes,
                wrist_distances=np.quantile(grasps.wrist_distance, LEVELS).tolist(),
                grasps=grasps,
                robot_grasps=_draw_grasps_for_free_share(config, number),
            )
            return giver, seed
    raise HandoverError(
        f"scene {scene_id}: no object can be grasped by its person after {_MAX_ATTEMPTS} attempts; "
        "use another seed or other shares of object kinds"
    )


def _draw_clutter_item(random: RandomStream, config: GeneratedConfig, split: str) -> ClutterItem:
    if random.uniform() >= config.procedural:
        return make_ycb_clutter_item(SCENE_CLASSES[random.integer(len(SCENE_CLASSES))])
    number = _draw_object_number(random, config, split)
    item, solid = _load_shape(config, number)
    return FIRST_CLASS + number, solid.corners, item.up_axes


def _draw_object_number(random: RandomStream, config: GeneratedConfig, split: str) -> int:
    numbers = _list_object_numbers(config.objects, split)
    return int(numbers[random.integer(len(numbers))])


@lru_cache(maxsize=16)
def _list_object_numbers(count: int, split: str) -> npt.NDArray[np.int64]:
    return list_split(split, count, of_objects=True)


@lru_cache(maxsize=1024)
def _load_shape(config: GeneratedConfig, number: int) -> tuple[ProceduralObject, Solid]:
    """Return the procedural object with a number from 0, and its solid; both depend only on `config` and the number."""
    item = draw_object(open_stream(make_seed(config, "object", number), "object"), config.kind_weights)
    return item, Solid(map(make_surface, item.parts))


def _open_grasp_stream(config: GeneratedConfig, number: int) -> tuple[RandomStream, Solid]:
    """Return the stream of random numbers for the robot grasps of a procedural object, and the object's solid."""
    return open_stream(make_seed(config, "object", number), "robot grasps"), _load_shape(config, number)[1]


@lru_cache(maxsize=256)
def _draw_grasps_for_free_share(config: GeneratedConfig, number: int) -> Array | None:
    """Return hand link poses (n, 7), xyz (m), xyzw, at 5 to 32 robot grasps in the object's frame; None if fewer."""
    random, solid = _open_grasp_stream(config, number)
    grasps = draw_robot_grasps(random, solid, _N_SKETCH_POINTS, _N_SKETCH_GRASPS, is_varied=False)
    return hand_poses_from_grasps(grasps) if len(grasps) >= _MIN_SKETCH_GRASPS else None


def _write_object_model(name: str, item: ProceduralObject) -> Path:
    """Write the model of object `item` unless it exists; return the path of its URDF, in a folder called `name`."""

    def make_files() -> dict[str, bytes | str]:
        surfaces = [(part.color, make_surface(part)) for part in item.parts]
        colored = [(color, surface.vertices, surface.faces) for color, surface in surfaces]
        return format_object_files(colored, [(vertices, faces) for _, vertices, faces in colored])

    return _write_folder(repr(item), name, URDF_NAME, make_files)


def write_hand_model(person: Person, side: Side) -> Path:
    """Write the model of a person's right or left hand unless it exists; return the path of its URDF."""
    meshes, name = str(HANDS_FOLDER / "meshes" / side), f"{person.name}_{side}"

    def make_files() -> dict[str, bytes | str]:
        return {"mano.urdf": format_hand_urdf(scale_hand(person.size, side), name, person.color, meshes)}

    return _write_folder(f"{person!r} {side} {meshes}", name, "mano.urdf", make_files)


def _write_folder(content: str, name: str, urdf: str, make_files: Callable[[], Mapping[str, bytes | str]]) -> Path:
    """Write a model to `HASH/name/` in the user's cache unless it exists; return the path of its file `urdf`.

    HASH is of the text `content`, which determines the files that `make_files` returns by file name, the URDF last.
    Several processes may write the same files. A folder that cannot be written raises `DataNotFoundError`.
    """
    digest = hashlib.sha256(f"{_FORMAT} {content}".encode()).hexdigest()[:20]
    root = get_cache_folder("generated")
    folder = root / digest / name
    if not (folder / urdf).is_file():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for file, text in make_files().items():
                write_atomically(folder / file, text)
        except (OSError, ResultsError) as error:
            raise DataNotFoundError(
                f"models of generated scenes cannot be written to {root} ({error}); "
                "set XDG_CACHE_HOME to a folder that can be written"
            ) from error
    return folder / urdf
