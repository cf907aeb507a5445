"""Data set of DexYCB recordings in the folder layout of HandoverSim.

<data_dir>/dex-ycb-cache/   files of every scene:
    meta_NNN.json           name, ycb_ids, ycb_grasp_ind, mano_sides, mano_betas
    pose_NNN.npz            motion at 1 kHz, as in `Scene`: pose_y (T, n, 6) of objects, pose_m (T, 1, 51) of the hand
<data_dir>/assets/          URDFs of objects, hands, Panda and table; grasps/<class>.npy

Positions in pose files are in the table's frame: the world frame, moved up by `TABLE_HEIGHT`. `third_party.sha256`
lists the third-party files in `assets/`. A stand-in, a substitute made by this library, is marked in its first bytes.
"""

import hashlib
import io
import json
import os
from collections import Counter
from collections.abc import Mapping
from enum import Enum
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS
from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF
from handover_marl.datasets.dataset import TABLE_HEIGHT, Dataset, Scene, SceneAssets, SceneInfo
from handover_marl.datasets.restricted_pickle import load_restricted
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.execution.options import check_path
from handover_marl.execution.reading import (
    cached_by_file,
    check_plain_file,
    read_arrays,
    read_plain_file,
    report_damage,
)
from handover_marl.geometry.model_files.urdf import list_mesh_references
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

#: Folder of the motion files within a data folder.
CACHE_FOLDER = "dex-ycb-cache"
#: Largest accepted size of a scene's motion (bytes, unpacked).
MAX_MOTION_BYTES = 500_000_000
_MAX_META_BYTES, _MAX_GRASP_BYTES = 1_000_000, 20_000_000  # official grasp files have less than 1 MB
# Largest distances (m) of grasps from the object's origin, and of bodies from the origin of the table's frame.
_MAX_GRASP_DISTANCE, _MAX_DISTANCE = 2.0, 3.0
#: URDFs of the robot's variants, relative to `assets/`.
PANDA_FILES = {PANDA: "franka_panda/panda_gripper.urdf", PANDA_CAMERA: "franka_panda/panda_gripper_hand_camera.urdf"}
#: Text among the first bytes of a stand-in file.
STAND_IN: Final = "handover_marl stand-in"
# Scenes run without textures, and without the camera's body, which HandoverSim's URDFs name at a
# path that does not exist.
_OPTIONAL_ENDINGS = (".mtl", ".png", "camera.stl", "camera.DAE")
_HEADER_BYTES = 1000
_FILE_ADVICE = "list what is missing with handover-marl doctor, and copy or expand the HandoverSim data again"


class FileOrigin(Enum):
    """Origin of a model or grasp file: HandoverSim's, a stand-in (a substitute made by this library), or unknown."""

    ORIGINAL = "original"
    STAND_IN = "stand-in"
    UNKNOWN = "unknown"


@cache
def read_third_party_checksums() -> MappingProxyType[str, str | None]:
    """Return the SHA-256 checksums (hexadecimal, None if unknown) of all third-party files by path in `assets/`."""
    text = (files(__package__) / "third_party.sha256").read_text()
    pairs = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    return MappingProxyType({path: None if known == "-" else known for known, path in pairs})


def list_required_files() -> tuple[str, ...]:
    """Return the third-party files that scenes need, as paths in `assets/`."""
    return tuple(path for path in read_third_party_checksums() if not path.endswith(_OPTIONAL_ENDINGS))


def classify_file_origin(path: str, content: bytes) -> FileOrigin:
    """Return STAND_IN for a marked stand-in, ORIGINAL for the known checksum of `path` in `assets/`, else UNKNOWN."""
    if STAND_IN.encode() in content[:_HEADER_BYTES]:
        return FileOrigin.STAND_IN
    known = read_third_party_checksums().get(path)
    same = known is not None and hashlib.sha256(content).hexdigest() == known
    return FileOrigin.ORIGINAL if same else FileOrigin.UNKNOWN


