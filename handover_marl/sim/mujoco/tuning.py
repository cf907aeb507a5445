"""Numbers that make MuJoCo's soft contacts and force-limited servos behave as Bullet's contacts and motors do.

Chosen on scenes of s0 train alone, by how alike episodes of `yang2021` end in exact physics (docs/engines.md).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """How the model is built. SI units.

    Bullet's motor gives a joint the velocity that its position error asks for, whatever force that takes up to a
    limit. Here a servo with damping `kv` pulls towards that velocity. At the limit it chatters, one step for and one
    against, where `kv` is more than twice the joint's inertia a step; hence the armatures.

    Attributes:
        arm_damping: (7) kv of the arm's servos (N m s).
        arm_armature: (7) inertia added to the arm's joints (kg m^2).
        finger_damping: kv of the fingers' servos (N s/m): their grip is this, ten times and the opening.
        finger_armature: Mass added to each finger joint (kg); Bullet's contacts with fingers are soft.
        object_damping: kv of what leads objects, in masses a step.
        margin: Distance (m) at which each hull's surface begins: Bullet's have that much around them.
        contact_time: Time constant of contacts (s).
        contact_impedance: Least and full impedance of contacts, and the penetration (m) of the full one.
        impratio: How much stiffer friction is than the normal.
    """

    arm_damping: tuple[float, ...] = (1000.0, 1000.0, 1000.0, 500.0, 100.0, 100.0, 100.0)
    arm_armature: tuple[float, ...] = (0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
    finger_damping: float = 1500.0
    finger_armature: float = 4.0
    object_damping: float = 0.5
    margin: float = 0.001
    contact_time: float = 0.003
    contact_impedance: tuple[float, float, float] = (0.95, 0.99, 0.001)
    impratio: float = 10.0


TUNING = Tuning()
