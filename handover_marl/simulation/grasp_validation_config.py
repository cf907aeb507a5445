"""Conditions of the grasp validation, in which MuJoCo simulates a Panda hand that closes on an object and shakes it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class GraspValidationConfig:
    """Conditions that a valid grasp of an object must satisfy in simulation.

    Attributes:
        close_time: Time for which the fingers close (s), as in HandoverSim's baselines.
        shake_time: Duration of each of six pushes, one along each axis and direction (s).
        acceleration: Acceleration of each push (m/s^2); the default is 1.5 times gravity.
        max_translation: Largest displacement of the object's point between the finger pads, relative to the fingers
            (m), while they close, and again while the object is shaken.
        max_rotation: Largest rotation of the object (rad) while the fingers close, and again while it is shaken.
        standoff_distances: Distances from the grasp, back along the approach direction, at which the open Panda hand
            must not touch the object (m); 0 is the grasp.
    """

    close_time: float = 0.5
    shake_time: float = 0.1
    acceleration: float = 14.7
    max_translation: float = 0.015
    max_rotation: float = 0.3
    standoff_distances: tuple[float, ...] = (0.0, 0.015, 0.03, 0.045, 0.06, 0.08, 0.1)
