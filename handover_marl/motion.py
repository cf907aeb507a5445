"""The giver's clock: which pose the hand and the objects are led to at each physics step.

This is the seam between the giver's action and the world. The zero action plays the recording back as it is.
"""

from dataclasses import dataclass

from handover_marl.scene import Scene


@dataclass(frozen=True)
class MotionTarget:
    """Where hand and objects are led in one physics step (world frame, m, rad; float32 values).

    Attributes:
        objects: Six joint targets for every object, in the scene's order.
        hand: 51 joint targets, or None when there is no hand.
    """

    objects: tuple[list[float], ...]
    hand: list[float] | None


class Playback:
    """Plays a scene frame by frame and stays at its last frame.

    Attributes:
        scene: What is played.
        frame: The frame shown, 0 at first.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.frame = 0
        self.target = self._read()

    def advance(self) -> MotionTarget:
        """Go on by one physics step and return the new target."""
        if self.frame < self.scene.n_frames - 1:
            self.frame += 1
            self.target = self._read()
        return self.target

    def _read(self) -> MotionTarget:
        objects = tuple(self.scene.object_dof[self.frame].tolist())
        present = self.scene.hand_present(self.frame)
        return MotionTarget(objects, self.scene.hand_dof[self.frame].tolist() if present else None)
