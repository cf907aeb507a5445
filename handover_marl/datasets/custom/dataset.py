"""Data set of custom scenes in a folder, `own:FOLDER`.

The motion of scene N is in `motion/00000N.npz`, in the world frame at 1 kHz:

- `object_dof` (T, n, 6): positions (m) and intrinsic XYZ Euler angles (rad) of the objects, the handed-over object
  first.
- `hand_dof` (T, 51): position (m) and Euler angles (rad) of the hand's base, then 45 finger joint angles (rad);
  zeros without a hand.
- `hand_span` (2,): first and last frame in which the hand is present; -1 and -1 without a hand.

Values must be in ranges that are checked when something is added to a folder and when it is read.
"""

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.hand_model import find_hand_urdf
from handover_marl.assets.shipped import URDF_NAME
from handover_marl.config import HAND_DOF, OBJECT_DOF, OFFICIAL_CONFIG, TABLE_HEIGHT
from handover_marl.datasets.custom.scene_file import ALL_SCENES, SceneFile, read_scene_file
from handover_marl.datasets.dataset import Dataset, Scene, SceneAssets, SceneInfo
from handover_marl.datasets.splits import SPLITS
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, UnknownNameError, check_name
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import read_arrays, read_plain_file, report_damage
from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.model_files.urdf import list_mesh_references
from handover_marl.geometry.panda import FINGERTIPS, PANDA
from handover_marl.geometry.poses import transform_points
from handover_marl.geometry.rotations import compute_rotation_angles, quaternions_from_euler
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]

OBJECT_FOLDER, MOTION_FOLDER, GRASP_FILE = "objects", "motion", "grasps.npz"
#: Prefix of the names of these data sets.
PREFIX = "own"
_MAX_BYTES = 500_000_000

#: Largest extent of an object, and distance of its centre from the origin of its frame (m).
EXTENT, MAX_OFFSET = (0.005, 0.7), 0.7
#: Smallest and largest duration of a motion (s).
DURATION = (0.5, 60.0)
#: Largest distance of bodies from the origin of the world, on the floor below the table (m).
MAX_DISTANCE = 3.0
#: Largest speeds of bodies (m/s, rad/s).
MAX_SPEED, MAX_TURN_SPEED = 12.0, 90.0
#: Largest finger joint angle (rad).
MAX_FINGER_ANGLE: Final = 2.0 * np.pi
_MAX_ANGLE = 1000.0  # rad; angles are unwrapped
_MAX_REACH = 1.2  # m from the robot's base, where the handed-over object ends; the Panda reaches 0.855 m
_MAX_SINK = 0.03  # m below the table's surface
_MAX_START = 0.05  # m above what the handed-over object stands on
_MAX_GRIP = 0.2  # m between the base of a hand and the nearest vertex of an object that it holds
_MAX_HAND_DISTANCE = 1.0  # m, the smallest in a scene, between the hand's base and the handed-over object
_MAX_GRASP_DISTANCE = 0.05  # m between the fingertips and the box around the object
_MAX_ROTATION_ERROR = 1e-3
_UNIT_ADVICE = "remove lost tracks, or pass the units (length='mm', time='ms') or the frame"
_FRAME_ADVICE = "check frame: 'world' has its origin 0.92 m below the table's surface, 'table' on it; z points up"


def open_custom_dataset(argument: str, data_dir: str | None, robot: str) -> "CustomDataset":
    """Open the custom scenes in the folder `argument`; or in `data_dir`, if its data set has the name `argument`.

    Raises:
        OptionError: The data set in the folder has another name than `argument`.
        DataNotFoundError: The folder does not exist or has no scenes.
        DataFormatError: A file is damaged.
    """
    folder = check_path("dataset" if data_dir is None else "data_dir", data_dir or argument)
    if not folder.is_dir():
        raise DataNotFoundError(
            f"folder of custom scenes {folder} does not exist; give its path as dataset='{PREFIX}:PATH', or the "
            f"name of the data set and data_dir=PATH"
        )
    dataset = CustomDataset(folder.resolve(), robot)
    if data_dir is not None and argument != dataset.content.name:
        raise OptionError(
            f"data_dir must hold the scenes {argument!r}, got {folder} with {dataset.content.name!r}; pass their folder"
        )
    return dataset