def find_hand_origin(folder: Path) -> FileOrigin:
    """Return ORIGINAL if a hand's folder was made from MANO, else STAND_IN; UNKNOWN if its palm mesh cannot be read.

    A palm from MANO is an open surface: some edges belong to only one triangle. Other palms are closed meshes.
    """
    try:
        lines = read_plain_file(folder / "meshes" / "visual" / "mesh1.obj").splitlines()
    except (OSError, ValueError):
        return FileOrigin.UNKNOWN
    faces = [line.split()[1:] for line in lines if line.startswith(b"f ")]
    edges = Counter(frozenset(pair) for face in faces for pair in zip(face, [*face[1:], *face[:1]], strict=True))
    return FileOrigin.STAND_IN if all(count == 2 for count in edges.values()) else FileOrigin.ORIGINAL


def find_origin(assets: Path, path: str) -> FileOrigin:
    """Return the origin of a third-party file by its path in the folder `assets`; UNKNOWN if it cannot be read."""
    try:
        return classify_file_origin(path, read_plain_file(assets / path))
    except (OSError, ValueError):
        return FileOrigin.UNKNOWN


def is_stand_in_file(path: Path) -> bool:
    """Return whether a file is a stand-in, a substitute made by this library; False if it cannot be read."""
    return find_origin(path.parent, path.name) is FileOrigin.STAND_IN


def describe_origins(kind: str, *origins: FileOrigin) -> list[str]:
    """Return a list with a note if files of a `kind`, e.g. "grasps", are not all original; else an empty list.

    The note is "stand-in KIND" if any file is a stand-in, else "KIND of unknown origin".
    """
    if FileOrigin.STAND_IN in origins:
        return [f"stand-in {kind}"]
    return [f"{kind} of unknown origin"] if FileOrigin.UNKNOWN in origins else []


def require_file(path: Path, advice: str = _FILE_ADVICE) -> Path:
    """Return `path` if it is a plain file; else raise `DataNotFoundError` or `DataFormatError`, with `advice`."""
    with report_damage(path, "file", advice):
        check_plain_file(path)
    return path


