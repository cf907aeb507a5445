"""Small invented raw DexYCB data set, and an invented hand model with the array shapes and the pickles of MANO."""

import io
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from scipy.sparse import csc_matrix
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dexycb.mano import N_FACES, N_JOINTS, N_VERTICES, PARENTS, ManoModel
from handover_marl.datasets.dexycb.scenes import SequenceFolder
from handover_marl.geometry.ycb import SUBJECTS

Array = npt.NDArray[Any]
Content = dict[str, Any]


def made_up_hand(seed: int = 0) -> Content:
    """Return the content of a model file as arrays.

    Every vertex has the weight 1 for one joint, and every triangle joins three vertices with successive numbers.
    """
    rng = np.random.default_rng(seed)
    owner = np.arange(N_VERTICES) * N_JOINTS // N_VERTICES
    whole = np.flatnonzero(owner[:-2] == owner[2:])
    corners = whole[np.arange(N_FACES) % len(whole)]
    regressor = np.where(rng.random((N_JOINTS, N_VERTICES)) < 0.03, rng.random((N_JOINTS, N_VERTICES)) / 20, 0.0)
    return {
        "v_template": rng.uniform(-0.1, 0.1, (N_VERTICES, 3)),
        "shapedirs": rng.uniform(-0.01, 0.01, (N_VERTICES, 3, 10)),
        "J_regressor": csc_matrix(regressor),
        "weights": np.eye(N_JOINTS)[owner],
        "f": np.stack([corners, corners + 1, corners + 2], axis=1).astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(N_JOINTS)], dtype=np.int64),
        "hands_components": rng.uniform(-0.4, 0.4, (45, 45)),
        "hands_mean": rng.uniform(-0.1, 0.1, 45),
    }


def made_up_model(side: str = "right", seed: int = 0) -> ManoModel:
    """Return the model of a file with the content of `made_up_hand`."""
    content = made_up_hand(seed)
    return ManoModel(
        side=side,
        v_template=content["v_template"],
        shapedirs=content["shapedirs"],
        j_regressor=content["J_regressor"].toarray(),
        weights=content["weights"],
        faces=content["f"].astype(np.int64),
        hands_components=content["hands_components"],
        hands_mean=content["hands_mean"],
    )


class Record:
    """Object that is pickled as an instance of a class that is not installed.

    Args:
        module: Module of the class.
        name: Name of the class.
        state: Attributes of the object.
    """

    def __init__(self, module: str, name: str, **state: Any) -> None:
        self.made = (f"{module}\n{name}\n".encode(), state)


class _Pickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        """Write an object; for a `Record`, the operations GLOBAL, EMPTY_TUPLE, NEWOBJ and BUILD with its state."""
        if not isinstance(obj, Record):
            super().save(obj, save_persistent_id)
            return
        name, state = obj.made
        self.write(b"c" + name + b")\x81")
        super().save(state)
        self.write(b"b")


def sparse(matrix: csc_matrix, **changes: Array) -> Record:
    """Return a sparse matrix as older versions of SciPy pickled it, with changed attributes."""
    arrays = {part: getattr(matrix, part) for part in ("indices", "data", "indptr")}
    return Record("scipy.sparse.csc", "csc_matrix", _shape=matrix.shape, maxprint=50, **{**arrays, **changes})


def official(content: Content, **changes: object) -> bytes:
    """Return a whole file like the official ones; `changes` replaces some entries.

    The shape directions are the first ten of twenty, as chumpy pickles them, with a set that only chumpy needs.
    """
    entries = {"bs_style": "lbs", "J": np.zeros((16, 3)), **content}
    entries["J_regressor"] = sparse(content["J_regressor"])
    wanted = content["shapedirs"]
    everything = np.concatenate([wanted, np.full_like(wanted, 7.0)], axis=2)
    entries["shapedirs"] = Record(
        "chumpy.reordering",
        "Select",
        a=Record("chumpy.ch", "Ch", x=everything, _dirty_vars=set()),
        idxs=np.arange(everything.size).reshape(everything.shape)[:, :, :10].ravel(),
        preferred_shape=wanted.shape,
        _dirty_vars=set(),
    )
    stream = io.BytesIO()
    _Pickler(stream, protocol=2).dump({**entries, **changes})
    return stream.getvalue()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


