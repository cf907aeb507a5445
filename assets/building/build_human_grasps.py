"""Makes the shipped human grasps: `python -m handover_marl.assets.building.build_human_grasps [--out FILE]`.

For every object and side: grasps of the reference hand are sampled all over the object and a varied set is
chosen; each of the ten hands closes its fingers anew in these, and of what holds the best are kept.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from handover_marl.assets.building.hand_meshes import reference_hand
from handover_marl.assets.building.human_grasps_candidates import GraspTarget, grasp_target
from handover_marl.assets.building.human_grasps_selection import (
    Grasps,
    choose,
    fit_to_hand,
    free_share,
    grasp_pool,
)
from handover_marl.assets.building.object_meshes import load_visual
from handover_marl.assets.hand_model import SIDES, SUBJECTS, HandModel, Side, hand_model
from handover_marl.assets.human_grasps import ANGLE_STEP, GRASPED_OBJECTS, GRASPS_FILE

#: What the file holds, by key.
Arrays = dict[str, npt.NDArray[np.generic]]

_BASE_GRASPS = 60


@dataclass(frozen=True)
class Args:
    """Synthesise human grasps.

    Attributes:
        out: File to write.
        objects: Class names to do; the file is written only when all are done.
        count: Grasps per object, side and person.
        seed: Seed of all randomness.
    """

    out: Path = GRASPS_FILE
    objects: tuple[str, ...] = GRASPED_OBJECTS
    count: int = 20
    seed: int = 0


def object_grasps(name: str, side: Side, args: Args) -> list[Arrays]:
    """The grasps of one object with one hand by each of the ten people, as arrays to store."""
    target = grasp_target(load_visual(name))
    if side == "left":
        target = target.mirrored()
    rng = np.random.default_rng([args.seed, GRASPED_OBJECTS.index(name), SIDES.index(side)])
    pool = grasp_pool(target, name, rng)
    room = free_share(target, reference_hand(), pool, 120)
    base = choose(pool, name, _BASE_GRASPS, rng, room)
    results = []
    for subject in SUBJECTS:
        # Always a right hand: a left one's grasps are those of a right one on the mirrored object.
        model = hand_model(subject, "right")
        grasps = choose(fit_to_hand(target, model, base, rng), name, args.count, rng)
        results.append(stored(target, model, grasps, side))
    return results


def stored(target: GraspTarget, model: HandModel, grasps: Grasps, side: Side) -> Arrays:
    """A set of grasps as the arrays in the file, mirrored for a left hand."""
    position, rotation = grasps.palms
    base = position - np.einsum("nij,j->ni", rotation, model.palm_offset)
    quaternion = Rotation.from_matrix(rotation).as_quat()
    quaternion *= np.where(quaternion[:, 3:] < 0.0, -1.0, 1.0)
    flip = np.array([-1.0, 1.0, 1.0]) if side == "left" else np.ones(3)
    turned = np.array([1.0, -1.0, -1.0]) if side == "left" else np.ones(3)
    pose = np.concatenate([base * flip, quaternion * [*turned, 1.0]], axis=1)
    fingers, opened = (
        np.round(posture.angles() * np.tile(turned, 15) / ANGLE_STEP) for posture in (grasps.closed, grasps.opened)
    )
    return {
        "object_from_base": pose.astype(np.float32),
        "finger_angles": fingers.astype(np.int16),
        "open_angles": opened.astype(np.int16),
        "wrist_distance": grasps.wrist_distance.astype(np.float32),
        "free_share": free_share(target, model, grasps).astype(np.float32),
        "touching": grasps.touching,
        "overlap": grasps.overlap.astype(np.float32),
    }


def main(args: Args) -> None:
    """Synthesise all grasps and write them, indexed object, side, person, grasp."""
    everything: list[list[list[Arrays]]] = []
    with Progress() as progress:
        task = progress.add_task("human grasps", total=len(args.objects) * len(SIDES))
        for name in args.objects:
            everything.append([])
            for side in SIDES:
                everything[-1].append(object_grasps(name, side, args))
                progress.update(task, advance=1, description=f"{name} {side}")
    keys = everything[0][0][0]
    arrays = {
        key: np.array([[[person[key] for person in side] for side in item] for item in everything]) for key in keys
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(args.out, object_names=np.array(args.objects), **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(tyro.cli(Args))