def get_motion_path(folder: Path, scene_id: int) -> Path:
    """Return the path of a scene's motion in a folder of custom scenes."""
    return folder / MOTION_FOLDER / f"{scene_id:06d}.npz"


class CustomDataset(Dataset):
    """Data set of the custom scenes in a folder, see `handover_marl.datasets.custom.scene_file`.

    Args:
        folder: Path of the folder.
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Attributes:
        content: Content of `scenes.json`.

    Raises:
        UnknownNameError: `robot` is not in `ROBOTS`.
        DataNotFoundError: The folder has no `scenes.json`.
        DataFormatError: The file is damaged.
    """

    def __init__(self, folder: Path, robot: str = PANDA) -> None:
        super().__init__(robot)
        self.folder = folder
        self.content: SceneFile = read_scene_file(folder)
        self.name = f"{PREFIX}:{self.content.name}"
        self._numbers = {name: number for number, name in self.content.object_names.items()}
        self._hash_model = lru_cache(maxsize=None)(_hash_model)
        self._read_grasps = lru_cache(maxsize=None)(self._load_grasps)
        self._read_vertices = lru_cache(maxsize=None)(self._load_vertices)

    @property
    def source_folder(self) -> Path:
        """Folder of the scenes; `open_dataset(name, source_folder)` opens the data set again."""
        return self.folder

    @property
    def n_scenes(self) -> int:
        """Number of scenes."""
        return len(self.content.scenes)

    @property
    def setups(self) -> tuple[str, ...]:
        """Names of the setups: "all", in which each split has every scene, then the setups in `scenes.json`."""
        return (ALL_SCENES, *self.content.setups)

    @property
    def object_names(self) -> Mapping[int, str]:
        """Class names by class number: the YCB classes and the user's classes."""
        return self.content.object_names

    def list_scenes(self, setup: str | None, split: str) -> tuple[int, ...]:
        """Return the scene numbers of a split of a setup, ascending; raise `UnknownNameError` if there are none."""
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
        """Load a scene with its motion in the world frame.

        Raises:
            SceneError: The scene number does not exist.
            DataNotFoundError: A file is missing.
            DataFormatError: A file is damaged, or a value is out of its range.
        """
        info = self.load_info(scene_id)
        path = get_motion_path(self.folder, scene_id)
        names = dict(zip(("object", *info.object_names[1:]), info.object_names, strict=True))
        bodies = {name: self._read_vertices(found) for name, found in names.items()}
        object_dof, hand_dof, span = _read_motion(path, bodies, self.content.scenes[scene_id].hand is not None)
        return Scene(info, self.name, self._find_scene_assets(info), object_dof, hand_dof, *span)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of an object class's URDF."""
        if object_name in CLASS_NAMES.values():
            return super().find_object_urdf(object_name)
        return _require_file(self.folder / OBJECT_FOLDER / object_name / URDF_NAME)

    def load_grasps(self, object_name: str) -> Array | None:
        """Load robot grasps of an object class: gripper poses (n, 4, 4) in its frame (m), or None if there are none."""
        if object_name in CLASS_NAMES.values():
            return super().load_grasps(object_name)
        return self._read_grasps(object_name)

    def check_scenes(self, scene_ids: tuple[int, ...]) -> None:
        """Check that all files of scenes exist and that the objects' grasps can be read; raise `DataNotFoundError`."""
        for scene_id in scene_ids:
            info = self.load_info(scene_id)
            self._find_scene_assets(info)
            _require_file(get_motion_path(self.folder, scene_id))
            self.load_grasps(info.target_name)

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return a hash of a scene's motion, models and grasps."""
        assets, scene = self._find_scene_assets(self.load_info(scene_id)), self.content.scenes[scene_id]
        digest = hashlib.sha256(read_plain_file(_require_file(get_motion_path(self.folder, scene_id)), _MAX_BYTES))
        digest.update(repr((scene.name, scene.side, scene.hand, scene.objects)).encode())
        grasps = self.load_grasps(scene.objects[0])
        digest.update(b"" if grasps is None else grasps.tobytes())
        digest.update(self.robot.encode())
        for urdf in (assets.table, assets.hand, *assets.objects):
            digest.update(self._hash_model(urdf))
        return digest.hexdigest()[:16]

    def _find_scene_assets(self, info: SceneInfo) -> SceneAssets:
        # A scene without a hand never shows it.
        hand = self.content.scenes[info.scene_id].hand or 1
        return self.find_assets(info, find_hand_urdf(hand, "left" if info.side == "left" else "right"))

    def _load_grasps(self, object_name: str) -> Array | None:
        path = _require_file(self.folder / OBJECT_FOLDER / object_name / GRASP_FILE)
        with report_damage(path, "grasp file", "add the object again"):
            grasps = read_arrays(path, ("grasps",), _MAX_BYTES)["grasps"].astype(np.float64)
            check_grasps(grasps, self._read_vertices(object_name))
        return grasps if len(grasps) else None

    def _load_vertices(self, object_name: str) -> Array:
        """Return the checked vertices (v, 3) of an object's collision shapes in its frame (m)."""
        urdf = self.find_object_urdf(object_name)
        vertices, _ = read_collision_mesh(urdf)
        with report_damage(urdf, "model", "add the object again"):
            check_vertices(vertices)
        return vertices


