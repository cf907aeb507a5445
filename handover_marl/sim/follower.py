"""How motors follow their targets while nothing pushes back."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import MotorConfig


class Follower:
    """Joints that make up a fixed share of their position error in every step, as Bullet's position motors do.

    Beside the simulated motors of hand and objects this is right to 1e-4 (m, rad).

    Args:
        motors: One entry per joint.
        start: (d,) where the joints are (m, rad).

    Attributes:
        gains: (d,) the share of each joint's error that a step makes up.
        position: (d,) where the joints are at the end of the last path, float64.
        path: (n, d) where they are after each step of the present motion.
    """

    def __init__(self, motors: Sequence[MotorConfig], start: npt.ArrayLike) -> None:
        self.gains = np.array([motor.position_gain for motor in motors])
        self.position = np.array(start, dtype=np.float64)
        self.path = self.position[None]

    def follow(self, targets: npt.NDArray[np.float32]) -> None:
        """Work out the path for (n, d) targets; step by step, so that it does not depend on how they are cut."""
        follow_together([self], [targets])


def follow_together(followers: Sequence[Follower], targets: Sequence[npt.NDArray[np.float32]]) -> None:
    """As `Follower.follow` for some with equally many joints, all at once where they have equally many targets."""
    moving: dict[int, list[tuple[Follower, npt.NDArray[np.float64]]]] = {}
    for follower, own in zip(followers, targets, strict=True):
        wanted = own.astype(np.float64)
        if (wanted == follower.position).all():
            # What lies still takes no work; the recurrence would say the same.
            follower.path = wanted
        else:
            moving.setdefault(len(wanted), []).append((follower, wanted))
    for steps, group in moving.items():
        gains = np.array([follower.gains for follower, _ in group])
        position = np.array([follower.position for follower, _ in group])
        wanted = np.stack([own for _, own in group], axis=1)
        paths, way = np.empty(wanted.shape), np.empty(position.shape)
        for row in range(steps):
            np.subtract(wanted[row], position, out=way)
            np.multiply(gains, way, out=way)
            position = np.add(position, way, out=paths[row])
        for number, (follower, _) in enumerate(group):
            follower.path = paths[:, number]
            follower.position = follower.path[-1]
