"""The giver's clock: which poses the hand and the objects are led to in the coming physics steps.

This is the seam between the giver's action and the world. The zero action plays the recording back as it is.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handover_marl.scene import Scene


@dataclass(frozen=True, eq=False)
class Motion:
    """Where hand and objects are led in each of n physics steps (world frame, m, rad).

    Attributes:
        objects: (n, m, 6) float32 joint targets of the m objects, in the scene's order.
        hand: (n, 51) float32 joint targets.
        hand_present: (n,) whether there is a hand at all.
    """

    objects: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32]
    hand_present: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.objects)

    def hand_targets(self) -> list[list[float] | None]:
        """The hand's targets as Bullet takes them, None where there is no hand."""
        return [
            row if present else None
            for row, present in zip(self.hand.tolist(), self.hand_present.tolist(), strict=True)
        ]


class Playback:
    """Plays a scene frame by frame and stays at its last frame.

    Attributes:
        scene: What is played.
        frame: The frame shown, 0 at first.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.frame = 0

    def start(self) -> Motion:
        """Where everything is before the first step: a motion of one row."""
        return self._read(np.array([0]))

    def advance(self, steps: int) -> Motion:
        """Go on by some physics steps and return their targets."""
        last = self.scene.n_frames - 1
        frames = np.minimum(np.arange(self.frame + 1, self.frame + steps + 1), last)
        self.frame = int(frames[-1])
        return self._read(frames)

    def _read(self, frames: npt.NDArray[np.int_]) -> Motion:
        scene = self.scene
        return Motion(scene.object_dof[frames], scene.hand_dof[frames], scene.hand_present(frames))
