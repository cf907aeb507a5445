"""The generated dataset, made scene by scene when it is asked for."""

from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.assets.hand_model import hand_model, hand_urdf
from handover_marl.assets.human_grasps import human_grasps
from handover_marl.assets.object_models import object_urdf
from handover_marl.assets.robot_model import PANDA_URDF, camera_panda_urdf
from handover_marl.assets.shipped_grasps import load_object_grasps
from handover_marl.assets.table_model import TABLE_URDF
from handover_marl.datasets.dataset import TABLE_HEIGHT, Dataset
from handover_marl.datasets.scene import Scene, SceneAssets, SceneInfo
from handover_marl.datasets.synthetic.casting import class_number, hand_side, subject_number
from handover_marl.datasets.synthetic.clutter import StandingObject, draw_clutter
from handover_marl.datasets.synthetic.draws import VERSION
from handover_marl.datasets.synthetic.handing_over import KeyMotion, draw_motion
from handover_marl.datasets.synthetic.resampling import hand_trajectory, object_trajectory, rounded
from handover_marl.datasets.synthetic.room import grasp_poses
from handover_marl.datasets.synthetic.staging import draw_stage, hold
from handover_marl.models.panda import PANDA
from handover_marl.models.ycb import CLASS_NAMES


class SyntheticDataset(Dataset):
    """A thousand generated handovers; needs no data folder.

    Args:
        robot: Which Panda stands in the scenes.

    Raises:
        UnknownNameError: There is no such robot.
    """

    name = "synthetic"

    @property
    def panda_urdf(self) -> Path:
        """PyBullet's own Panda, as it is or with a camera."""
        return PANDA_URDF if self.robot == PANDA else camera_panda_urdf()

    def info(self, scene_id: int) -> SceneInfo:
        """Who gives what; the other objects are drawn with the motion."""
        self.check_scene_id(scene_id)
        return _generate(scene_id)[0]

    def side(self, scene_id: int) -> str:
        """The hand that gives, without generating the scene."""
        self.check_scene_id(scene_id)
        return hand_side(scene_id)

    def scene(self, scene_id: int) -> Scene:
        """A scene with its motion in the world frame."""
        self.check_scene_id(scene_id)
        info, object_dof, hand_dof, hand_first = _generate(scene_id)
        return Scene(
            info=info,
            dataset=self.name,
            assets=SceneAssets(
                table=TABLE_URDF,
                panda=self.panda_urdf,
                objects=tuple(object_urdf(name) for name in info.object_names),
                hand=hand_urdf(subject_number(scene_id), hand_side(scene_id)),
            ),
            object_dof=object_dof,
            hand_dof=hand_dof,
            hand_first=hand_first,
            hand_last=len(hand_dof) - 1,
        )

    def object_urdf(self, object_name: str) -> Path:
        """The shipped model of an object class."""
        return object_urdf(object_name)

    def grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """The shipped grasps of an object class, or None (master chef can and wood block have none)."""
        return load_object_grasps(object_name)

    def check_scenes(self, scene_ids: tuple[int, ...]) -> None:
        """Nothing can be missing."""

    def fingerprint(self, scene_id: int) -> str:
        """The generator's version."""
        return f"synthetic-{VERSION}"

    def models_in_words(self, scene_id: int) -> str:
        """Nothing: all synthetic scenes have the library's models."""
        return ""


def key_motion(scene_id: int) -> tuple[KeyMotion, tuple[StandingObject, ...]]:
    """The key poses of a scene at 25 Hz, and what else stands on the table (table frame)."""
    subject, side = subject_number(scene_id), hand_side(scene_id)
    class_id = class_number(scene_id)
    name = CLASS_NAMES[class_id]
    model = hand_model(subject, side)
    held = hold(class_id, name, model, human_grasps(name, subject, side), _robot_grasps(name))
    motion = draw_motion(scene_id, draw_stage(scene_id, held, name), held, model)
    return motion, draw_clutter(scene_id, class_id, motion, model)


@cache
def _robot_grasps(name: str) -> npt.NDArray[np.float64] | None:
    transforms = load_object_grasps(name)
    return None if transforms is None else grasp_poses(transforms)


@lru_cache(maxsize=4)
def _generate(scene_id: int) -> tuple[SceneInfo, npt.NDArray[np.float32], npt.NDArray[np.float32], int]:
    motion, clutter = key_motion(scene_id)
    given = object_trajectory(motion)
    object_dof = np.repeat(given[:, None], 1 + len(clutter), axis=1)
    for column, thing in enumerate(clutter, start=1):
        angles = Rotation.from_matrix(thing.rotation).as_euler("XYZ")
        object_dof[:, column] = rounded([*thing.position, *angles])
    hand_dof = hand_trajectory(motion)
    hand_first = motion.hand_first * (len(hand_dof) - 1) // (len(motion.fingers) - 1)
    object_dof[:, :, 2] += TABLE_HEIGHT
    hand_dof[hand_first:, 2] += TABLE_HEIGHT
    ids = (class_number(scene_id), *(thing.class_id for thing in clutter))
    subject = f"synthetic-subject-{subject_number(scene_id):02d}"
    info = SceneInfo(
        scene_id=scene_id,
        name=f"{subject}/scene-{scene_id:03d}",
        subject=subject,
        side=hand_side(scene_id),
        object_ids=ids,
        object_names=tuple(CLASS_NAMES[number] for number in ids),
    )
    return info, object_dof, hand_dof, hand_first
