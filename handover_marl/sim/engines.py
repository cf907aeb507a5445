"""The kinds of physics by name."""

import importlib.util

from handover_marl.config import PhysicsConfig
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.options import check_pybullet, pybullet_installed
from handover_marl.sim.world import World

EXACT, FAST, MUJOCO = "exact", "fast", "mujoco"
#: "exact" is HandoverSim's simulation to the bit; "fast" leaves out what cannot touch; "mujoco" is another engine.
PHYSICS = (EXACT, FAST, MUJOCO)


def check_physics(physics: str) -> None:
    """Check the name of a kind of physics, and that its engine is there.

    Raises:
        UnknownNameError: There is none of that name.
        OptionError: Its engine is not installed.
    """
    if physics not in PHYSICS:
        raise UnknownNameError("physics", physics, PHYSICS)
    if physics == MUJOCO:
        if not _mujoco_installed():
            instead = ", or take physics='fast'" if pybullet_installed() else ""
            raise OptionError(
                "physics='mujoco' needs MuJoCo 4 and Python 3.11 or later: pip install 'handover-marl[mujoco]'"
                f"{instead}"
            )
        return
    installing = "" if _mujoco_installed() else ": pip install 'handover-marl[mujoco]'"
    check_pybullet(f"physics={physics!r}", f"take physics='mujoco' (--physics mujoco){installing}")


def available_physics() -> tuple[str, ...]:
    """The kinds of physics whose engines are installed."""
    there = {EXACT: pybullet_installed(), FAST: pybullet_installed(), MUJOCO: _mujoco_installed()}
    return tuple(name for name in PHYSICS if there[name])


def make_world(physics: str, config: PhysicsConfig, window: bool = False) -> World:
    """An empty world.

    Args:
        physics: One of `PHYSICS`.
        config: Constants of the world.
        window: Whether to show it in a window.

    Raises:
        UnknownNameError: There is no such physics.
        OptionError: Its engine is not installed, or opens no window.
        SimulationError: A window was asked for where there is no screen.
    """
    check_physics(physics)
    # Only now, so that who plays nothing needs no engine.
    if physics == MUJOCO:
        from handover_marl.sim.mujoco.mujoco_world import MujocoWorld

        return MujocoWorld(config, window)
    if physics == EXACT:
        from handover_marl.sim.bullet.exact_world import ExactWorld

        return ExactWorld(config, window)
    from handover_marl.sim.bullet.fast_world import FastWorld

    return FastWorld(config, window)


def make_worlds(physics: str, config: PhysicsConfig, count: int, threads: int) -> list[World]:
    """Empty worlds to be simulated by one process.

    Args:
        physics: One of `PHYSICS`.
        config: Constants of the worlds.
        count: How many.
        threads: How many threads will simulate them, world k always by thread k modulo `threads`.

    Raises:
        As `make_world`.
    """
    if physics != MUJOCO:
        return [make_world(physics, config) for _ in range(count)]
    check_physics(physics)
    from handover_marl.sim.mujoco.lanes import Lanes
    from handover_marl.sim.mujoco.mujoco_world import MujocoWorld

    lanes = [Lanes(-(-count // threads), config.gravity) for _ in range(threads)]
    return [MujocoWorld(config, lanes=lanes[number % threads]) for number in range(count)]


def _mujoco_installed() -> bool:
    return importlib.util.find_spec("mujoco") is not None