def _read_motion(
    path: Path, bodies: Mapping[str, Array], has_hand: bool
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], tuple[int, int] | tuple[None, None]]:
    """Return the checked motion of objects (T, n, 6) and hand (T, 51), and the first and last frame with the hand.

    `bodies` has the objects' vertices (v, 3) in their frames (m) by name, the handed-over object first.
    """
    _require_file(path)
    with report_damage(path, "motion", "add the motion again"):
        arrays = read_arrays(path, ("object_dof", "hand_dof", "hand_span"), _MAX_BYTES)
        n_frames = len(arrays["object_dof"])
        expected = {"object_dof": (n_frames, len(bodies), OBJECT_DOF), "hand_dof": (n_frames, HAND_DOF)}
        for name, shape in expected.items():
            if arrays[name].shape != shape or not n_frames or arrays[name].dtype.kind != "f":
                raise ValueError(
                    f"{name} must be numbers of shape {shape}, got {arrays[name].dtype} {arrays[name].shape}"
                )
            if not np.isfinite(arrays[name]).all():
                raise ValueError(f"{name} must be finite everywhere")
        objects, hand = (arrays[name].astype(np.float32) for name in expected)
        first, last = (int(value) for value in arrays["hand_span"])
        if not (0 <= first <= last < n_frames if has_hand else first == last == -1):
            rule = "frames of the motion" if has_hand else "-1 for a scene without a hand"
            raise ValueError(f"hand_span must be {rule}, got {first} and {last}")
        check_objects(objects, bodies)
        check_start(objects, hand, first, bodies)
        if has_hand:
            check_hand(hand[first : last + 1], objects[first : last + 1])
    return objects, hand, (first, last) if has_hand else (None, None)


def _hash_model(urdf: Path) -> bytes:
    digest = hashlib.sha256(read_plain_file(urdf))
    for _, mesh in list_mesh_references(urdf):
        if mesh.is_file():
            digest.update(read_plain_file(mesh))
    return digest.digest()


def _require_file(path: Path) -> Path:
    if not path.is_file():
        raise DataNotFoundError(f"{path} is missing; copy the folder again, or add its object or motion again")
    return path