EXTRINSICS = "20200702_151821"
N_KEYS = 6


def random_rotations(n: int, seed: int) -> Rotation:
    """Return n uniformly distributed random rotations."""
    return Rotation.from_quat(np.random.default_rng(seed).normal(size=(n, 4)))


def tag_pose(seed: int = 0) -> np.ndarray:
    """Return the pose of a tag as a (3, 4) matrix, with the translation in m."""
    turn = random_rotations(1, seed).as_matrix()[0]
    return np.concatenate([turn, [[0.3], [-0.2], [0.9]]], axis=1)


def object_poses(n_keyframes: int = N_KEYS, n_objects: int = 1, seed: int = 0) -> np.ndarray:
    """Return (n_keyframes, n_objects, 7) float32 poses (quaternion xyzw, position in m) of keyframes.

    Every object turns slowly and moves along a straight line.
    """
    time = np.linspace(0.0, 1.0, n_keyframes)[:, None]
    poses = []
    for number in range(n_objects):
        start = random_rotations(1, seed + number)
        quaternions = (start * Rotation.from_rotvec(time * [0.3, -0.2, 0.5])).as_quat()
        poses.append(np.concatenate([quaternions, [0.1 * number, 0.2, 0.6] + time * [0.1, 0.0, 0.2]], axis=1))
    return np.stack(poses, axis=1).astype(np.float32)


def hand_poses(n_keyframes: int = N_KEYS, first: int = 0, last: int | None = None, seed: int = 0) -> np.ndarray:
    """Return (n_keyframes, 51) float32 hand poses of keyframes, zero before `first` and after `last`."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 1.0, n_keyframes)[:, None]
    poses = (rng.normal(size=51) + time * rng.normal(scale=0.2, size=51)).astype(np.float32)
    poses[:first] = 0.0
    poses[n_keyframes if last is None else last + 1 :] = 0.0
    return poses


@dataclass
class RawScene:
    """Content of a recording, which tests may change before they `write` it to the disk."""

    subject: int = 0
    name: str = "20200709_141754"
    side: str = "right"
    betas: list[float] = field(default_factory=lambda: [0.1 * number for number in range(10)])
    meta: dict[str, object] = field(default_factory=dict)
    objects: np.ndarray = field(default_factory=lambda: object_poses(n_objects=2))
    hand: np.ndarray = field(default_factory=hand_poses)
    mano: str = ""  # name of the hand's calibration; empty: a name made of subject and side

    def write(self, raw: Path, scene_id: int = 0) -> SequenceFolder:
        """Write the recording's files below a raw folder, and return the recording's folder."""
        subject = SUBJECTS[self.subject]
        mano = self.mano or f"20200709_140042_{subject[9:]}_{self.side}"
        folder = raw / subject / self.name
        meta = {
            "extrinsics": EXTRINSICS,
            "ycb_ids": [2, 5],
            "ycb_grasp_ind": 1,
            "mano_sides": [self.side],
            "mano_calib": [mano],
            **self.meta,
        }
        write_yaml(folder / "meta.yml", {key: value for key, value in meta.items() if value is not None})
        np.savez(folder / "pose.npz", pose_y=self.objects, pose_m=self.hand[:, None])
        write_yaml(mano_file(raw, mano), {"betas": self.betas})
        write_yaml(extrinsics_file(raw), {"extrinsics": {"apriltag": tag_pose().ravel().tolist()}, "master": "1"})
        return SequenceFolder(scene_id, f"{subject}/{self.name}", folder)


def extrinsics_file(raw: Path) -> Path:
    return raw / "calibration" / f"extrinsics_{EXTRINSICS}" / "extrinsics.yml"


def mano_file(raw: Path, mano: str = "20200709_140042_subject-01_right") -> Path:
    return raw / "calibration" / f"mano_{mano}" / "mano.yml"


def write_yaml(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def write_mano(folder: Path) -> Path:
    """Write MANO_RIGHT.pkl and MANO_LEFT.pkl of two invented hands, and return their folder."""
    folder.mkdir(parents=True)
    for seed, side in enumerate(("RIGHT", "LEFT")):
        (folder / f"MANO_{side}.pkl").write_bytes(official(made_up_hand(seed)))
    return folder
