"""Small invented raw DexYCB dataset and invented hand model, which tests read and damage."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dexycb.raw_files import SequenceFolder
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.mano_files import made_up_hand, official

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


def all_files(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder, also of hidden ones, by relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
