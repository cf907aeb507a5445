"""Generation of a scene from its person and object, and the base class of generated data sets."""

from abc import abstractmethod
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import (
    WRIST_DISTANCE_QUANTILES,
    Side,
    find_hand_urdf,
    load_human_grasps,
    make_hand_geometry,
)
from handover_marl.assets.shipped import load_object_grasps
from handover_marl.datasets.dataset import Dataset, Scene, SceneInfo
from handover_marl.datasets.generated.motion import (
    KeyframeMotion,
    compute_swept_points,
    compute_trajectories,
    draw_motion,
)
from handover_marl.datasets.generated.placement import (
    ClutterItem,
    DrawPositions,
    SimulatedGiver,
    compute_hull_corners,
    draw_calibrated_positions,
    draw_clutter,
    draw_placement,
    hand_poses_from_grasps,
)
from handover_marl.datasets.generated.random_stream import UP_AXES, RandomStream, Seed, open_stream
from handover_marl.geometry.ycb import CLASS_NAMES


class GeneratedHandover(NamedTuple):
    """Generated scene: person, objects and their motion at 1 kHz in the world frame (m, rad).

    Attributes:
        giver: Person with the handed-over object.
        class_ids: Class numbers of the objects on the table, the handed-over one first.
        object_dof: (T, n, 6) float32 positions xyz and intrinsic XYZ Euler angles of the objects.
        hand_dof: (T, 51) float32 joint positions of the hand as in `Scene`.
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
    draw_positions: DrawPositions = draw_calibrated_positions,
    extend_motion: Callable[[KeyframeMotion, int], KeyframeMotion] | None = None,
) -> GeneratedHandover:
    """Generate the handover by a person: poses, motion, and other objects on the table.

    The number of other objects is drawn from `clutter_counts`, each object by `draw_item`. `draw_positions` draws the
    handed-over object's positions at start and handover. `extend_motion` returns a motion that goes on after the
    arrival at the handover pose, given the motion until then and the index of the grasp; None keeps the motion.
    """
    placement = draw_placement(open_stream(seed, "placement"), giver, draw_positions)
    motion = draw_motion(seed, placement, giver)
    if extend_motion is not None:
        motion = extend_motion(motion, placement.grasp)
    clutter = draw_clutter(open_stream(seed, "clutter"), clutter_counts, draw_item, compute_swept_points(motion, giver))
    ids = (giver.class_id, *(class_id for class_id, _, _ in clutter))
    return GeneratedHandover(giver, ids, *compute_trajectories(motion, clutter))


class HandoverGenerator(Dataset):
    """Base class of data sets whose scenes are generated when they are loaded.

    Attributes:
        scene_format: Format of the scene number in names of scenes, such as "03d".
    """

    scene_format: str

    @abstractmethod
    def generate(self, scene_id: int) -> GeneratedHandover:
        """Generate the scene `scene_id`, which must exist (not checked)."""

    def load_info(self, scene_id: int) -> SceneInfo:
        """Generate a scene and return its description; raise `SceneError` if the number does not exist."""
        self.check_scene_id(scene_id)
        handover, names = self.generate(scene_id), self.object_names
        giver, objects = handover.giver, tuple(names[number] for number in handover.class_ids)
        name = f"{giver.subject}/scene-{scene_id:{self.scene_format}}"
        return SceneInfo(scene_id, name, giver.hand.side, handover.class_ids, objects)

    def load_scene(self, scene_id: int) -> Scene:
        """Generate a scene with its motion in the world frame; raise `SceneError` if the number does not exist."""
        info, handover = self.load_info(scene_id), self.generate(scene_id)
        assets, last = self.find_assets(info, handover.giver.hand_urdf), len(handover.hand_dof) - 1
        return Scene(info, self.name, assets, handover.object_dof, handover.hand_dof, handover.hand_first, last)


@lru_cache(maxsize=64)
def make_subject_giver(class_id: int, subject: int, side: Side) -> SimulatedGiver:
    """Return synthetic subject 1 to 10 as the giver of an object (YCB class number) with the right or left hand."""
    name = CLASS_NAMES[class_id]
    transforms = load_object_grasps(name)
    return SimulatedGiver(
        class_id=class_id,
        subject=f"synthetic-subject-{subject:02d}",
        hand=make_hand_geometry(subject, side),
        hand_urdf=find_hand_urdf(subject, side),
        corners=compute_hull_corners(name),
        up_axes=UP_AXES[class_id],
        wrist_distances=WRIST_DISTANCE_QUANTILES[name],
        grasps=load_human_grasps(name, subject, side),
        robot_grasps=None if transforms is None else hand_poses_from_grasps(transforms),
    )