def check_vertices(vertices: Array) -> None:
    """Check the size of an object and its distance from the origin of its frame, by its vertices (v, 3) (m).

    Raises:
        DataFormatError: The object is too large, too small, or too far from the origin of its frame.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent, offset = float((high - low).max()), float(np.linalg.norm(low + high)) / 2.0
    # Convex parts may stand out a little.
    if not 0.9 * EXTENT[0] <= extent <= 1.1 * EXTENT[1]:
        raise DataFormatError(f"the largest extent must be {EXTENT[0]} to {EXTENT[1]} m, got {extent:.3g} m")
    if offset > 1.1 * MAX_OFFSET:
        raise DataFormatError(f"the body must be within {MAX_OFFSET} m of its frame's origin, got {offset:.3g} m")


def check_grasps(grasps: Array, vertices: Array) -> None:
    """Check robot grasps of an object.

    Args:
        grasps: (n, 4, 4) gripper poses in the object's frame (m).
        vertices: (v, 3) vertices of the object in its frame (m).

    Raises:
        DataFormatError: A grasp is no pose, or its fingertips are not at the object.
    """
    if grasps.ndim != 3 or grasps.shape[1:] != (4, 4) or not np.isfinite(grasps).all():
        raise DataFormatError(f"grasps must be finite numbers of shape (n, 4, 4), got shape {grasps.shape}")
    rotations = grasps[:, :3, :3]
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_pose = (errors < _MAX_ROTATION_ERROR) & (np.linalg.det(rotations) > 0.0)
    is_pose &= np.abs(grasps[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < _MAX_ROTATION_ERROR
    if not is_pose.all():
        raise DataFormatError(f"grasps must be poses, got a matrix without a rotation in grasp {np.argmin(is_pose)}")
    tips = grasps[:, :3, 3] + rotations @ FINGERTIPS
    outside = np.maximum(vertices.min(axis=0) - tips, tips - vertices.max(axis=0))
    distances = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
    if len(grasps) and distances.max() > _MAX_GRASP_DISTANCE:
        raise DataFormatError(
            f"fingertips must be within {_MAX_GRASP_DISTANCE} m of the object, got {distances.max():.3g} m in grasp "
            f"{np.argmax(distances)}"
        )


def check_objects(objects: npt.NDArray[np.floating], bodies: Mapping[str, Array]) -> None:
    """Check the motion of the objects of a scene.

    Args:
        objects: (T, n, 6) positions (m) and intrinsic XYZ Euler angles (rad) at 1 kHz in the world frame.
        bodies: Vertices (v, 3) of the n objects in their frames (m) by name, the handed-over one first.

    Raises:
        DataFormatError: An object is below the table, out of reach, far away, or jumps; or the motion is too long or
            too short.
    """
    low, high = DURATION
    if not low <= (len(objects) - 1) / 1000.0 <= high + 1e-3:
        raise DataFormatError(f"a motion must last {low} to {high:g} s, got {len(objects) - 1} ms")
    for number, (name, vertices) in enumerate(bodies.items()):
        poses = _check_body(name, objects[:, number])
        _check_above_table(f"{name} must start", poses[0], vertices)
        if number == 0:
            base = np.array(OFFICIAL_CONFIG.physics.panda.base_position)
            distance = float(np.linalg.norm(poses[-1, :3] - base))
            if distance > _MAX_REACH:
                raise DataFormatError(
                    f"{name} must end within {_MAX_REACH} m of the robot's base, got {distance:.2f} m; {_FRAME_ADVICE}"
                )
            _check_above_table(f"{name} must end", poses[-1], vertices)


def check_start(
    objects: npt.NDArray[np.floating], hand: npt.NDArray[np.floating], first: int, bodies: Mapping[str, Array]
) -> None:
    """Check that the handed-over object stands on the table or on another object at the start, or is held by the hand.

    Args:
        objects: (T, n, 6) motion of the objects in the world frame.
        hand: (T, 51) base position (m) and angles (rad) of the hand in the world frame.
        first: First frame with the hand, or -1.
        bodies: Vertices (v, 3) of the n objects in their frames (m) by name, the handed-over one first.

    Raises:
        DataFormatError: The object starts in the air.
    """
    dof = objects[0].astype(np.float64)
    poses = np.concatenate([dof[:, :3], quaternions_from_euler(dof[:, 3:])], axis=1)
    vertices, *others = (transform_points(pose, body) for pose, body in zip(poses, bodies.values(), strict=True))
    lowest = float(vertices[:, 2].min())
    gaps = [lowest - TABLE_HEIGHT, *(abs(lowest - float(other[:, 2].max())) for other in others)]
    is_held = first == 0 and float(np.linalg.norm(vertices - hand[0, :3], axis=1).min()) <= _MAX_GRIP
    if min(gaps) > _MAX_START and not is_held:
        raise DataFormatError(
            f"the handed-over object must start on the table, on another object or in the hand, got its lowest point "
            f"{100 * gaps[0]:.0f} cm above the table; {_FRAME_ADVICE}"
        )


def check_hand(hand: npt.NDArray[np.floating], objects: npt.NDArray[np.floating]) -> None:
    """Check the motion of a hand in the frames with the hand.

    Args:
        hand: (t, 51) base position (m) and Euler angles, then finger joint angles (rad), in the world frame.
        objects: (t, n, 6) motion of the objects in these frames, the handed-over one first.

    Raises:
        DataFormatError: The hand is far away, jumps, is never near the object, or a finger angle is out of range.
    """
    base = _check_body("the hand", hand[:, :6])
    fingers = float(np.abs(hand[:, 6:]).max())
    if fingers > MAX_FINGER_ANGLE:
        raise DataFormatError(f"finger angles must be at most {MAX_FINGER_ANGLE:.3f} rad, got {fingers:.4g}")
    nearest = float(np.linalg.norm(base[:, :3] - objects[:, 0, :3], axis=1).min())
    if nearest > _MAX_HAND_DISTANCE:
        raise DataFormatError(
            f"the hand must come within {_MAX_HAND_DISTANCE:g} m of the object, got {nearest:.3g} m; check its frame"
        )


def _check_body(name: str, dof: npt.NDArray[np.floating]) -> Array:
    """Return the poses (T, 7) of a body with motion (T, 6) after a check that it is near and does not jump."""
    values = dof.astype(np.float64)
    poses: Array = np.concatenate([values[:, :3], quaternions_from_euler(values[:, 3:])], axis=1)
    distance = float(np.linalg.norm(poses[:, :3], axis=1).max())
    if distance > MAX_DISTANCE:
        raise DataFormatError(
            f"{name} must be within {MAX_DISTANCE:g} m of the world's origin, got {distance:.4g} m; {_UNIT_ADVICE}"
        )
    if np.abs(values[:, 3:]).max() > _MAX_ANGLE:
        raise DataFormatError(f"angles of {name} must be in rad, got {np.abs(values[:, 3:]).max():.4g}")
    speeds = 1000.0 * np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    turns = 1000.0 * compute_rotation_angles(poses[1:, 3:], poses[:-1, 3:])
    for found, limit, unit in ((speeds, MAX_SPEED, "m/s"), (turns, MAX_TURN_SPEED, "rad/s")):
        if len(found) and found.max() > limit:
            raise DataFormatError(
                f"{name} must not jump, got {found.max():.3g} {unit} in frame {np.argmax(found) + 1}; {_UNIT_ADVICE}"
            )
    return poses


def _check_above_table(what: str, pose: Array, vertices: Array) -> None:
    lowest = float(transform_points(pose, vertices)[:, 2].min()) - TABLE_HEIGHT
    if lowest < -_MAX_SINK:
        raise DataFormatError(
            f"{what} above the table, got its lowest point {-100 * lowest:.0f} cm below the surface; {_FRAME_ADVICE}"
        )
