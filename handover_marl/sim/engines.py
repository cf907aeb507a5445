"""The kinds of physics by name."""

from handover_marl.config import PhysicsConfig
from handover_marl.errors import UnknownNameError
from handover_marl.sim.world import World

#: "exact" is HandoverSim's simulation to the bit; "fast" leaves out what cannot touch.
PHYSICS = ("exact", "fast")


def check_physics(physics: str) -> None:
    """Check the name of a kind of physics.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if physics not in PHYSICS:
        raise UnknownNameError("physics", physics, PHYSICS)


def make_world(physics: str, config: PhysicsConfig, window: bool = False) -> World:
    """An empty world.

    Args:
        physics: One of `PHYSICS`.
        config: Constants of the world.
        window: Whether to show it in a window.

    Raises:
        UnknownNameError: There is no such physics.
        SimulationError: A window was asked for where there is no screen.
    """
    check_physics(physics)
    # Only now, so that who plays nothing needs no engine.
    if physics == "exact":
        from handover_marl.sim.bullet.exact_world import ExactWorld

        return ExactWorld(config, window)
    from handover_marl.sim.bullet.fast_world import FastWorld

    return FastWorld(config, window)
