"""What to learn from: an object somewhere without a hand, and an arm that looks at it.

Objects lie as in training scenes: where they are held out in the end, on their way there, or on the table, each moved
and turned a little. Arms start where the receiver starts, or look at the object from somewhere round it. Some objects
are hidden in part by a ball that nobody sees: where a hand would hide them, from which grasps keep clear.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS, PandaConfig
from handover_marl.datasets import Dataset
from handover_marl.models.poses import inverse_transform_points
from handover_marl.planning.arm_in_world import ArmInWorld

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SituationConfig:
    """Where objects and arms are (m, rad).

    Attributes:
        offered: Share of objects that are held out.
        carried: Of those on the way there; the others lie on the table.
        moved: Standard deviation of a displacement along each axis, and
        turned: of a turn about each.
        strewn: Objects on the table are moved by this at most along it, and turned anyhow about the vertical.
        at_start: Share of arms that start where the receiver does, and
        shaken: standard deviation of their joints, which half of them have.
        near: Shortest distance of the other hands from the object, and
        far: longest.
        ahead: Their direction from the object has at least this component towards the robot's base.
        aim: They look past the object's middle by this at most.
        hidden: Share of objects that are hidden in part, by a ball with
        radii: these radii at least and at most.
    """

    offered: float = 0.65
    carried: float = 0.15
    moved: float = 0.04
    turned: float = 0.2
    strewn: float = 0.12
    at_start: float = 0.6
    shaken: float = 0.04
    near: float = 0.2
    far: float = 0.5
    ahead: float = 0.0
    aim: float = 0.05
    hidden: float = 0.5
    radii: tuple[float, float] = (0.03, 0.07)


@dataclass(frozen=True, eq=False)
class Situation:
    """One of them.

    Attributes:
        number: By which it is drawn.
        object_name: Class of the object.
        dof: (6,) float32 its place xyz (m) and intrinsic XYZ Euler angles (rad) in the world.
        joints: (7,) where the arm is (rad).
        ball: (4,) middle (m) in the world and radius (m) of what hides it; radius 0 is nothing.
    """

    number: int
    object_name: str
    dof: npt.NDArray[np.float32]
    joints: Array
    ball: Array

    @property
    def pose(self) -> Array:
        """(7,) world pose of the object."""
        turn = Rotation.from_euler("XYZ", self.dof[3:].astype(np.float64))
        return np.concatenate([self.dof[:3].astype(np.float64), turn.as_quat()])


class Situations:
    """Draws them: the same for a number, whoever asks and in whatever order.

    Args:
        data: Where scenes are.
        scenes: Numbers of training scenes.
        arm: The arm.
        panda: Where it starts.
        seed: Of everything.
        config: Where objects and arms are.
    """

    def __init__(
        self,
        data: Dataset,
        scenes: tuple[int, ...],
        arm: ArmInWorld,
        panda: PandaConfig,
        seed: int,
        config: SituationConfig,
    ) -> None:
        self._data, self._scenes, self._arm, self._seed, self._config = data, scenes, arm, seed, config
        self._start = np.array(panda.start_joints[:ARM_JOINTS])
        self._base = np.array(panda.base_position)

    def draw(self, number: int) -> Situation:
        """A situation."""
        rng = np.random.default_rng((self._seed, number))
        scene = self._data.scene(self._scenes[int(rng.integers(len(self._scenes)))])
        dof = self._place(scene.object_dof[:, 0], rng)
        joints = self._joints(dof[:3].astype(np.float64), rng)
        config = self._config
        radius = rng.uniform(*config.radii) if rng.random() < config.hidden else 0.0
        # Beside the middle, so that something is left to see.
        way = rng.standard_normal(3)
        middle = dof[:3] + way / np.linalg.norm(way) * rng.uniform(0.5, 1.5) * radius
        return Situation(number, scene.info.target_name, dof, joints, np.array([*middle, radius]))

    def _place(self, track: npt.NDArray[np.float32], rng: np.random.Generator) -> npt.NDArray[np.float32]:
        config, kind = self._config, rng.random()
        if kind >= config.offered + config.carried:
            return self._strewn(track[0], rng)
        row = track[-1]
        if kind >= config.offered:
            away = np.flatnonzero(np.linalg.norm(track[:, :3] - track[0, :3], axis=1) > 0.02)
            row = track[int(rng.choice(away))] if len(away) else row
        turn = Rotation.from_rotvec(rng.normal(0.0, config.turned, 3)) * Rotation.from_euler("XYZ", row[3:])
        return np.concatenate([row[:3] + rng.normal(0.0, config.moved, 3), turn.as_euler("XYZ")]).astype(np.float32)

    def _strewn(self, row: npt.NDArray[np.float32], rng: np.random.Generator) -> npt.NDArray[np.float32]:
        turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) * Rotation.from_euler("XYZ", row[3:])
        shift = np.array([*rng.uniform(-self._config.strewn, self._config.strewn, 2), 0.0])
        return np.concatenate([row[:3] + shift, turn.as_euler("XYZ")]).astype(np.float32)

    def _joints(self, place: Array, rng: np.random.Generator) -> Array:
        config = self._config
        if rng.random() >= config.at_start:
            low, high = self._arm.limits
            for _ in range(4):
                found, solved = self._arm.solve(self._looking(place, rng)[None], self._start[None], 60)
                if solved[0]:
                    near: Array = np.clip(found[0], low, high)
                    return near
        shaken = rng.normal(0.0, config.shaken, ARM_JOINTS) * (rng.random() < 0.5)
        joints: Array = self._start + shaken
        return joints

    def _looking(self, place: Array, rng: np.random.Generator) -> Array:
        """(7,) pose of a hand that looks at a place, upright as it starts but for a turn."""
        config = self._config
        out = rng.standard_normal(3)
        towards = self._base - place
        towards[2] = 0.2 * np.linalg.norm(towards[:2])
        if out @ towards < config.ahead * np.linalg.norm(towards):
            out -= 2.0 * (out @ towards) / (towards @ towards) * towards
        position = place + out / np.linalg.norm(out) * rng.uniform(config.near, config.far)
        axis = place + rng.uniform(-config.aim, config.aim, 3) - position
        axis /= np.linalg.norm(axis)
        up = self._arm.hand(self._start)
        x = Rotation.from_quat(up[3:]).as_matrix()[:, 0]
        x = x - (x @ axis) * axis
        x /= max(float(np.linalg.norm(x)), 1e-6)
        turn = Rotation.from_matrix(np.stack([x, np.cross(axis, x), axis], axis=1))
        turn = turn * Rotation.from_rotvec([0.0, 0.0, rng.normal(0.0, 0.3)])
        return np.concatenate([position, turn.as_quat()])


def hidden(points: npt.NDArray[np.float32], hand: Array, pinhole: Array, ball: Array) -> npt.NDArray[np.bool_]:
    """(n,) which points of a cloud are in a ball or behind it.

    Args:
        points: (n, 3) in the hand link's frame (m).
        hand: (7,) world pose of the hand link.
        pinhole: (3,) the camera in the hand link's frame (m).
        ball: (4,) middle in the world and radius (m); radius 0 hides nothing.
    """
    middle = inverse_transform_points(hand, ball[None, :3])[0] - pinhole
    rays = points - pinhole
    lengths = np.maximum((rays**2).sum(axis=1), 1e-12)
    # The point of each line of sight, as far as it goes, that is nearest to the ball.
    share = np.clip(rays @ middle / lengths, 0.0, 1.0)
    found: npt.NDArray[np.bool_] = np.linalg.norm(share[:, None] * rays - middle, axis=1) < ball[3]
    return found