def _read_scene_info(path: Path, scene_id: int) -> tuple[SceneInfo, list[int]]:
    """Read the meta file of a scene.

    Returns:
        Description of the scene, and the indices of its objects in the pose file, the handed-over one first.
    """
    advice = "it needs name, ycb_ids, ycb_grasp_ind and mano_sides; copy it again from the HandoverSim data"
    with report_damage(path, "meta file of a scene", advice):
        meta = json.loads(read_plain_file(path, _MAX_META_BYTES))
        ids, grasped, sides, name = (meta[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides", "name"))
        check_scene_meta(ids, grasped, sides)
        if not isinstance(name, str):
            raise TypeError(f"name must be text, got {name!r}")
    order = [grasped, *(index for index in range(len(ids)) if index != grasped)]
    ids = [ids[index] for index in order]
    names = tuple(CLASS_NAMES[number] for number in ids)
    return SceneInfo(scene_id, name, sides[0], tuple(ids), names), order


def read_motion(path: Path, shapes: Mapping[str, tuple[int, ...]], advice: str) -> list[npt.NDArray[np.float32]]:
    """Read the arrays of a motion file (`.npz`) as float32, in the order of `shapes`.

    `shapes` maps the name of each array to the shape of one frame: an array of T frames has the shape (T, *shape). The
    second array is the motion of a hand, with zeros in frames without a hand, which may only be at the start and at the
    end. A missing or damaged file raises `DataNotFoundError` or `DataFormatError`, with `advice` for the user.
    """
    with report_damage(path, "pose file", advice):
        arrays = [array.astype(np.float32) for array in read_arrays(path, tuple(shapes), MAX_MOTION_BYTES).values()]
        n_frames = len(arrays[0])
        for array, (name, shape) in zip(arrays, shapes.items(), strict=True):
            if array.shape != (n_frames, *shape) or not n_frames or not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite numbers of shape {('T', *shape)}, got shape {array.shape}")
        shown = np.flatnonzero(arrays[1].reshape(n_frames, -1).any(axis=1))
        if len(shown) and shown[-1] - shown[0] >= len(shown):
            raise ValueError("poses of the hand must be zero only at start and end, got zeros between them")
    return arrays


def check_scene_meta(ids: list[int], grasped: int, sides: list[Any]) -> None:
    """Raise `ValueError` unless a scene has valid classes `ids`, one hand side, and an index `grasped` into `ids`."""
    is_known = all(type(number) is int and number in SCENE_CLASSES for number in ids)
    if not is_known or len(set(ids)) < len(ids) or not 1 <= len(ids) <= MAX_OBJECTS:
        classes = ", ".join(map(str, SCENE_CLASSES))
        raise ValueError(f"ycb_ids must be 1 to {MAX_OBJECTS} different ones of the classes {classes}, got {ids}")
    if type(grasped) is not int or not 0 <= grasped < len(ids):
        raise ValueError(f"ycb_grasp_ind must be an index into {len(ids)} ycb_ids, got {grasped}")
    if sides not in (["right"], ["left"]):
        raise ValueError(f"mano_sides must be ['right'] or ['left'], got {sides}")


def load_grasps(path: Path) -> npt.NDArray[np.float64]:
    """Load the gripper poses (n, 4, 4) in the object's frame (m) from a grasp file of HandoverSim (.npy)."""
    with report_damage(path, "grasp file", "copy it again from the HandoverSim data"):
        stream = io.BytesIO(read_plain_file(path, _MAX_GRASP_BYTES))
        np.lib.format.read_magic(stream)
        np.lib.format.read_array_header_1_0(stream)
        content = load_restricted(stream.read())
        content = content.item() if isinstance(content, np.ndarray) else content
        # Files of Python 3 have bytes as keys.
        by_name = {key.decode() if isinstance(key, bytes) else key: value for key, value in content.items()}
        return check_grasps(by_name["transforms"])


def check_grasps(grasps: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return robot grasps (n, 4, 4) as float64; raise `ValueError` unless all are rigid poses within 2 m (not mm)."""
    if grasps.ndim != 3 or grasps.shape[1:] != (4, 4) or not np.isfinite(grasps).all():
        raise ValueError(f"grasps must be finite numbers of shape (n, 4, 4), got shape {grasps.shape}")
    poses = grasps.astype(np.float64)
    rotations, near = poses[:, :3, :3], np.linalg.norm(poses[:, :3, 3], axis=1) < _MAX_GRASP_DISTANCE
    errors = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    is_rigid = (errors < 1e-3) & (np.linalg.det(rotations) > 0.0) & (poses[:, 3] == np.eye(4)[3]).all(axis=1)
    if not (is_rigid & near).all():
        wrong = poses[np.argmin(is_rigid & near)].round(3).tolist()
        raise ValueError(f"grasps must be rigid poses in m, at most {_MAX_GRASP_DISTANCE:g} m away, got {wrong}")
    return poses


class OfficialDataset(Dataset):
    """DexYCB scenes of a data folder in HandoverSim's layout; a missing folder raises `DataNotFoundError`.

    Args:
        data_dir: Folder with `dex-ycb-cache/` and `assets/`.
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Attributes:
        data_dir: Path of the data folder.
    """

    name = "dexycb"

    def __init__(self, data_dir: str | os.PathLike[str], robot: str = PANDA) -> None:
        super().__init__(robot)
        self.data_dir = check_path("data_dir", data_dir)
        for folder in (self.data_dir, self.data_dir / CACHE_FOLDER, self.data_dir / "assets"):
            # Unlike `Path.is_dir`, these functions do not raise errors for folders that may not be read.
            if not os.path.isdir(folder):  # noqa: PTH112
                fault = "is a file, not a folder" if os.path.isfile(folder) else "does not exist or may not be read"  # noqa: PTH113
                raise DataNotFoundError(
                    f"data folder {folder} {fault}. Give the folder that holds dex-ycb-cache/ and assets/ "
                    "(HandoverSim's handover/data) as data_dir=, --data-dir or HANDOVER_MARL_DATA."
                )
        self._assets = self.data_dir / "assets"
        self._info = lru_cache(maxsize=None)(
            lambda scene_id: _read_scene_info(self._find_meta_file(scene_id), scene_id)
        )
        self._load_grasps = cached_by_file(None)(load_grasps)
        self._origin = lru_cache(maxsize=None)(lambda path: find_origin(self._assets, path))
        self._hand_origin = lru_cache(maxsize=None)(lambda name: find_hand_origin(self._assets / name))

    @property
    def panda_urdf(self) -> Path:
        """Path of the URDF of the Panda with its gripper, as HandoverSim loads it."""
        return require_file(self._assets / PANDA_FILES[self.robot])

    def load_info(self, scene_id: int) -> SceneInfo:
        """Load the description of a scene from its meta file."""
        self.check_scene_id(scene_id)
        return self._info(scene_id)[0]

    def load_scene(self, scene_id: int) -> Scene:
        """Load a scene with its motion in the world frame."""
        self.check_scene_id(scene_id)
        info, order = self._info(scene_id)
        shapes = {"pose_y": (len(order), OBJECT_DOF), "pose_m": (1, HAND_DOF)}
        path, advice = self._pose_path(scene_id), "it may be truncated, copy or expand it again"
        objects, hands = read_motion(path, shapes, advice)
        farthest = max(float(np.abs(motion[..., :3]).max()) for motion in (objects, hands))
        if farthest >= _MAX_DISTANCE:
            raise DataFormatError(f"{path}: positions must be less than 3 m (not mm), got {farthest:.4g}; {advice}")
        object_dof, hand_dof = objects[:, order], hands[:, 0]
        present = np.flatnonzero(hand_dof.any(axis=1))
        object_dof[:, :, 2] += TABLE_HEIGHT
        hand_dof[present, 2] += TABLE_HEIGHT
        span = (int(present[0]), int(present[-1])) if len(present) else (None, None)
        return Scene(info, self.name, self._find_scene_assets(info), object_dof, hand_dof, *span)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of the URDF of a YCB class in the data folder."""
        return require_file(self._assets / object_name / "model_normalized.urdf")

    def load_grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """Load the gripper poses (n, 4, 4) at grasps of a YCB class, in the object's frame (m); None without grasps."""
        path = self._find_grasp_file(object_name)
        return None if path is None else self._load_grasps(path).copy()

    def compute_fingerprint(self, scene_id: int) -> str:
        """Return a hash of a scene's meta, pose and grasp files, its URDFs, and the sizes of its mesh files."""
        digest = hashlib.sha256()
        info = self.load_info(scene_id)
        self.load_grasps(info.target_name)
        assets, grasps = self._find_scene_assets(info), self._find_grasp_file(info.target_name)
        files = [self._find_meta_file(scene_id), require_file(self._pose_path(scene_id))]
        for path in files if grasps is None else [*files, grasps]:
            digest.update(read_plain_file(path))
        for urdf in (assets.table, assets.panda, assets.hand, *assets.objects):
            digest.update(read_plain_file(urdf))
            # Hashing the contents of meshes would take seconds.
            sizes = [(name, mesh.stat().st_size if mesh.is_file() else -1) for name, mesh in list_mesh_references(urdf)]
            digest.update(b"\n".join(b"%s %d" % (name.encode(), size) for name, size in sizes))
        return digest.hexdigest()[:16]

    def describe_models(self, scene_id: int) -> str:
        """Return a note, e.g. "MANO hand, stand-in grasps": hand model, and kinds of files that are not original."""
        info = self.load_info(scene_id)
        parts = [self._origin(f"{name}/model_normalized_convex.obj") for name in info.object_names]
        hand = self._hand_origin(f"{info.subject}_{info.side}")
        notes = ["MANO hand"] if hand is FileOrigin.ORIGINAL else describe_origins("hand", hand)
        notes += describe_origins("convex parts", *parts)
        if info.target_name not in CLASSES_WITHOUT_GRASPS:
            notes += describe_origins("grasps", self._origin(f"grasps/{info.target_name}.npy"))
        notes += describe_origins("Panda", self._origin(PANDA_FILES[self.robot]))
        return ", ".join(notes)

    def _find_meta_file(self, scene_id: int) -> Path:
        return require_file(self.data_dir / CACHE_FOLDER / f"meta_{scene_id:03d}.json")

    def _pose_path(self, scene_id: int) -> Path:
        return self.data_dir / CACHE_FOLDER / f"pose_{scene_id:03d}.npz"

    def _find_scene_assets(self, info: SceneInfo) -> SceneAssets:
        return SceneAssets(
            table=require_file(self._assets / "table/table.urdf"),
            panda=self.panda_urdf,
            objects=tuple(self.find_object_urdf(name) for name in info.object_names),
            hand=require_file(self._assets / f"{info.subject}_{info.side}/mano.urdf"),
        )

    def _find_grasp_file(self, name: str) -> Path | None:
        path = self._assets / "grasps" / f"{name}.npy"
        return None if name in CLASSES_WITHOUT_GRASPS and not path.exists() else require_file(path)
