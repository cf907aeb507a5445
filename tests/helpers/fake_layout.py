"""Writer of a tiny dataset in HandoverSim's folder layout: objects are boxes, hands consist of spheres."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from handover_marl.assets.shipped import PANDA_URDF
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES, SUBJECTS

N_FRAMES = 400
HAND_FIRST, HAND_LAST = 50, 350


@dataclass(frozen=True)
class FakeScene:
    """Scene to write; `object_ids` are in file order, and `grasped` is an index into them."""

    scene_id: int
    object_ids: tuple[int, ...] = ()
    grasped: int = 0
    side: str = "right"


SCENES = (
    FakeScene(5),
    FakeScene(6, side="left"),
    FakeScene(9),
    FakeScene(14, object_ids=(11, 3, 21), grasped=1),
    FakeScene(105),
    FakeScene(204),
)


def write_layout(folder: Path, scenes: tuple[FakeScene, ...] = SCENES) -> Path:
    """Write scenes with all models and grasps that they need into a new folder, and return its path."""
    (folder / "dex-ycb-cache").mkdir(parents=True)
    assets = folder / "assets"
    _write(assets / "table" / "table.urdf", _table_urdf())
    panda = PANDA_URDF.parent
    (assets / "franka_panda").mkdir()
    (assets / "franka_panda" / "meshes").symlink_to(panda / "meshes")
    text = (panda / "panda.urdf").read_text()
    _write(assets / "franka_panda" / "panda_gripper.urdf", text)
    for scene in scenes:
        write_scene(folder, scene)
    return folder


def write_scene(folder: Path, scene: FakeScene) -> None:
    ids = scene.object_ids or (SCENE_CLASSES[scene.scene_id // 5 % 20],)
    subject = SUBJECTS[scene.scene_id // 100]
    for number in ids:
        _write(folder / "assets" / CLASS_NAMES[number] / "model_normalized.urdf", _object_urdf())
        write_grasps(folder / "assets" / "grasps" / f"{CLASS_NAMES[number]}.npy")
    _write(folder / "assets" / f"{subject}_{scene.side}" / "mano.urdf", _hand_urdf())
    meta = {
        "name": f"{subject}/scene{scene.scene_id}",
        "ycb_ids": list(ids),
        "ycb_grasp_ind": scene.grasped,
        "mano_sides": [scene.side],
        "mano_betas": [[0.0] * 10],
    }
    cache = folder / "dex-ycb-cache"
    _write(cache / f"meta_{scene.scene_id:03d}.json", json.dumps(meta))
    pose_y, pose_m = motion(len(ids), scene.grasped)
    np.savez_compressed(cache / f"pose_{scene.scene_id:03d}.npz", pose_y=pose_y, pose_m=pose_m)


def motion(n_objects: int, grasped: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poses of objects (N_FRAMES, n_objects, 6) and hand (N_FRAMES, 1, 51) in the official form (m, rad).

    The grasped object rises from the table and moves towards the robot; the hand moves with it.
    """
    rise = np.linspace(0.0, 1.0, N_FRAMES)
    pose_y = np.zeros((N_FRAMES, n_objects, 6), dtype=np.float32)
    pose_y[:, :, 0] = 0.45 - 0.15 * np.arange(n_objects)
    pose_y[:, :, 1] = 0.2
    pose_y[:, :, 2] = 0.04
    pose_y[:, grasped, 1] -= 0.1 * rise
    pose_y[:, grasped, 2] += 0.2 * rise
    pose_m = np.zeros((N_FRAMES, 1, 51), dtype=np.float32)
    shown = slice(HAND_FIRST, HAND_LAST + 1)
    pose_m[shown, 0, :3] = pose_y[shown, grasped, :3] + np.float32([0.0, 0.12, 0.0])
    pose_m[shown, 0, 6:] = 0.3 * rise[shown, None]
    return pose_y, pose_m


def write_grasps(path: Path, n: int = 100) -> None:
    """Write grasps that approach from the robot's side, with roll angles from 0 to pi, in the official pickled form."""
    path.parent.mkdir(parents=True, exist_ok=True)
    transforms = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    angles = np.linspace(0.0, np.pi, n)
    transforms[:, :3, 0] = np.stack([np.cos(angles), np.zeros(n), np.sin(angles)], axis=1)
    transforms[:, :3, 1] = np.stack([np.sin(angles), np.zeros(n), -np.cos(angles)], axis=1)
    transforms[:, :3, 2] = (0.0, 1.0, 0.0)
    transforms[:, 1, 3] = -0.1
    content = np.array({b"transforms": transforms, b"grasp_file": b"none"}, dtype=object)
    np.save(path, content, allow_pickle=True)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _link(name: str, mass: float = 0.0, shape: str = "") -> str:
    body = f"<{{0}}><geometry>{shape}</geometry></{{0}}>" if shape else ""
    inertia = f'<inertia ixx="{min(mass, 1)}" ixy="0" ixz="0" iyy="{min(mass, 1)}" iyz="0" izz="{min(mass, 1)}"/>'
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial>'
        f"{body.format('visual')}{body.format('collision')}</link>"
    )


def _joint(index: int, kind: str, axis: str, origin: str = "0 0 0", parent: int | None = None) -> str:
    limit = {"prismatic": '<limit lower="-1000" upper="1000"/>', "revolute": '<limit lower="-1.5" upper="1.5"/>'}
    return (
        f'<joint name="joint{index}" type="{kind}"><origin xyz="{origin}"/>'
        f'<parent link="link{index - 1 if parent is None else parent}"/><child link="link{index}"/>'
        f'<axis xyz="{axis}"/>{limit.get(kind, "")}</joint>'
    )


_AXES = ("1 0 0", "0 1 0", "0 0 1")


def _chain() -> str:
    parts = [_link("link0")]
    for index in range(1, 7):
        if index < 6:
            parts.append(_link(f"link{index}"))
        parts.append(_joint(index, "prismatic" if index <= 3 else "continuous", _AXES[(index - 1) % 3]))
    return "".join(parts)


def _object_urdf() -> str:
    box = _link("link6", 0.5, '<box size="0.05 0.05 0.08"/>')
    return f'<?xml version="1.0"?><robot name="object">{_chain()}{box}</robot>'


def _hand_urdf() -> str:
    parts = [_chain(), _link("link6"), _link("link7", 0.2, '<sphere radius="0.03"/>'), _joint(7, "fixed", "0 0 0")]
    index = 8
    for finger in range(5):
        for phalanx in range(3):
            parent = 7 if phalanx == 0 else index - 1
            origin = f"-0.06 0 {0.02 * (2 - finger)}" if phalanx == 0 else "-0.03 0 0"
            for axis in range(3):
                shape = '<sphere radius="0.008"/>' if axis == 2 else ""
                parts.append(_link(f"link{index}", 0.02 if axis == 2 else 0.0, shape))
                parts.append(_joint(index, "revolute", _AXES[axis], origin, parent))
                index, origin, parent = index + 1, "0 0 0", index
    return f'<?xml version="1.0"?><robot name="hand">{"".join(parts)}</robot>'


def _table_urdf() -> str:
    shape = '<origin xyz="0 0 0.9"/><geometry><box size="1.77 0.73 0.04"/></geometry>'
    return (
        '<?xml version="1.0"?><robot name="table"><link name="table"><inertial><mass value="0"/>'
        '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
        f"<visual>{shape}</visual><collision>{shape}</collision></link></robot>"
    )
