"""Data set of custom scenes in a folder, `own:FOLDER`.

The motion of scene N is in `motion/00000N.npz`, in the world frame at 1 kHz:

- `object_dof` (T, n, 6): positions (m) and intrinsic XYZ Euler angles (rad) of the objects, the handed-over object
  first.
- `hand_dof` (T, 51): position (m) and intrinsic XYZ Euler angles (rad) of the hand's base, then 45 finger joint angles
  (rad); zeros in frames without a hand.
- `hand_span` (2,): first and last frame in which the hand is present; -1 and -1 without a hand.
"""

import hashlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import find_hand_urdf
from handover_marl.assets.shipped import URDF_NAME
from handover_marl.config import HAND_DOF, OBJECT_DOF
from handover_marl.datasets.custom.motion_checks import check_motion
from handover_marl.datasets.custom.scene_file import ALL_SCENES, read_scene_file
from handover_marl.datasets.dataset import Dataset, Scene, SceneAssets, SceneInfo
from handover_marl.datasets.official import check_grasps, read_motion, require_file
from handover_marl.datasets.splits import SPLITS
from handover_marl.errors import DataNotFoundError, UnknownNameError, check_name
from handover_marl.execution.reading import cached_by_file, read_arrays, read_plain_file, report_damage
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.model_files.urdf import list_mesh_references, read_model_mtimes
from handover_marl.geometry.panda import PANDA
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]

OBJECT_FOLDER, MOTION_FOLDER, GRASP_FILE = "objects", "motion", "grasps.npz"
_ADVICE = "copy the folder again, or add its object or motion again"


def get_motion_path(folder: Path, scene_id: int) -> Path:
    """Return the path of a scene's motion file in a folder of custom scenes."""
    return folder / MOTION_FOLDER / f"{scene_id:06d}.npz"


class CustomDataset(Dataset):
    """Data set of the custom scenes in a folder, see `handover_marl.datasets.custom.scene_file`.

    The setups are "all", in which each split has every scene, and those in `scenes.json`. For `robot` see `Dataset`.

    Attributes:
        folder: Path of the folder.
        content: Content of `scenes.json`.
    """

    def __init__(self, folder: Path, robot: str = PANDA) -> None:
        super().__init__(robot)
        self.folder = folder
        self.source_folder, self.content = folder, read_scene_file(folder)
        self.name, self.object_names = f"own:{self.content.name}", self.content.object_names
        self.n_scenes, self.setups = len(self.content.scenes), (ALL_SCENES, *self.content.setups)
        self._numbers = {name: number for number, name in self.object_names.items()}
        self._hash_model = cached_by_file(None, read_model_mtimes)(_hash_model)
        self._read_grasps = cached_by_file(None)(_load_grasps)

    def list_scenes(self, setup: str | None, split: str) -> tuple[int, ...]:
        """Return the scene numbers of a split in ascending order.

        Raises `UnknownNameError` if the setup or the split does not exist or the split is empty, `DataNotFoundError` if
        the folder has no scenes.
        """
        check_name("split", split, SPLITS)
        setup = self.resolve_setup(setup)
        if not self.n_scenes:
            raise DataNotFoundError(f"{self.folder} has no scenes; add one with `handover-marl scenes add-motion`")
        if setup == ALL_SCENES:
            return tuple(range(self.n_scenes))
        numbers = self.content.setups[setup][split]
        if not numbers:
            filled = [name for name in SPLITS if self.content.setups[setup][name]]
            raise UnknownNameError("split", split, filled, f"the split of setup {setup!r} is empty")
        return numbers

    def load_info(self, scene_id: int) -> SceneInfo:
        """Return the description of a scene by its number; raise `SceneError` if it does not exist."""
        self.check_scene_id(scene_id)
        scene = self.content.scenes[scene_id]
        ids = tuple(self._numbers[name] for name in scene.objects)
        return SceneInfo(scene_id, scene.name, scene.side, ids, scene.objects)

    def load_scene(self, scene_id: int) -> Scene:
        """Load a scene with its motion; raise `SceneError`, `DataNotFoundError` or `DataFormatError` if that fails."""
        info = self.load_info(scene_id)
        path, has_hand = get_motion_path(self.folder, scene_id), self.content.scenes[scene_id].hand is not None
        shapes = {"object_dof": (len(info.object_ids), OBJECT_DOF), "hand_dof": (HAND_DOF,)}
        object_dof, hand_dof = read_motion(path, shapes, _ADVICE)
        assets = self._find_scene_assets(info)
        meshes = zip(info.object_names, assets.objects, strict=True)
        bodies = {name: read_collision_mesh(urdf)[0] for name, urdf in meshes}
        with report_damage(path, "motion file", _ADVICE):
            first, last = read_arrays(path, ("hand_span",))["hand_span"].tolist()
            if not (0 <= first <= last < len(hand_dof) if has_hand else first == last == -1):
                rule = "frames of the motion" if has_hand else "-1 for a scene without a hand"
                raise ValueError(f"hand_span must be {rule}, got {first} and {last}")
            start, end = (first, last) if has_hand else (None, None)
            check_motion(object_dof, hand_dof, start, end, bodies)
        return Scene(info, self.name, assets, object_dof, hand_dof, start, end)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of the URDF of a class: in this folder for a user's class, in the library for a YCB class."""
        if object_name in CLASS_NAMES.values():
            return super().find_object_urdf(object_name)
        return require_file(self.folder / OBJECT_FOLDER / object_name / URDF_NAME, _ADVICE)

    def load_grasps(self, object_name: str) -> Array | None:
        """Load the gripper poses (n, 4, 4) at grasps of a class, in the object's frame (m); None without grasps."""
        if object_name in CLASS_NAMES.values():
            return super().load_grasps(object_name)
        grasps = self._read_grasps(self.folder / OBJECT_FOLDER / object_name / GRASP_FILE)
        return None if grasps is None else grasps.copy()

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return a hash of a scene's description, motion, model files and robot grasps, and of the robot's name."""
        assets, scene = self._find_scene_assets(self.load_info(scene_id)), self.content.scenes[scene_id]
        path = require_file(get_motion_path(self.folder, scene_id), _ADVICE)
        digest = hashlib.sha256(read_plain_file(path))
        digest.update(repr((scene.name, scene.side, scene.hand, scene.objects)).encode())
        grasps = self.load_grasps(scene.objects[0])
        digest.update(b"" if grasps is None else grasps.tobytes())
        digest.update(self.robot.encode())
        for urdf in (assets.table, assets.hand, *assets.objects):
            digest.update(self._hash_model(urdf))
        return digest.hexdigest()[:16]

    def _find_scene_assets(self, info: SceneInfo) -> SceneAssets:
        # A scene without a hand needs a model too, which is never shown.
        hand = self.content.scenes[info.scene_id].hand or 1
        return self.find_assets(info, find_hand_urdf(hand, "left" if info.side == "left" else "right"))


def _load_grasps(path: Path) -> Array | None:
    with report_damage(path, "grasp file", _ADVICE):
        grasps = check_grasps(read_arrays(path, ("grasps",))["grasps"])
    return grasps if len(grasps) else None


def _hash_model(urdf: Path) -> bytes:
    digest = hashlib.sha256(read_plain_file(urdf))
    for _, mesh in list_mesh_references(urdf):
        if mesh.is_file():
            digest.update(read_plain_file(mesh))
    return digest.digest()
