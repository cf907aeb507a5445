"""Creation of simulated worlds by the names of physics engines, backends and devices."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from handover_marl.config import PhysicsConfig
from handover_marl.errors import OptionError, check_name
from handover_marl.execution.options import is_pybullet_installed, require_modules, require_pybullet
from handover_marl.geometry.arrays import ArrayFactory
from handover_marl.simulation.world import World

if TYPE_CHECKING:
    from handover_marl.simulation.mujoco.batches.warp_world_batch import WarpWorldBatch
    from handover_marl.simulation.mujoco.world import MujocoWorldBatch

#: Batch of worlds that one engine simulates together; both classes have the same methods.
WorldBatch: TypeAlias = "MujocoWorldBatch | WarpWorldBatch"

EXACT, FAST, MUJOCO = "exact", "fast", "mujoco"
#: "exact" equals HandoverSim's PyBullet simulation bit for bit; "fast" is PyBullet that simulates an object only after
#: the robot has come near it, or after the release; "mujoco" is MuJoCo.
PHYSICS = (EXACT, FAST, MUJOCO)

THREADS, WARP = "threads", "warp"
#: Backends of batches in MuJoCo's physics.
BACKENDS = (THREADS, WARP)
CPU, CUDA = "cpu", "cuda"
#: Devices of the backends.
DEVICES = (CPU, CUDA)


def check_physics(physics: str) -> None:
    """Raise `UnknownNameError` for an unknown kind of physics, and `OptionError` if its engine is not installed."""
    check_name("physics", physics, PHYSICS)
    if physics != MUJOCO:
        require_pybullet(f"physics={physics!r}", "take physics='mujoco' (--physics mujoco)")


def list_available_physics() -> tuple[str, ...]:
    """Return the names of the kinds of physics whose engines are installed."""
    return PHYSICS if is_pybullet_installed() else (MUJOCO,)


def make_world(physics: str, config: PhysicsConfig, window: bool = False) -> World:
    """Create a simulated world without a scene; `World.reset` loads one.

    Args:
        physics: Kind of physics, one of `PHYSICS`.
        config: Constants of the world.
        window: Whether to show the world in a window, which MuJoCo refuses with `OptionError`.
    """
    check_physics(physics)
    # Engines are imported only when they are used: PyBullet is optional, and both take long.
    if physics == MUJOCO:
        from handover_marl.simulation.mujoco.world import MujocoWorld

        return MujocoWorld(config, window)
    from handover_marl.simulation.bullet.exact_and_fast import ExactWorld, FastWorld

    return ExactWorld(config, window) if physics == EXACT else FastWorld(config, window)


@dataclass(frozen=True)
class BatchBackend:
    """Engine and device that simulate the worlds of a batch.

    Attributes:
        name: "threads" for MuJoCo on the CPU, or "warp" for MuJoCo Warp.
        device: "cpu", or "cuda" for a GPU, which needs "warp"; "warp" on "cpu" is for tests only.
    """

    name: str = THREADS
    device: str = CPU


def check_backend(backend: BatchBackend) -> None:
    """Raise `UnknownNameError` for an unknown backend or device, `OptionError` if they cannot be used here."""
    check_name("backend", backend.name, BACKENDS)
    check_name("device", backend.device, DEVICES)
    if backend.name == THREADS:
        if backend.device != CPU:
            raise OptionError(
                f"device must be 'cpu' with backend='threads', got {backend.device!r}; pass backend='warp'"
            )
        return
    require_modules("backend='warp'", "warp", "mujoco_warp", "torch", "warp")
    from handover_marl.simulation.mujoco.batches.warp_model import is_device_available

    if not is_device_available(backend.device):
        raise OptionError(
            f"device={backend.device!r} needs an NVIDIA GPU and its driver, and Warp finds none; use device='cpu' with "
            "backend='threads'"
        )


def make_world_batch(config: PhysicsConfig, count: int, backend: BatchBackend, arrays: ArrayFactory) -> WorldBatch:
    """Create `count` worlds without scenes, which MuJoCo or MuJoCo Warp simulates together.

    Args:
        config: Constants of the worlds.
        count: Number of worlds.
        backend: Engine and device.
        arrays: Creator of arrays on the device of `backend`: NumPy arrays, or tensors for MuJoCo Warp.
    """
    check_physics(MUJOCO)
    check_backend(backend)
    if backend.name == WARP:
        from handover_marl.simulation.mujoco.batches.warp_world_batch import WarpWorldBatch

        return WarpWorldBatch(config, count, arrays)
    from handover_marl.simulation.mujoco.world import MujocoWorldBatch

    return MujocoWorldBatch(config, count)
