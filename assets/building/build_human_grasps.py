"""Build the human grasps: `python -m handover_marl.assets.building.build_human_grasps [--out FILE]`.

For every object and side, grasps of the reference hand are sampled all over the object and a varied
set of them is selected. Each of the ten hands closes its fingers anew in these grasps, and the best
results are kept.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.build_hands import make_reference_hand
from handover_marl.assets.building.human_grasps_candidates import GraspTarget, make_grasp_target
from handover_marl.assets.building.human_grasps_selection import (
    HumanGraspSet,
    compute_free_share,
    fit_to_hand,
    sample_grasp_pool,
    select_grasps,
)
from handover_marl.assets.building.object_files import load_visual_mesh
from handover_marl.assets.hand_model import SIDES, SUBJECTS, HandGeometry, Side, make_hand_geometry
from handover_marl.assets.human_grasps import ANGLE_STEP, GRASPED_OBJECTS, GRASPS_FILE

#: Arrays of the file by key.
Arrays = dict[str, npt.NDArray[np.generic]]

_BASE_GRASPS = 60


@dataclass(frozen=True)
class Args:
    """Options of the builder of human grasps.

    Attributes:
        out: Output file (`.npz`).
        objects: YCB class names of the objects; the file is written when all are finished.
        count: Number of grasps per object, side and subject.
        seed: Random seed.
    """

    out: Path = GRASPS_FILE
    objects: tuple[str, ...] = GRASPED_OBJECTS
    count: int = 20
    seed: int = 0


def synthesize_object_grasps(name: str, side: Side, args: Args) -> list[Arrays]:
    """Return grasps of an object by each of the ten subjects, as arrays of the output file."""
    target = make_grasp_target(load_visual_mesh(name))
    if side == "left":
        target = target.mirror()
    rng = np.random.default_rng([args.seed, GRASPED_OBJECTS.index(name), SIDES.index(side)])
    pool = sample_grasp_pool(target, name, rng)
    free = compute_free_share(target, make_reference_hand(), pool, 120)
    base = select_grasps(pool, name, _BASE_GRASPS, rng, free)
    results = []
    for subject in SUBJECTS:
        # A left hand grasps as a right hand grasps the mirrored object.
        model = make_hand_geometry(subject, "right")
        grasps = select_grasps(fit_to_hand(target, model, base, rng), name, args.count, rng)
        results.append(encode_grasps(target, model, grasps, side))
    return results


def encode_grasps(target: GraspTarget, model: HandGeometry, grasps: HumanGraspSet, side: Side) -> Arrays:
    """Return grasps as arrays of the output file, mirrored for a left hand."""
    position, rotation = grasps.palms.position, grasps.palms.rotation
    base = position - np.einsum("nij,j->ni", rotation, model.palm_offset)
    quaternion = Rotation.from_matrix(rotation).as_quat()
    quaternion *= np.where(quaternion[:, 3:] < 0.0, -1.0, 1.0)
    flip = np.array([-1.0, 1.0, 1.0]) if side == "left" else np.ones(3)
    turned = np.array([1.0, -1.0, -1.0]) if side == "left" else np.ones(3)
    pose = np.concatenate([base * flip, quaternion * [*turned, 1.0]], axis=1)
    fingers, opened = (
        np.round(posture.compute_joint_angles() * np.tile(turned, 15) / ANGLE_STEP)
        for posture in (grasps.closed, grasps.opened)
    )
    return {
        "object_from_base": pose.astype(np.float32),
        "finger_angles": fingers.astype(np.int16),
        "open_angles": opened.astype(np.int16),
        "wrist_distance": grasps.wrist_distance.astype(np.float32),
        "free_share": compute_free_share(target, model, grasps).astype(np.float32),
        "touching": grasps.touching,
        "overlap": grasps.overlap.astype(np.float32),
    }


def main(args: Args) -> None:
    """Build all grasps and write them, indexed by object, side, subject and grasp."""
    all_grasps: list[list[list[Arrays]]] = []
    with Progress() as progress:
        task = progress.add_task("human grasps", total=len(args.objects) * len(SIDES))
        for name in args.objects:
            all_grasps.append([])
            for side in SIDES:
                all_grasps[-1].append(synthesize_object_grasps(name, side, args))
                progress.update(task, advance=1, description=f"{name} {side}")
    keys = all_grasps[0][0][0]
    arrays = {
        key: np.array([[[person[key] for person in side] for side in item] for item in all_grasps]) for key in keys
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(args.out, object_names=np.array(args.objects), **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(tyro.cli(Args))
