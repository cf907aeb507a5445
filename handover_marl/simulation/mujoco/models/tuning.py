"""Parameters that make MuJoCo behave like Bullet."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MujocoTuning:
    """Parameters (SI units) that make MuJoCo's contacts and actuators behave like Bullet's.

    The values were chosen on scenes of s0 train only, by the share of episodes of `yang2021` with the
    same outcome as in exact physics.

    Bullet's motor gives a joint the velocity that its position error demands, with any force up to
    a limit. In MuJoCo an actuator with damping `kv` accelerates the joint towards that velocity. At
    the force limit the joint oscillates from step to step if `kv` is more than twice the joint's
    inertia per step; the armatures prevent this.

    Attributes:
        arm_damping: kv of the seven arm actuators (N m s).
        arm_armature: Inertia added to the seven arm joints (kg m^2).
        finger_damping: kv of the finger actuators (N s/m). The grip force (N) is this value times
            10 / s times the opening of the finger (m).
        finger_armature: Mass added to each finger joint (kg), since Bullet's contacts with fingers
            are soft.
        object_damping: kv of the actuators that move objects, as a multiple of the object's mass per
            physics step.
        margin: Distance (m) of each convex hull's surface from its vertices, equal to Bullet's
            collision margin.
        contact_time: Time constant of contacts (s).
        contact_impedance: Smallest and full impedance of contacts, and the penetration (m) at
            which the full impedance is reached.
        impratio: Ratio of frictional to normal constraint impedance.
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


TUNING = MujocoTuning()
