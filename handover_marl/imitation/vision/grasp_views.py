"""Views of objects in persons' hands, with the grasps that are good there: what grasp networks learn from.

Moments come from recordings, views from wherever the wrist camera may come by: at the poses at which receivers wait,
and on ways to grasps, aside and turned by chance. Rays are cast at the models; there is no physics.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS
from handover_marl.datasets.scene import Scene
from handover_marl.imitation.vision.grasp_labels import GraspLabels, KnownGrasps
from handover_marl.imitation.vision.recorded_hands import recorded_hand
from handover_marl.models.panda import OPEN, WAITING_JOINTS
from handover_marl.models.poses import compose, compose_point, inverse, inverse_transform_points
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.reactive.choice import MORE_SEEDS, SEEDS
from handover_marl.sim.camera.optics import deproject
from handover_marl.sim.camera.photo import Seen
from handover_marl.sim.rays.ray_camera import RayCamera
from handover_marl.sim.world import Snapshot

Array = npt.NDArray[np.float64]
Half = npt.NDArray[np.float16]
Rng = np.random.Generator

# Of inverse kinematics.
_STEPS = 12


@dataclass(frozen=True)
class ViewConfig:
    """Which views, and what is kept of them.

    Attributes:
        objects: Points of the object that are kept.
        hands: Points of the person's hand.
        grasps: Grasps, the best ones.
        least: Views of less of the object are left out (points).
        last: Share of the moments that are a recording's last, at which the object is held out, and
        lying: share of those before it is picked up.
        waiting: Share of views from about where receivers wait, and
        part: share of those from part of the way there.
        farthest: Views are taken at most so far before a grasp (m), by chance
        aside: so far aside at the grasp (m), and
        aside_before: more per metre before it, and likewise turned (rad), by
        turned: and
        turned_before: per metre.
        joints: And by so much in each joint (rad) where receivers wait.
        lifted: An object this far from where it lay is picked up (m).
        since: The velocity is that of the last so many steps (ms), and
        ahead: the motion that of the coming so many.
    """

    objects: int = 256
    hands: int = 64
    grasps: int = 96
    least: int = 30
    last: float = 0.5
    lying: float = 0.05
    waiting: float = 0.1
    part: float = 0.25
    farthest: float = 0.5
    aside: float = 0.015
    aside_before: float = 0.25
    turned: float = 0.1
    turned_before: float = 0.7
    joints: float = 0.08
    lifted: float = 0.03
    since: int = 50
    ahead: int = 500


class GraspViews(NamedTuple):
    """n views, all in the frame of the hand link at which they were taken (m, s).

    Attributes:
        objects: (n, N, 3) points of the object; of few some come twice.
        hands: (n, M, 3) points of the person's hand, of which the first
        n_hands: (n,) count.
        grasps: (n, K, 7) poses of the hand link at grasps, the best first, with
        quality: (n, K) from 0 to 1; zeros where there are no more.
        middle: (n, 3) of the object.
        velocity: (n, 3) of the object.
        motion: (n, 3) its coming motion.
    """

    objects: Half
    hands: Half
    n_hands: npt.NDArray[np.uint8]
    grasps: Half
    quality: Half
    middle: Half
    velocity: Half
    motion: Half


class ViewMaker:
    """Takes views of scenes.

    Args:
        context: The robot, the objects and their grasps.
        arm: The robot's arm.
        labels: What grasps are worth.
        config: Which views.
    """

    def __init__(
        self, context: PolicyContext, arm: ArmInWorld, labels: GraspLabels, config: ViewConfig = ViewConfig()
    ) -> None:
        self._context, self._arm, self._labels, self.config = context, arm, labels, config

    def views(self, scene: Scene, count: int, rng: Rng) -> GraspViews:
        """Up to `count` views of a scene; from some places nothing is seen.

        Raises:
            SimulationError, DataFormatError: A model or one of its meshes cannot be read.
        """
        frames, known = self._frames(scene, count, rng).tolist(), self._known(scene)
        moments = {frame: self._moment(scene, known, frame) for frame in sorted(set(frames))}
        return self._seen(scene, ((moments[frame], self._joints(moments[frame], rng)) for frame in frames), rng)

    def seen(self, scene: Scene, places: Iterable[tuple[int, Array]], rng: Rng) -> GraspViews:
        """Views of a scene at frames, from where joints (7,) of the arm put the camera."""
        known = self._known(scene)
        return self._seen(scene, ((self._moment(scene, known, frame), joints) for frame, joints in places), rng)

    def _seen(self, scene: Scene, places: "Iterable[tuple[Moment, Array]]", rng: Rng) -> GraspViews:
        camera = RayCamera(scene.assets, self._context.config.physics)
        found = [self._view(scene, camera, moment, joints, rng) for moment, joints in places]
        views = [view for view in found if view is not None]
        sizes = self._shapes()
        columns = list(zip(*views, strict=True)) if views else [() for _ in sizes]
        return GraspViews(
            *(
                np.array(column, dtype=kind).reshape(len(views), *size)
                for column, (kind, size) in zip(columns, sizes, strict=True)
            )
        )

    def _shapes(self) -> list[tuple[type, tuple[int, ...]]]:
        config, half = self.config, np.float16
        clouds = [(half, (config.objects, 3)), (half, (config.hands, 3)), (np.uint8, ())]
        return [*clouds, (half, (config.grasps, 7)), (half, (config.grasps,)), (half, (3,)), (half, (3,)), (half, (3,))]

    def _known(self, scene: Scene) -> KnownGrasps:
        """The object's grasps, with those that the hand leaves room for where the object is held out."""
        last = scene.n_frames - 1
        name, pose = scene.info.target_name, object_pose(scene, last)
        return self._labels.beside(name, recorded_hand(scene, last), pose)

    def _moment(self, scene: Scene, known: KnownGrasps, frame: int) -> "Moment":
        """A scene at a frame."""
        pose, hand = object_pose(scene, frame), recorded_hand(scene, frame)
        return Moment(frame, pose, known, self._labels.qualities(known, hand, pose))

    def _view(
        self, scene: Scene, camera: RayCamera, moment: "Moment", joints: Array, rng: Rng
    ) -> tuple[object, ...] | None:
        """The fields of `GraspViews` with the arm at (7,), or None where too little of the object is seen."""
        config, frame = self.config, moment.frame
        present = bool(scene.hand_present(np.array([frame]))[0])
        robot = np.array([*joints, OPEN, OPEN], dtype=np.float32)
        photo = camera.sought(Snapshot(robot, scene.hand_dof[frame] if present else None, scene.object_dof[frame]))
        item, hand = (deproject(photo.depth, photo.shows(seen)) for seen in (Seen.TARGET, Seen.HAND))
        if len(item) < config.least:
            return None
        link = self._arm.hand(np.asarray(joints, dtype=np.float64))
        hands = np.zeros((config.hands, 3))
        n_hands = min(len(hand), config.hands)
        hands[:n_hands] = hand[rng.choice(len(hand), n_hands, replace=False)]
        best = np.argsort(-moment.quality, kind="stable")[: config.grasps]
        best = best[moment.quality[best] > self._labels.config.worth]
        grasps, quality = np.zeros((config.grasps, 7)), np.zeros(config.grasps)
        known = moment.known
        grasps[: len(best)] = compose(compose(inverse(link), moment.object_pose), known.poses[best])
        quality[: len(best)] = moment.quality[best]
        middle = compose_point(moment.object_pose, known.middle)
        velocity, motion = self._motion(scene, frame)
        turn = Rotation.from_quat(link[3:]).inv()
        chosen = rng.choice(len(item), config.objects, replace=len(item) < config.objects)
        there = inverse_transform_points(link, middle[None])[0]
        return item[chosen], hands, n_hands, grasps, quality, there, turn.apply(velocity), turn.apply(motion)

    def _motion(self, scene: Scene, frame: int) -> tuple[Array, Array]:
        config, path = self.config, scene.object_dof[:, 0, :3].astype(np.float64)
        before, after = max(frame - config.since, 0), min(frame + config.ahead, len(path) - 1)
        return (path[frame] - path[before]) / (0.001 * config.since), path[after] - path[frame]

    def _frames(self, scene: Scene, count: int, rng: Rng) -> npt.NDArray[np.int_]:
        config, path = self.config, scene.object_dof[:, 0, :3]
        away = np.linalg.norm(path - path[0], axis=1)
        picked = int(np.argmax(away > config.lifted))
        kinds = rng.random(count)
        moving = rng.integers(picked, len(path), count)
        lying = rng.integers(0, max(picked, 1), count)
        frames: npt.NDArray[np.int_] = np.where(kinds < config.last, len(path) - 1, moving)
        return np.where(kinds > 1.0 - config.lying, lying, frames)

    def _joints(self, moment: "Moment", rng: Rng) -> Array:
        """(7,) joints of the arm from which to look."""
        config, kind = self.config, rng.random()
        waiting = (WAITING_JOINTS, self._context.panda.start_joints)[rng.integers(2)]
        start = np.array(waiting[:ARM_JOINTS]) + rng.normal(0.0, config.joints, ARM_JOINTS)
        good = moment.quality > self._labels.config.worth
        if kind < config.waiting or not good.any():
            return start
        goal = self._before_grasp(moment, int(rng.choice(np.flatnonzero(good))), rng)
        seeds = np.concatenate([start[None], SEEDS, MORE_SEEDS])
        found, there = self._arm.solve(np.tile(goal, (len(seeds), 1)), seeds, _STEPS)
        if not there.any():
            return start
        joints: Array = found[int(np.argmax(there))]
        return start + rng.random() * (joints - start) if kind < config.waiting + config.part else joints

    def _before_grasp(self, moment: "Moment", number: int, rng: Rng) -> Array:
        """(7,) pose of the hand link somewhere before a grasp."""
        config = self.config
        before = config.farthest * rng.random() ** 1.5
        aside = (config.aside + config.aside_before * before) * rng.normal(size=3) / np.sqrt(3.0)
        turn = (config.turned + config.turned_before * before) * rng.normal(size=3) / np.sqrt(3.0)
        offset = np.concatenate([aside - [0.0, 0.0, before], Rotation.from_rotvec(turn).as_quat()])
        found: Array = compose(compose(moment.object_pose, moment.known.poses[number]), offset)
        return found


@dataclass(frozen=True, eq=False)
class Moment:
    """A recording at one frame: the object's pose (7,) in the world, its grasps, and what they are worth (n,)."""

    frame: int
    object_pose: Array
    known: KnownGrasps
    quality: Array


def object_pose(scene: Scene, frame: int) -> Array:
    """(7,) pose of the given object in the world at a frame."""
    dof = scene.object_dof[frame, 0].astype(np.float64)
    return np.concatenate([dof[:3], Rotation.from_euler("XYZ", dof[3:]).as_quat()])
